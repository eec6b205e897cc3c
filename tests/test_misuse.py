"""What is asked wrongly is answered in one sentence, in Python as on the command line; what is meant well is taken."""

import os
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch

import environments  # noqa: F401  (registers the copies)
import lemniscate as lem
from conftest import tiny_fields
from lemniscate.cli import main
from lemniscate.envs import registry
from lemniscate.envs.spaces import read_observation
from lemniscate.errors import UserError, missing_extra, shown


class Sized(gym.Env):
    """Five steps; it cannot be made without a size."""

    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, size):
        self.size = size

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self.t += 1
        return np.zeros(2, np.float32), 1.0, self.t == 5, False, {}


class Missing(gym.Wrapper):
    """A wrapper that cannot be made."""

    def __init__(self, env):
        raise ValueError("a part is lost")


class Unseen(Sized):
    """An environment whose `render` returns no picture."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 30}  # noqa: RUF012
    render_mode = "rgb_array"

    def __init__(self, picture=None, render_mode=None):
        self.picture = picture

    def render(self):
        return None if self.picture is None else np.full((4, 4, 3), self.picture)


class Closing:
    """A logger that takes no pictures."""

    def __init__(self, path, config, step):
        pass

    def write(self, step, metrics, episodes):
        pass

    def close(self):
        pass


class Several(Unseen):
    """Two choices at once."""

    action_space = gym.spaces.MultiDiscrete([2, 3])


class Blank(Sized):
    """An environment without `render`."""

    def __init__(self, render_mode=None):
        super().__init__(2)


class Remembers(torch.nn.Linear):
    """A network that says too late that it has a memory."""

    def __init__(self, inputs, outputs):
        super().__init__(inputs, outputs)
        self.memory_size = 3


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    path = tmp_path_factory.mktemp("a folder") / "cartpole"
    fields = tiny_fields("CartPole-v1", backend="gymnasium", total_steps=64)
    path.parent.joinpath("cartpole.gif").touch()
    path.with_suffix(".mp4").mkdir()
    return lem.train("ppo", "CartPole-v1", run=path, progress=False, **fields)


def tree(path):
    """Every file with its content."""
    return {file: file.read_bytes() for file in path.rglob("*") if file.is_file()}


def test_a_path_a_run_and_a_policy_are_evaluated_alike(run):
    scores = [lem.evaluate(which, episodes=2).returns for which in (run, run.policy, run.path, str(run.path))]
    assert scores == scores[:1] * 4
    assert lem.load(run) is lem.load(run.policy) is run.policy


def test_runs_are_plotted_one_by_one_or_in_a_list(run):
    pictures = lem.plot(run.policy)
    assert pictures == lem.plot([str(run.path)])
    assert {lem.api.policy.path_of(which) for which in (run, run.policy, lem.load(run.path))} == {run.path}
    assert {picture.parent for picture in pictures} == {run.path / "plots"}


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda run: lem.plot(), "nothing to plot: name one run or several"),
        (lambda run: lem.plot([]), "nothing to plot"),
        (lambda run: lem.plot(run, by=["step"]), r"There is no axis \['step'\]: did you mean step"),
        (lambda run: lem.check(next(run.path.glob("*/step-*"))), "step-64 is a checkpoint: name its run, "),
        (lambda run: lem.load(next(run.path.glob("*/step-*")), checkpoint="best"), "is a checkpoint: name its run, "),
        (lambda run: lem.check(run.path / "checkpoints"), "checkpoints is a directory, and no run: it has no config.json"),
        (lambda run: lem.check(run, backend="gymnasium"), "is a run, and has its own environment: leave out backend"),
        (lambda run: lem.config_for("ppo", None, str(run.path / "config.json")), "config.json is no preset, which"),
        (lambda run: lem.config_for("../own.py", "CartPole-v1"), "../own.py is a file: name its module, own"),
        (lambda run: lem.config_for("", "CartPole-v1"), "There is no algorithm ''"),
        (lambda run: lem.train("ppo", "CartPole-v1", run="s3://bucket/x"), "is an address, and a run is a directory of this"),
        (lambda run: lem.train("ppo", "CartPole-v1", processes="2"), "processes must be a whole number at least 1, not '2'"),
        (lambda run: lem.train("ppo", "CartPole-v1", processes=0), "processes must be a whole number at least 1, not 0"),
        (lambda run: lem.train("ppo", "CartPole-v1", report="no"), "report must be True or False, not 'no'"),
        (lambda run: lem.train("ppo", "CartPole-v1", progress=2), "progress must be True or False, not 2"),
        (lambda run: lem.plot(lem.TrainedPolicy), "A run is a directory, .* not the class TrainedPolicy"),
        (lambda run: lem.load(None), "A run is a directory, .* not None"),
        (lambda run: lem.load(run.path / "metrics.jsonl"), "metrics.jsonl is a file of .*: name that directory"),
        (lambda run: lem.check(run.path / "config.json"), "config.json is a file of .*: name that directory"),
        (lambda run: lem.evaluate(next(run.path.glob("*/*/state.json"))), "state.json is a file of .*step-"),
        (lambda run: lem.resume(3), "A run is a directory, .* not 3"),
        (lambda run: lem.watch(3), "A policy is a run, a function, a torch module, .* not 3"),
        (lambda run: lem.evaluate(run, episodes="3"), "episodes must be a whole number from 1 to 1,000,000, not '3'"),
        (lambda run: lem.evaluate(run, episodes=2.5), "episodes must be a whole number from 1 to 1,000,000, not 2.5"),
        (lambda run: lem.evaluate(run, seed=None), "seed must be a whole number at least 0, not None"),
        (lambda run: lem.set_seeds(-1), "seed must be a whole number from 0 to 4,294,967,295, not -1"),
        (lambda run: lem.set_seeds(None), "seed must be a whole number .* not None"),
        (lambda run: lem.set_seeds(1.5), "seed must be a whole number .* not 1.5"),
        (lambda run: lem.train("ppo", gym.make("CartPole-v1")), "made already; give its class, its id, or a function"),
        (lambda run: lem.train("ppo", run.policy.config), r"takes its place: lem.train\(config\)"),
        (lambda run: lem.train("ppo", config=run.policy.config), r"takes its place: lem.train\(config\)"),
        (lambda run: lem.train(run.policy.config, preset="course"), "does not go with a preset"),
        (lambda run: lem.train(lem.run.config.RunConfig()), "lemniscate.run.config is not an algorithm"),
        (lambda run: lem.train("ppo", "CartPole-v1", track=3), "track must be a logger's name or class, not 3"),
        (lambda run: lem.train("ppo", Sized), "required positional argument: 'size'; it is given in env_kwargs"),
        (lambda run: lem.train_sweep("ppo", "CartPole-v1", 1, callbacks=[print]), "Each process has to import it: put"),
        (lambda run: lem.train_sweep("ppo", "CartPole-v1", 1, callbacks=["math:cosy"]), "math has no cosy"),
        (lambda run: lem.train_sweep("ppo", "CartPole-v1", 1, seed=3), "given as seeds, not as seed"),
        (lambda run: lem.train_sweep("ppo", lambda: gym.make("CartPole-v1"), 1), "into a module, and name it"),
        (lambda run: lem.train_sweep(None, "CartPole-v1", 1), "None is not an algorithm"),
        (lambda run: lem.train_sweep("ppo", Sized, 1, env_kwargs={"size": 1}, run=run.path), "exists already"),
        (lambda run: lem.train_sweep("ppo", Sized, 1, env_kwargs={"size": 1}, run=run.path, wrappers=[Missing]), "is lost"),
        (lambda run: lem.train_sweep("ppo", "CartPole-v1", 1, callbacks=print), "Each process has to import it: put"),
        (lambda run: lem.train("ppo", "CartPole-v1", preset=3), "There is no preset 3"),
        (lambda run: lem.train("ppo", "CartPole-v1", callbacks=3), "A callback must be a function of"),
        (lambda run: lem.train("ppo", "CartPole-v1", callbacks=lambda step: None), "A callback must be a function of"),
        (lambda run: lem.train("ppo", ""), "There is no environment ''"),
        (lambda run: lem.train("ppo", "CartPole-v1", run="."), "A run needs a directory of its own: name one that is new"),
        (lambda run: lem.diagnose("hf://u/x"), "hf://u/x is on the Hub, and no run directory"),
        (lambda run: lem.evaluate(run, env_kwargs=3), "env_kwargs must be a dictionary"),
        (lambda run: lem.evaluate(run, env_kwargs="x"), "env_kwargs must be a dictionary"),
        (lambda run: lem.evaluate(run, video=3), "video must be a path, such as 'video.gif', not 3"),
        (lambda run: lem.evaluate(run, backend=3), "There is no backend 3"),
        (lambda run: lem.watch(run, env_kwargs="x", video="video.gif"), "env_kwargs must be a dictionary"),
        (lambda run: lem.watch(run, video=3), "video must be a path, such as 'video.gif', not 3"),
        (lambda run: lem.watch(env=Unseen, random=True, video="video.gif"), r"renders no pictures: render\(\) .* None"),
        (lambda run: lem.watch(env=Unseen, env_kwargs={"picture": 0.5}, random=True, video="video.gif"), "renders no pictures: .*float64"),
        (lambda run: lem.train("ppo", Unseen, video_every=64), "renders no pictures"),
        (lambda run: lem.save(run, None), "A run is a directory, .* not None"),
        (lambda run: lem.make_vec("CartPole-v1", 0), "num_envs must be a whole number from 1 to 1,000,000, not 0"),
        (lambda run: lem.make_vec("CartPole-v1", 2.5), "num_envs must be a whole number from 1 to 1,000,000, not 2.5"),
        (lambda run: lem.make_vec("CartPole-v1", "3"), "num_envs must be a whole number from 1 to 1,000,000, not '3'"),
        (lambda run: lem.make_vec("CartPole-v1", wrappers="a_:b"), "a_:b cannot be found: there is no module a_"),
        (lambda run: lem.train("ppo", gym.spec("CartPole-v1")), "env is the EnvSpec of CartPole-v1; give its class, its id"),
        (lambda run: lem.make_vec("CartPole-v1", wrappers=3), "wrappers must be several, .* not 3"),
        (lambda run: lem.make_vec("CartPole-v1", backend=3), "There is no backend 3"),
        (lambda run: run.policy.act(np.zeros(4), action_mask=[1, 0]), "CartPole-v1 has no action mask"),
        (lambda run: lem.train("ppo", "CartPole-v1", callbacks=[3]), "A callback must be a function of"),
        (lambda run: lem.evaluate(run, video=run.path.with_suffix(".gif") / "x.gif"), "cannot be written: .*gif is a file"),
        (lambda run: lem.evaluate(run, video=run.path.with_suffix(".mp4")), "mp4 is a folder; name a file in it"),
        (lambda run: lem.evaluate(run, video="/proc/none/video.gif"), "/proc/none/video.gif cannot be written"),
        (lambda run: lem.evaluate(run, deterministic="no"), "deterministic must be True or False, not 'no'"),
        (lambda run: lem.watch(run, deterministic=1, video="video.gif"), "deterministic must be True or False, not 1"),
        (lambda run: run.policy.act(np.zeros(4), deterministic="no"), "deterministic must be True or False, not 'no'"),
        (lambda run: lem.evaluate(run, normalized_actions="yes"), "normalized_actions must be True or False or None, not 'yes'"),
        (lambda run: lem.watch(run, normalized_actions="no"), "normalized_actions must be True or False or None, not 'no'"),
        (lambda run: lem.train("ppo", "CartPole-v1", track=Closing), "the class Closing is no logger: that has write"),
        (lambda run: lem.train("ppo", "CartPole-v1", track=lambda path: None), r"track must be made as Class\(path, config, step\), which lambda"),
        (lambda run: lem.load(""), "A run is a directory, .* not ''"),
        (lambda run: lem.evaluate(run, report=run.path / "config.json"), "report is a directory, .*config.json is a file"),
        (lambda run: lem.evaluate(run, report=run.path / "config.json/x"), "report is a directory, .*config.json is a file"),
        (lambda run: lem.train("ppo", "CartPole-v1", run=run.path / "config.json"), "config.json is a file, and a run is a dir"),
        (lambda run: lem.train("ppo", "CartPole-v1", run=run.path / "config.json/x"), "config.json is a file, and a run is"),
        (lambda run: lem.train("ppo", "./here:Env"), "names a file; name its module, without folder and ending, .*: here:Env"),
        (lambda run: lem.train("ppo", "CartPole-v1", network=torch.nn.Linear(4, 2)), "network is a Linear that is made already"),
        (lambda run: lem.train("ppo", "CartPole-v1", network=Remembers), "sets its memory_size too late; it must stand in the class"),
        (lambda run: lem.train("ppo", "CartPole-v1", callbacks=lambda a, b: None), r"\(step, metrics, policy\), not lambda\(a, b\)"),
        (lambda run: lem.train("pqn", Several), "has actions of kind MultiDiscrete; .* ppo learns here"),
        (lambda run: lem.evaluate(run, env="Acrobot-v1"), r"cannot act in Acrobot-v1: it observes 4 numbers \(obs 4\) and acts by Discrete\(2\); there it would observe 6 numbers \(obs 6\) and act by Discrete\(3\)"),
        (lambda run: lem.train("ppo", Blank, video_every=64), r"cannot be shown here: it has no render\(\) that returns a picture"),
        (lambda run: lem.make_envs("CartPole-v1"), "make_envs needs a Config, .* not 'CartPole-v1'"),
    ],
)  # fmt: skip
def test_a_mistake_is_one_sentence(run, call, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match=said):
        call(run)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", [np.int64, np.float32, torch.tensor, float])
def test_whole_numbers_of_any_kind_are_taken(run, kind):
    assert lem.evaluate(run, episodes=kind(2), seed=kind(3)) == lem.evaluate(run, episodes=2, seed=3)
    lem.set_seeds(kind(3))
    assert torch.initial_seed() == 3


def test_a_config_knows_its_algorithm(run, tmp_path):
    config = lem.config_for(run.policy.config, seed=np.int64(2))
    again = lem.train(config, run=tmp_path / "again", progress=False)
    assert again.policy.config == run.policy.config.replace(seed=2)
    warm = lem.train(config, run=tmp_path / "warm", warm_start=run, device=torch.device("cpu"), progress=False)
    assert warm.policy.config.warm_start == str(run.path)
    other = lem.train(config, Sized, run=tmp_path / "other", progress=False, env_kwargs={"size": 1})
    assert other.policy.config.env == "test_misuse:Sized"


def test_a_finished_run_is_left_as_it_is(run, capsys):
    before = tree(run.path)
    again = lem.resume(run)
    assert tree(run.path) == before
    assert capsys.readouterr().err == f"{run.path} is finished, at step 64: there is nothing to resume.\n"
    assert again.seconds == 0
    assert main(["resume", str(run.path)]) == 0
    assert capsys.readouterr().err.count("\n") == 1
    assert tree(run.path) == before


def test_a_finished_run_is_reported_again(run, capsys):
    lem.resume(run, report=True)
    assert "return over 100 episodes" in capsys.readouterr().err


def test_a_path_with_spaces_is_quoted_where_it_is_to_be_typed(run):
    with pytest.raises(UserError, match=f"lemniscate resume '{run.path}'"):
        lem.train("ppo", "CartPole-v1", run=run.path)


@pytest.mark.parametrize(
    ("obs", "said"),
    [
        ([np.nan, 0, 0, 0], "CartPole-v1 has a number that is nan; all must be finite"),
        ([[0, 0, 0, 0], [0, -np.inf, 0, 0]], "has a number that is -inf"),
        (np.zeros((2, 5, 4)), r"observes obs \(4,\), or a batch of these; .*: obs has the shape \(2, 5, 4\)"),
        (np.zeros(8), r"obs has the shape \(8,\)"),
        (np.zeros((2, 2)), r"obs has the shape \(2, 2\)"),
        (None, r"obs has the shape \(\)"),
        ("left", "its numbers are texts"),
        ((np.zeros(4), {}), "it is what `reset` or `step` returned"),
    ],
)
def test_what_is_no_observation_is_refused(run, obs, said):
    with pytest.raises(UserError, match=said):
        run.policy.act(obs)


@pytest.mark.parametrize(
    ("obs", "said"),
    [
        (np.full((9, 12, 3), 0.5, np.float32), "its numbers are float32; those of an image are whole, from 0 to 255"),
        (np.full((2, 9, 12, 3), np.nan), "its numbers are float64"),
        (np.full(9 * 12 * 3, 0.5), "its numbers are float64"),
        (np.full((9, 12, 3), 256), "its numbers are from 256 to 256; those of an image are whole, from 0 to 255"),
        (np.full((9, 12, 3), -1), "its numbers are from -1 to -1"),
    ],
)
def test_what_is_no_image_of_bytes_is_refused(obs, said):
    spec = registry.make("Copy-image-v0", 1).spec
    with pytest.raises(UserError, match=f"Copy-image-v0 observes .*: {said}"):
        read_observation(spec, obs)
    for kind in (np.uint8, np.int64, list):
        image = np.full((9, 12, 3), 200)
        flat, batched = read_observation(spec, image.tolist() if kind is list else image.astype(kind))
        assert (flat.dtype, flat[0, 0], batched) == (np.uint8, 200, False)


@pytest.mark.parametrize("backend", ["gymnasium", "envpool"])
@pytest.mark.parametrize(
    ("action", "said"),
    [
        (np.zeros(4, np.int64), r"actions are a Tensor \[4\] of torch.int64, not ndarray \[4\] of int64"),
        ([0, 0, 0, 0], r"not \[0, 0, 0, 0\]"),
        (torch.zeros(3, dtype=torch.int64), r"not Tensor \[3\] of torch.int64"),
        (torch.zeros(4), r"not Tensor \[4\] of torch.float32"),
        (torch.tensor([0, 1, 2, 0]), "whole numbers from 0 to below 2, not 2"),
        (torch.tensor([0, 1, -1, 0]), "whole numbers from 0 to below 2, not -1"),
    ],
)
def test_no_wrong_action_reaches_a_simulator(backend, action, said):
    env = registry.make("CartPole-v1", 4, backend=backend)
    with pytest.raises(UserError, match=r"call restart\(seed\) before the first step"):
        env.step(torch.zeros(4, dtype=torch.int64))
    env.restart(0)
    with pytest.raises(UserError, match=said):
        env.step(action)
    env.step(torch.zeros(4, dtype=torch.int64))
    env.close()


def test_a_missing_module_is_named_with_where_it_is_looked_for(run):
    config = run.policy.config.replace(env="nowhere_to_be_found:Env")
    with pytest.raises(UserError, match=r"no module nowhere_to_be_found here; run in its folder, or add .* PYTHONPATH"):
        lem.train(config)


def test_the_install_line_of_an_extra_works_in_a_clone():
    assert str(missing_extra("crazyflow", "drone")).endswith("pip install '.[drone]'")


def test_values_are_shown_short():
    said = ["'3'", "None", "[1]", repr("x" * 56 + "…"), "a module"]
    assert [shown(x) for x in ("3", None, [1], "x" * 99, gym)] == said


def test_a_run_stays_where_it_began_where_the_working_directory_changes(tmp_path, monkeypatch):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(tmp_path)
    fields = tiny_fields("CartPole-v1", total_steps=128, checkpoint_every=64)
    trained = lem.train(
        "ppo", "CartPole-v1", run="r", callbacks=lambda *a: os.chdir(elsewhere), progress=False, **fields
    )
    assert not list(elsewhere.iterdir())
    assert lem.load(trained.path).step == lem.load(tmp_path / "r").step == 128


class Moves(gym.Env):
    """Changes the working directory and torch's defaults as it is made."""

    observation_space = gym.spaces.Box(-1, 1, (2,))
    action_space = gym.spaces.Discrete(2)

    def __init__(self, to):
        os.chdir(to)
        torch.set_default_dtype(torch.float64)
        torch.set_grad_enabled(False)

    def reset(self, *, seed=None, options=None):
        return np.zeros(2, np.float32), {}

    def step(self, action):
        return np.zeros(2, np.float32), 1.0, False, True, {}


def test_an_environment_that_moves_to_its_files_leaves_the_run_where_it_belongs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "elsewhere").mkdir()
    fields = tiny_fields("CartPole-v1", total_steps=128)
    fields |= {"env_kwargs": {"to": str(tmp_path / "elsewhere")}}
    trained = lem.train("ppo", Moves, run="r", progress=False, **fields)
    assert trained.path == tmp_path / "r"
    assert lem.load(tmp_path / "r").step == 128
    assert not list((tmp_path / "elsewhere").iterdir())
    assert torch.is_grad_enabled()
    assert torch.get_default_dtype() == torch.float32


def test_what_lies_beside_a_stored_policy_is_not_lost(run, tmp_path):
    lem.save(run, tmp_path / "p")
    lem.save(run, tmp_path / "p")
    (tmp_path / "p" / "notes.txt").touch()
    with pytest.raises(UserError, match=r"holds notes\.txt beside a stored policy, which would be lost"):
        lem.save(run, tmp_path / "p")


OWN = Path(__file__).parents[1] / "examples" / "own_algorithm.py"
TORCHS = "optimizer = torch.optim.Adam(networks.parameters())"
LEFT = "left the loop of run.until at step 64 of 256, where its policy is stored: to stop a run, let a callback return"
LOST = "must begin with state = run.restore"
MISTAKES = {
    # change of an algorithm of one's own: what is said
    "no loss": (
        ("    return policy_loss + config.beta", "    policy_loss + config.beta"),
        "A loss must return a scalar that",
    ),
    "detached": (
        ("return policy_loss + config.beta * kl + critic_loss, {", "return policy_loss.detach(), {"),
        "A loss must r",
    ),
    "loss of each row": (
        ("return policy_loss + config.beta * kl + critic_loss, {", "return log_ratio, {"),
        "A loss must ret",
    ),
    "no metrics": (
        ("    return means(metrics)\n", "    return None\n"),
        "is given None; metrics are scalars by their names",
    ),
    "a text": (
        ("    return means(metrics)\n", "    return {'a': 'x'}\n"),
        "is given {'a': 'x'}; metrics are scalars by",
    ),
    "half a step": (
        ("state.step += config.num_rows", "state.step += config.num_rows / 2"),
        "it must be a whole number of Py",
    ),
    "torch's Adam": (
        ("optimizer = Adam(networks, max_grad_norm=1.0)\n    optimizer.learning_rate = config.learning_rate", TORCHS),
        "State.optimizer is an Adam, whose state_dict has 'state', no tensor: optimizers are those of lemniscate.optim.adam",
    ),
    "a function": (
        ("    optimizer: Adam\n", "    optimizer: Adam\n    f: object = print\n"),
        "State.f is print.*: a field of a St",
    ),
    "a set": (
        ("    beta: NonNegative = 3.0\n", "    some: frozenset = frozenset()\n    beta: NonNegative = 3.0\n"),
        "A field of .*Config cannot be stored: .*frozenset",
    ),
    "a tuple for a preset": (
        ("PRESETS = [", "PRESETS = [(1, 2), "),
        "PRESETS of .* must be a list of Preset.name, config,",
    ),
    "left early": (
        ("        rollout = collect(", "        if state.step:\n            break\n        rollout = collect("),
        LEFT,
    ),
    "no restore": (
        ("run.restore(init(config, run.spec, run.env.device))", "init(config, run.spec, run.env.device)"),
        LOST,
    ),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_in_an_algorithm_of_ones_own_is_one_sentence(name, tmp_path, monkeypatch):
    (before, after), said = MISTAKES[name]
    text = OWN.read_text()
    assert text.count(before) == 1
    module = f"own_{list(MISTAKES).index(name)}"
    (tmp_path / f"{module}.py").write_text(text.replace(before, after))
    monkeypatch.syspath_prepend(tmp_path)
    sizes = {"num_envs": 2, "num_steps": 32, "minibatch_size": 64, "total_steps": 256}
    with pytest.raises(UserError, match=said):
        lem.train(module, "CartPole-v1", run=tmp_path / "run", progress=False, **sizes)


def test_a_logger_cannot_empty_what_others_get(tmp_path):
    class Empties:
        def __init__(self, *_):
            pass

        def write(self, step, metrics, episodes=None):
            metrics.clear()

        def close(self, pictures): ...

    seen = []
    sizes = {"num_envs": 2, "num_steps": 32, "minibatch_size": 64, "total_steps": 64}
    callbacks = [lambda step, metrics, policy: seen.append(len(metrics))]
    lem.train("ppo", "CartPole-v1", run=tmp_path / "run", track=Empties, callbacks=callbacks, progress=False, **sizes)
    assert seen
    assert min(seen) > 5


def test_what_an_algorithm_learned_that_left_its_loop_is_stored(tmp_path, monkeypatch):
    early = "        if state.step:\n            return state\n        rollout = collect("
    (tmp_path / "own_early.py").write_text(OWN.read_text().replace("        rollout = collect(", early))
    monkeypatch.syspath_prepend(tmp_path)
    sizes = {"num_envs": 2, "num_steps": 32, "minibatch_size": 64, "total_steps": 256}
    with pytest.raises(UserError, match=r"left the loop of run\.until at step 64 of 256, where its policy is stored"):
        lem.train("own_early", "CartPole-v1", run=tmp_path / "run", progress=False, **sizes)
    assert lem.load(tmp_path / "run").step == 64
