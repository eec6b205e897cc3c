"""The front door, from Python."""

import json
import re
import subprocess
import sys
import threading
import warnings
from contextlib import contextmanager, nullcontext
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch

import lemniscate as lem
from conftest import tiny_fields
from lemniscate.envs import registry
from lemniscate.envs.vector_view import action_space
from lemniscate.run.checkpoint import list_steps
from lemniscate.spec import Box, ObservationPart, Spec


@pytest.fixture(scope="module")
def cartpole(tmp_path_factory):
    path = tmp_path_factory.mktemp("runs") / "cartpole"
    return lem.train("ppo", "CartPole-v1", run=path, progress=False, **tiny_fields("CartPole-v1"))


@pytest.fixture(scope="module")
def pendulum(tmp_path_factory):
    path = tmp_path_factory.mktemp("runs") / "pendulum"
    return lem.train("ppo", "Pendulum-v1", run=path, progress=False, **tiny_fields("Pendulum-v1"))


def test_a_run_directory_holds_what_is_promised(cartpole):
    names = {p.name for p in cartpole.path.iterdir()}
    assert {"config.json", "metrics.jsonl", "checkpoints"} <= names
    assert len(list(cartpole.path.glob("events.out.tfevents.*"))) == 1
    record = json.loads((cartpole.path / "config.json").read_text())
    assert record["algorithm"] == "ppo"
    assert record["config"]["env"] == "CartPole-v1"
    lines = [json.loads(line) for line in (cartpole.path / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == list(range(32, 257, 32))
    watched = {"losses/policy", "losses/value", "losses/entropy", "approx_kl", "old_approx_kl", "clip_fraction"}
    assert watched | {"explained_variance", "gradient_norm", "learning_rate"} <= set(lines[0])


def test_tensorboard_holds_the_metrics_and_the_config(cartpole):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(cartpole.path)).Reload()
    assert "losses/policy" in events.Tags()["scalars"]
    assert len(events.Scalars("losses/policy")) == 8
    text = events.Tensors("config/text_summary")[0].tensor_proto.string_val[0].decode()
    assert "|gamma|0.99|" in text


def test_a_discrete_policy_acts_on_one_observation_and_on_a_batch(cartpole):
    policy = lem.load(cartpole.path)
    env = gym.make("CartPole-v1")
    obs, _ = env.reset(seed=0)
    action = policy.act(obs)
    env.step(action)
    assert np.shape(action) == ()
    assert policy.act(np.stack([obs] * 3)).shape == (3,)
    assert policy.act(obs[None]).shape == (1,)


def test_a_box_policy_acts_in_physical_units(pendulum):
    policy = lem.load(pendulum.path)
    env = gym.make("Pendulum-v1")
    obs, _ = env.reset(seed=0)
    noisy = np.stack([policy.act(obs, deterministic=False) for _ in range(50)])
    assert noisy.shape == (50, 1)
    assert np.abs(noisy).max() <= 2.0
    assert np.abs(noisy).max() > 1.0
    env.step(policy.act(obs))


def test_loading_gives_the_policy_that_was_trained(pendulum):
    loaded = lem.load(pendulum.path)
    obs = np.random.default_rng(0).normal(size=(20, 3)).astype(np.float32)
    np.testing.assert_array_equal(loaded.act(obs), pendulum.policy.act(obs))
    assert loaded.step == 256
    first = list_steps(pendulum.path / "checkpoints")[0]
    assert lem.load(pendulum.path / "checkpoints" / f"step-{first}").step == first


def test_a_policy_acts_on_discrete_observations(tmp_path):
    run = lem.train("ppo", "FrozenLake-v1", run=tmp_path / "r", progress=False, **tiny_fields("FrozenLake-v1"))
    env = gym.make("FrozenLake-v1")
    obs, _ = env.reset(seed=0)
    env.step(int(run.policy.act(obs)))
    assert run.policy.act(np.array([0, 5, 15])).shape == (3,)


def test_a_batch_of_as_many_numbers_as_there_are_kinds_is_a_batch(tmp_path):
    """Sixteen observations of a Discrete(16) are not one observation that is one-hot."""
    policy = lem.train("ppo", "FrozenLake-v1", run=tmp_path / "run", progress=False, total_steps=2048).policy
    assert policy.act(np.arange(16)).shape == (16,)
    assert policy.act(np.eye(16, dtype=np.float32)).shape == (16,)
    assert policy.act(np.eye(16, dtype=np.float32)[3]) == policy.act(3)


@pytest.mark.parametrize(
    ("trained_by", "installed", "evaluated_by"),
    [
        ("gymnasium", True, "gymnasium"),
        ("gymnasium-async", True, "gymnasium"),
        ("envpool", True, "envpool"),
        ("envpool", False, None),
    ],
)
def test_a_policy_is_evaluated_by_the_simulator_that_trained_it(
    cartpole, monkeypatch, trained_by, installed, evaluated_by
):
    """But without workers, and by what there is where EnvPool is not."""
    asked = []
    make = registry.make
    monkeypatch.setattr(
        registry, "make", lambda *a, **k: asked.append(k["backend"]) or make(*a, **{**k, "backend": None})
    )
    monkeypatch.setattr("lemniscate.envs.registry.is_installed", lambda _: installed)
    policy = lem.load(cartpole.path)
    policy.config = policy.config.replace(backend=trained_by)
    lem.evaluate(policy, episodes=2)
    lem.evaluate(policy, episodes=2, backend="gymnasium")
    lem.evaluate(policy, "CartPole-v1", episodes=2)
    assert asked == [evaluated_by, "gymnasium", None]


def test_an_environment_whose_package_is_missing_is_said(monkeypatch):
    def missing(*_, **__):
        raise gym.error.DependencyNotInstalled("Box2D is not installed, run `pip install swig`")

    monkeypatch.setattr(gym, "make", missing)
    with pytest.raises(lem.UserError, match="CartPole-v1 cannot be made: Box2D is not installed"):
        lem.train("ppo", "CartPole-v1", backend="gymnasium")


def test_an_observation_of_the_wrong_size_is_named(cartpole):
    with pytest.raises(lem.UserError, match=r"CartPole-v1 observes obs \(4,\), or a batch of these"):
        cartpole.policy.act(np.zeros(3))


def test_evaluate(cartpole):
    scores = lem.evaluate(cartpole.policy, episodes=5, seed=0)
    assert scores.episodes == len(scores.returns) == 5
    assert scores.returns == [float(length) for length in scores.lengths]
    assert lem.evaluate(cartpole.policy, env="CartPole-v1", episodes=5, seed=0) == scores
    with pytest.raises(lem.UserError, match="cannot act in Pendulum-v1"):
        lem.evaluate(cartpole.policy, env="Pendulum-v1", episodes=2)
    with pytest.raises(lem.UserError, match="episodes must be"):
        lem.evaluate(cartpole.policy, episodes=0)
    with pytest.raises(lem.UserError, match="seed must be"):
        lem.evaluate(cartpole.policy, seed=-1)


@pytest.mark.parametrize(
    ("arguments", "fields", "said"),
    [
        (("pop", "CartPole-v1"), {}, "no algorithm 'pop': did you mean ppo"),
        (("ppo",), {}, "Which environment"),
        (("ppo", "CartPol-v1"), {}, "did you mean CartPole-v1"),
        (("ppo", "CartPole-v1"), {"preset": "cours"}, "did you mean course"),
        (("ppo", "CartPole-v1"), {"gama": 0.9}, "no field 'gama': did you mean gamma"),
        (("ppo", "CartPole-v1"), {"gamma": 2}, "gamma must be a number from 0 to 1, not 2"),
        (("ppo", "CartPole-v1"), {"track": "wandbb"}, "did you mean wandb"),
        (("ppo", "CartPole-v1"), {"device": "cuda"}, "torch sees no GPU"),
        (("ppo", "CartPole-v1"), {"backend": "crazyflow"}, "cannot be served"),
    ],
)
@pytest.mark.skipif(torch.cuda.is_available(), reason="one of these is about its absence")
def test_a_mistake_is_one_sentence_and_leaves_nothing_behind(tmp_path, arguments, fields, said):
    with pytest.raises(lem.UserError, match=said):
        lem.train(*arguments, run=tmp_path / "r", **fields)
    assert not (tmp_path / "r").exists()


class Counted(gym.Env):
    """Counts those that are open; the fifth cannot be made."""

    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gym.spaces.Discrete(2)
    open = 0

    def __init__(self, most=None, render_mode=None):
        if Counted.open == most:
            raise ValueError("no more of these")
        Counted.open += 1

    def reset(self, *, seed=None, options=None):
        return np.zeros(2, np.float32), {}

    def close(self):
        Counted.open -= 1


@pytest.mark.parametrize("fields", [{"callbacks": [3]}, {"video_every": 64}, {"env_kwargs": {"most": 4}}])
def test_after_a_mistake_no_environment_is_left_open(tmp_path, fields):
    with pytest.raises(lem.UserError):
        lem.train("ppo", Counted, run=tmp_path / "r", **tiny_fields() | fields)
    assert Counted.open == 0


def test_a_run_that_exists_is_refused(cartpole):
    with pytest.raises(lem.UserError, match="exists already"):
        lem.train("ppo", "CartPole-v1", run=cartpole.path)


def test_without_a_name_runs_are_numbered(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    paths = [lem.train("ppo", "Countdown-v0", progress=False, **tiny_fields()).path for _ in range(2)]
    assert [path.name for path in paths] == ["Countdown-v0-ppo-1", "Countdown-v0-ppo-1-2"]


def test_resuming_a_finished_run_changes_nothing(cartpole):
    before = (cartpole.path / "metrics.jsonl").read_text()
    assert lem.resume(cartpole.path, progress=False).policy.step == 256
    assert (cartpole.path / "metrics.jsonl").read_text() == before


def test_what_is_not_a_run_is_said(tmp_path):
    for use in (lem.load, lem.resume):
        with pytest.raises(lem.UserError, match="is not a run directory"):
            use(tmp_path)


def test_wandb_missing_is_said_with_its_install_line(tmp_path, monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(lem.UserError, match=r"pip install '\.\[wandb\]'"):
        lem.train("ppo", "Countdown-v0", run=tmp_path / "r", track="wandb", progress=False, **tiny_fields())


def test_set_seeds_covers_every_generator():
    import random

    lem.set_seeds(42)
    assert random.randint(0, 9999) == 1824
    assert np.random.randint(0, 9999) == 7270  # noqa: NPY002
    assert torch.initial_seed() == 42
    assert torch.backends.cudnn.deterministic
    assert not torch.backends.cudnn.benchmark
    first = torch.rand(3)
    lem.set_seeds(42)
    assert torch.equal(first, torch.rand(3))


def test_the_public_names_are_sorted_and_exist():
    assert lem.__all__ == sorted(lem.__all__)
    assert all(hasattr(lem, name) for name in lem.__all__)


EVERYTHING = """
import pkgutil
import lemniscate as lem
from importlib import import_module

def require_meanings():
    for module, names in lem.MODULES.items():
        for name in names:
            assert getattr(lem, name) is getattr(import_module(f"lemniscate.{module}"), name), name
            assert callable(getattr(lem, name)), name

for found in pkgutil.walk_packages(lem.__path__, "lemniscate."):
    if not found.name.endswith("__main__"):
        try:
            import_module(found.name)
        except ImportError as error:  # of an extra
            assert not str(error.name).startswith("lemniscate"), error
require_meanings()
for found in pkgutil.iter_modules(lem.__path__):
    assert found.name == "__main__" or not hasattr(lem, found.name) or found.name not in lem.__all__, found.name
"""


def test_a_public_name_means_the_same_whatever_was_imported_before():
    """Every module is imported first; a verb that a module of its name hid would show."""
    subprocess.run([sys.executable, "-c", EVERYTHING], check=True)
    first = "import lemniscate.system.watchdog, lemniscate as lem; assert callable(lem.watch)"
    subprocess.run([sys.executable, "-c", first], check=True)


def test_a_config_has_dot_access_and_is_frozen():
    config = lem.config_for("ppo", "CartPole-v1", seed=7)
    assert config.seed == 7
    with pytest.raises(AttributeError):
        config.seed = 8


def test_a_policy_says_its_probabilities_and_its_value(cartpole):
    policy, obs = lem.load(cartpole.path), np.random.default_rng(0).normal(size=(5, 4)).astype(np.float32)
    found, values = policy.distribution(obs), policy.value(obs)
    assert (found.probabilities.shape, values.shape, found.mean, found.std) == ((5, 2), (5,), None, None)
    np.testing.assert_allclose(found.probabilities.sum(-1), 1, rtol=1e-5)
    np.testing.assert_array_equal(found.probabilities.argmax(-1), policy.act(obs))
    with torch.no_grad():
        np.testing.assert_array_equal(values, policy.networks.value(torch.from_numpy(obs)).numpy())
    one = policy.distribution(obs[2])
    np.testing.assert_allclose(one.probabilities, found.probabilities[2], rtol=1e-5)
    np.testing.assert_allclose(policy.value(obs[2]), values[2], rtol=1e-5)
    with pytest.raises(
        lem.UserError, match=r"of ppo has learned no policy.q_value\(obs, action\); it has policy.value"
    ):
        policy.q_value(obs, policy.act(obs))
    told = lem.TrainedPolicy(policy.networks, replace(policy.spec, privileged=2), policy.config, 0)
    with pytest.raises(lem.UserError, match=r"policy.value\(obs\) takes 2 privileged numbers, which no observation"):
        told.value(obs)
    with pytest.raises(lem.UserError, match="has no action mask"):
        policy.distribution(obs[0], action_mask=[1, 0])


def test_mean_and_std_are_in_the_units_of_the_environment(pendulum):
    """Pendulum's torque is from -2 to 2, so a unit of the policy is two of its own."""
    policy, obs = lem.load(pendulum.path), np.zeros((3, 3), np.float32)
    found = policy.distribution(obs)
    assert found.mean.shape == found.std.shape == (3, 1)
    assert found.probabilities is None
    np.testing.assert_allclose(found.std, 2 * policy.module.log_std.detach().exp().numpy() * np.ones((3, 1)), rtol=1e-4)
    np.testing.assert_allclose(found.mean.clip(-2, 2), policy.act(obs), rtol=1e-4, atol=1e-6)


class Switches(gym.Env):
    """Two switches, on or off."""

    observation_space = gym.spaces.Dict({"o": gym.spaces.Box(-1, 1, (3,))})
    action_space = gym.spaces.Box(0, 1, (2,), bool)


def test_q_takes_the_switches_that_act_returns_and_an_array_is_no_dictionary():
    config = lem.config_for("ddpg", "Pendulum-v1", hidden=(8,), critic_hidden=(8,))
    env = registry.make(Switches, 1)
    policy = lem.TrainedPolicy(config.networks(env.spec), env.spec, config, 0)
    env.close()
    obs = {"o": np.zeros(3, np.float32)}
    assert policy.act(obs).dtype == bool
    assert np.isfinite(policy.q_value(obs, policy.act(obs)))
    with pytest.raises(lem.UserError, match="its parts are to be in a dictionary or a tuple"):
        policy.act(np.zeros(5, np.float32))


@pytest.mark.parametrize("algorithm", ["reppo", "sac", "ddpg"])
def test_a_policy_says_the_q_of_an_action_in_the_units_of_the_environment(algorithm, tmp_path):
    config = lem.config_for(algorithm, "Pendulum-v1", hidden=(8,), critic_hidden=(8,))
    env = registry.make("Pendulum-v1", 1)
    policy = lem.TrainedPolicy(config.networks(env.spec), env.spec, config, 0)
    env.close()
    obs, action = np.random.default_rng(0).normal(size=(4, 3)).astype(np.float32), np.linspace(-2, 2, 4)[:, None]
    with torch.no_grad():
        expected = policy.networks.q(torch.from_numpy(obs), torch.from_numpy(action).float() / 2).numpy()
    np.testing.assert_allclose(policy.q_value(obs, action), expected, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(policy.q_value(obs[1], action[1]), expected[1], rtol=1e-4, atol=1e-6)
    for wrong in (action[0], action[:, 0], action * np.nan):
        with pytest.raises(lem.UserError, match=r"action must be finite numbers of the shape \(4, 1\)"):
            policy.q_value(obs, wrong)
    with pytest.raises(
        lem.UserError, match=rf"of {algorithm} has learned no policy.value\(obs\); it has policy.q_value"
    ):
        policy.value(obs)


def test_q_of_an_action_without_a_shape_is_that_of_its_one_number():
    config = lem.config_for("td3", "Pendulum-v1", hidden=(8,), critic_hidden=(8,))
    spec = Spec("x", (ObservationPart((), (3,)),), Box((-2.0,), (2.0,), shape=()))
    policy, obs = lem.TrainedPolicy(config.networks(spec), spec, config, 0), np.ones((2, 3), np.float32)
    assert policy.act(obs[0]).shape == ()
    of_each, of_one = policy.q_value(obs, policy.act(obs)), policy.q_value(obs[0], policy.act(obs[0]))
    np.testing.assert_allclose(of_each, [of_one, of_one], rtol=1e-5)
    assert action_space(spec.action) == gym.spaces.Box(-2, 2, (), np.float32)


def test_q_of_a_choice_is_that_of_its_number(tmp_path):
    config = lem.config_for("pqn", "CartPole-v1", hidden=(8,))
    env = registry.make("CartPole-v1", 1)
    policy = lem.TrainedPolicy(config.networks(env.spec), env.spec, config, 0)
    env.close()
    obs, action = np.random.default_rng(0).normal(size=(3, 4)).astype(np.float32), np.array([0, 1, 1])
    with torch.no_grad():
        values = policy.module(torch.from_numpy(obs)).values.numpy()
    np.testing.assert_allclose(policy.q_value(obs, action), values[[0, 1, 2], action], rtol=1e-5)
    assert policy.q_value(obs[0], policy.act(obs[0])) == pytest.approx(values[0].max(), rel=1e-5)
    np.testing.assert_allclose(policy.value(obs), values.max(-1), rtol=1e-5)
    policy.module.epsilon.fill_(0.2)
    found = policy.distribution(obs).probabilities
    np.testing.assert_allclose(np.sort(found, axis=-1), [[0.1, 0.9]] * 3, rtol=1e-5)
    np.testing.assert_array_equal(found.argmax(-1), policy.act(obs))
    with pytest.raises(lem.UserError, match="action must be from 0 to below 2, not 2"):
        policy.q_value(obs[0], 2)
    with pytest.raises(lem.UserError, match=r"action must be whole numbers of the shape \(\), not 'left'"):
        policy.q_value(obs[0], "left")


def test_a_second_thread_does_not_train_at_the_same_time(tmp_path):
    begun, over, said = threading.Event(), threading.Event(), []

    def waiting(step, metrics, policy):
        begun.set()
        assert over.wait(60)
        nested = lem.train("ppo", "CartPole-v1", run=tmp_path / "nested", progress=False, **tiny_fields())
        return nested.policy.step == 0

    fields = {"progress": False, **tiny_fields(total_steps=32)}
    first = threading.Thread(
        target=lambda: said.append(lem.train("ppo", "CartPole-v1", run=tmp_path / "a", callbacks=[waiting], **fields))
    )
    first.start()
    assert begun.wait(60)
    try:
        with pytest.raises(lem.UserError, match="Another thread of this process is training"):
            lem.train("ppo", "CartPole-v1", run=tmp_path / "b", **fields)
    finally:
        over.set()
        first.join(60)
    assert said[0].policy.step == 32
    lem.train("ppo", "CartPole-v1", run=tmp_path / "b", **fields)


@contextmanager
def as_default(setter, value, before):
    setter(value)
    try:
        yield
    finally:
        setter(before)


SETTINGS = {
    "nothing": nullcontext,
    "float64": lambda: as_default(torch.set_default_dtype, torch.float64, torch.float32),
    "device": lambda: as_default(torch.set_default_device, "meta", None),
    "inner device": lambda: torch.device("meta"),
    "no_grad": torch.no_grad,
    "inference_mode": torch.inference_mode,
    "set_grad_enabled": lambda: as_default(torch.set_grad_enabled, False, True),
    "autocast": lambda: torch.autocast("cpu", dtype=torch.bfloat16),
    "threads": lambda: as_default(torch.set_num_threads, 2, torch.get_num_threads()),
}


def settings_of_torch():
    return (
        torch.get_default_dtype(),
        torch.get_default_device(),
        torch.is_grad_enabled(),
        torch.is_inference_mode_enabled(),
        torch.is_autocast_enabled("cpu"),
        torch.get_num_threads(),
    )


def test_what_the_caller_has_set_in_torch_changes_nothing_and_stays(tmp_path):
    """Training, a resume, loading, acting and evaluation: the same numbers under every setting."""
    found, longer = {}, {"total_steps": 288, "progress": False}
    for name, setting in SETTINGS.items():
        with setting():
            before = settings_of_torch()
            run = lem.train("ppo", "Pendulum-v1", run=tmp_path / name, **tiny_fields("Pendulum-v1"), progress=False)
            assert lem.resume(run.path, **longer).policy.step == 288
            policy = lem.load(run.path)
            actions = policy.act(np.zeros((2, 3)), deterministic=False)
            scores = lem.evaluate(policy, episodes=2, seed=0, deterministic=False).returns
            assert settings_of_torch() == before
        found[name] = actions.tolist(), scores, actions.dtype
    assert all(each == found["nothing"] for each in found.values())


@pytest.mark.long
def test_what_the_caller_has_set_in_torch_does_not_reach_what_looks_at_a_policy(cartpole, pendulum, tmp_path):
    """What a policy says of itself, a video, and the check of a whole environment, each under every setting."""
    critic = lem.config_for("ddpg", "Pendulum-v1", hidden=(8,), critic_hidden=(8,))
    learned = lem.TrainedPolicy(critic.networks(pendulum.policy.spec), pendulum.policy.spec, critic, 0)
    obs, found = np.linspace(-1, 1, 6).reshape(2, 3), {}
    for name, setting in SETTINGS.items():
        with setting():
            before = settings_of_torch()
            said = pendulum.policy.distribution(obs), pendulum.policy.value(obs), learned.q_value(obs, np.ones((2, 1)))
            video = lem.watch(cartpole.policy, seed=1, video=tmp_path / "video.gif")
            checked = [finding.sentence for finding in lem.check("Pendulum-v1", backend="gymnasium")]
            assert settings_of_torch() == before
        numbers = [said[0].mean, said[0].std, *said[1:]]
        found[name] = [each.tolist() for each in numbers], [each.dtype for each in numbers], video.returns, checked
    first = found["nothing"]
    for name, each in found.items():
        assert each[1:3] == first[1:3], name
        assert [re.sub(r"[\d.,]+", "", said) for said in each[3]] == [re.sub(r"[\d.,]+", "", said) for said in first[3]]
        assert each[0] == first[0], name


def test_an_observation_may_be_read_only_or_run_backwards(cartpole):
    obs = np.array([0.1, 0.2, 0.3, 0.4], np.float32)
    expected = cartpole.policy.value(obs[::-1].copy())
    fixed = obs[::-1].copy()
    fixed.setflags(write=False)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert cartpole.policy.value(obs[::-1]) == cartpole.policy.value(fixed) == expected


@pytest.mark.parametrize(
    ("obs", "said"),
    [
        ([10**400] * 4, "cannot be read: .*too large"),
        ([1e39] * 4, "number that is inf"),
        ([1j] * 4, "numbers are complex"),
        (["1", "2", "3", "4"], "numbers are texts"),
        (np.ma.array([1.0, 2.0, 3.0, 4.0], mask=[1, 0, 0, 0]), "some of its numbers are masked"),
    ],
)
def test_numbers_that_float32_cannot_hold_are_said(cartpole, obs, said):
    with pytest.raises(lem.UserError, match=said):
        cartpole.policy.act(obs)
