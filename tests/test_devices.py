"""Every algorithm on a GPU that is not there: no tensor on the wrong device, and the CPU's numbers."""

import importlib
import shutil
import sys
from pathlib import Path
from unittest import mock

import pytest
import torch

import lemniscate as lem
from conftest import tiny, tiny_fields, tiny_off_policy
from lemniscate import algos
from lemniscate.data.replay import interact
from lemniscate.data.rollout import collect, collect_episodes
from lemniscate.envs.backend import Backend
from lemniscate.envs.vec_env import VecEnv
from lemniscate.errors import UserError
from lemniscate.run import checkpoint
from lemniscate.run.environments import device_for
from lemniscate.run.off_policy import has_bfloat16
from lemniscate.spec import Box, Discrete, MultiDiscrete, ObservationPart, Spec
from lemniscate.types import Step
from pretend_device import CPU, pretend, whole

ON_POLICY = {"num_envs": 3, "num_steps": 6, "total_steps": 180, "hidden": (8, 8)}
VALUE = {"critic_epochs": 2, "critic_minibatch_size": 8}
OFF_POLICY = {
    "num_envs": 3,
    "total_steps": 180,
    "log_every": 4,
    "buffer_size": 40,
    "batch_size": 8,
    "learning_starts": 9,
    "num_updates": 2,
    "hidden": (8, 8),
    "critic_hidden": (8, 8),
    "normalize_observations": True,
}
CASES = {
    # name: (actions, settings)
    "reinforce box": ("box", {**ON_POLICY, **VALUE, "scale_rewards": True}),
    "reinforce discrete": ("discrete", {**ON_POLICY, **VALUE}),
    "reinforce episodes": ("box", {**ON_POLICY, "episodes": 1, "baseline": "mean", "returns": "episode"}),
    "a2c box": ("box", ON_POLICY),
    "a2c discrete": ("discrete", ON_POLICY),
    "a2c multi": ("multi", ON_POLICY),
    "trpo box": ("box", {**ON_POLICY, **VALUE}),
    "trpo discrete": ("discrete", {**ON_POLICY, **VALUE}),
    "ppo box": ("box", {**ON_POLICY, "epochs": 2, "minibatch_size": 8, "clip_value": 0.2}),
    "ppo discrete": ("discrete", {**ON_POLICY, "epochs": 2, "minibatch_size": 8, "desired_kl": None}),
    "ppo image": ("image", {**ON_POLICY, "epochs": 1, "minibatch_size": 18}),
    "reppo box": ("box", {**ON_POLICY, "epochs": 2, "minibatch_size": 8}),
    "ddpg box": ("box", {**OFF_POLICY, "action_noise": "ou"}),
    "td3 box": ("box", {**OFF_POLICY, "action_noise": "coloured"}),
    "sac box": ("box", OFF_POLICY),
    "sac bins": ("box", {**OFF_POLICY, "value_range": 5.0, "network": "layer_norm", "unit_weights": True}),
    "sac simba": ("box", {**OFF_POLICY, "network": "simba", "activation": "relu", "matmul": "bfloat16"}),
}
SIBLINGS = ("reinforce discrete", "a2c discrete", "a2c multi", "trpo discrete", "ppo discrete", "sac bins", "sac simba")
"""cases beside one of the same algorithm: only make test-long tries them"""
ACTIONS = {
    "box": Box((-1.0, -1.0), (1.0, 1.0)),
    "discrete": Discrete(3, masked=True),
    "multi": MultiDiscrete((2, 3), (0, 0)),
    "image": Discrete(2),
}


class Noise(Backend):
    """A backend whose observations and rewards are noise, with ends of both kinds and with ignored actions."""

    summaries, scene, baseline = (), None, None

    def __init__(self, actions, num_envs, device):
        image, masked = actions == "image", actions == "discrete"
        layout = (ObservationPart((), (6, 6, 1) if image else (4,), image=image),)
        self.spec = Spec("Noise-v0", layout, ACTIONS[actions], max_episode_steps=5)
        self.size = self.spec.observation_size + (3 if masked else 0)
        self.num_envs, self.device = num_envs, device
        self.counts = torch.ones(num_envs, dtype=torch.bool, device=device)

    def restart(self, seed, first=0):
        self.generator = torch.Generator(self.device).manual_seed(seed)
        return self._observe()

    def step(self, action):
        assert action.device == whole(self.device)
        terminated, truncated, ignored = self._draw(3) < 0.2
        obs, next_obs, reward = self._observe(), self._observe(), action.reshape(self.num_envs, -1).float().mean(-1)
        return Step(obs, next_obs, reward, terminated, truncated & ~terminated, ~ignored)

    def close(self):
        pass

    def _draw(self, columns):
        return torch.rand(columns, self.num_envs, generator=self.generator, device=self.device)

    def _observe(self):
        obs = self._draw(self.size).T
        return (255 * obs).byte() if self.spec.image else obs


def train_twice(case, device, directory):
    """Two updates, a checkpoint, two more; then the last two again from the checkpoint. The metrics of each update."""
    module, (actions, settings) = algos.find(case.split()[0]), CASES[case]
    config = module.Config(env="Noise-v0", **settings)
    env = VecEnv(Noise(actions, config.num_envs, device))
    torch.manual_seed(0)
    state = module.init(config, env.spec, device)
    env.restart(1)
    rows = [_update(module, config, env, state) for _ in range(2)]
    record = {"spec": checkpoint.spec_to_json(env.spec)}
    path = checkpoint.write(directory, state.saved(), state.step, record, keep=1)
    for _ in range(2):
        env.restart(2)
        state.on_restart(env)
        rows += [_update(module, config, env, state) for _ in range(2)]
        state = module.init(config, env.spec, device)
        checkpoint.read(path).restore(state)
    assert rows[2:4] == rows[4:6]
    tensors = {"obs": env.obs} | {
        f"{name}.{key}": tensor
        for name, value in state.saved().items()
        if name not in ("rng", "action_noise") and hasattr(value, "state_dict")
        for key, tensor in value.state_dict().items()
        if key != "written"
    }
    streams = {name: stream for name, stream in vars(state.rng).items()}
    found = {name: value.device for name, value in [*tensors.items(), *streams.items()]}
    assert found == dict.fromkeys(found, whole(device))
    return rows


def _update(module, config, env, state):
    """As the algorithm's `train` does between two lines of metrics."""
    policy, rng = state.policy, state.rng.action
    if hasattr(state, "replay"):
        for _ in range(4):
            random = state.step < config.learning_starts
            interact(env, policy, state.replay, state.action_noise, rng, random=random)
            state.step += env.num_envs
            metrics = module.update(config, state) if state.step > config.learning_starts else {}
    elif getattr(config, "episodes", 0):
        metrics = module.update(config, state, collect_episodes(env, policy, config.episodes, rng))
    else:
        metrics = module.update(config, state, collect(env, policy, config.num_steps, rng))
    return {name: float(value) for name, value in metrics.items()} | {"episodes": len(env.take_episodes().returns)}


@pytest.mark.parametrize(
    ("case", "device"),
    [
        *(pytest.param(case, "cuda:1", marks=pytest.mark.long if case in SIBLINGS else ()) for case in CASES),
        *((case, "mps") for case in ("ppo box", "sac box")),
        *(
            pytest.param(f"{name} box", "mps", marks=pytest.mark.long)
            for name in ("a2c", "ddpg", "reinforce", "reppo", "td3", "trpo")
        ),
    ],
)
@pytest.mark.one_in(4)
def test_each_algorithm_keeps_to_its_device_and_to_the_numbers_of_the_cpu(case, device, tmp_path):
    with pretend():
        rows = train_twice(case, torch.device(device), tmp_path / "there")
    expected = train_twice(case, CPU, tmp_path / "here")
    for row, other in zip(rows, expected, strict=True):  # mps has no float64
        assert row == other if device != "mps" else row == pytest.approx(other, rel=1e-3, abs=1e-4)


@pytest.mark.parametrize("algorithm", ["ppo", pytest.param("sac", marks=pytest.mark.long)])
def test_a_whole_run_on_the_second_gpu_resumes_and_its_policy_is_evaluated_anywhere(algorithm, tmp_path):
    fields = {
        "device": "cuda:1",
        "evaluate_every": 32,
        "checkpoint_every": 32,
        "progress": False,
        "run": tmp_path / "run",
    }
    if algorithm == "ppo":
        env, fields = "Countdown-v0", fields | tiny_fields(total_steps=64)
    else:
        env, fields = "Pendulum-v1", fields | tiny_off_policy(total_steps=64, log_every=8)
        fields.pop("num_steps", None)
    with pretend():
        lem.train(algorithm, env, **fields)
        last = max((tmp_path / "run" / "checkpoints").iterdir(), key=lambda path: int(path.name[5:]))
        parameters = (last / "tensors.safetensors").read_bytes()
        shutil.rmtree(last)
        lem.resume(tmp_path / "run", progress=False)
        assert (last / "tensors.safetensors").read_bytes() == parameters
    policy = lem.load(tmp_path / "run")
    assert lem.evaluate(policy, episodes=2).episodes == 2


MUTANTS = [
    # what goes wrong, file, the right text, the wrong text, the case that must notice
    ("noise is drawn on the CPU", "nn/policies.py", ", generator=generator, device=generator.device", "", "ppo box"),
    ("positions on the CPU by a mask on the GPU", "data/replay.py", "[done.cpu()]", "[done]", "ddpg box"),
    ("the replay buffer stays on the CPU", "data/replay.py", "dtype=kind, device=device)", "dtype=kind)", "td3 box"),
    ("rows are drawn by the CPU's generator", "run/seeding.py", "generator(seed, device, 3)", 'generator(seed, torch.device("cpu"), 3)', "ppo box"),
    ("rows are drawn with no generator's device", "data/replay.py", "(minibatches, size), generator=generator, device=generator.device)", "(minibatches, size), generator=generator)", "sac box"),
    ("the reward scale stays on the CPU", "algos/a2c.py", "RewardScale(config.num_envs, config.gamma).to(device)", "RewardScale(config.num_envs, config.gamma)", "a2c box"),
    ("the networks stay on the CPU", "algos/trpo.py", "config.make_networks(spec, device)", "config.networks(spec)", "trpo box"),
    ("Adam's scalars stay on the CPU", "optim/adam.py", ".log().to(device, wide_float(device))", ".log()", "a2c box"),
    ("the first GPU, whichever was asked for", "run/seeding.py", "torch.Generator(device)", "torch.Generator(device.type)", "ppo box"),
    ("what ended is counted on the CPU", "data/rollout.py", "dtype=torch.int64, device=env.device)", "dtype=torch.int64)", "reinforce episodes"),
    ("frequencies on the CPU", "maths/actions.py", ", dtype=normal.dtype, device=normal.device)", ", dtype=normal.dtype)", "td3 box"),
    ("float64 on mps", "types.py", 'device.type == "mps"', "False", "a2c box"),
]  # fmt: skip


@pytest.mark.parametrize(("mistake", "file", "right", "wrong", "case"), MUTANTS, ids=[row[0] for row in MUTANTS])
def test_mistakes_are_noticed(mistake, file, right, wrong, case, tmp_path, monkeypatch):
    device, source = "mps" if "mps" in mistake else "cuda:1", Path(lem.__file__).parent
    shutil.copytree(source, tmp_path / "lemniscate", ignore=shutil.ignore_patterns("__pycache__"))
    text = (source / file).read_text()
    assert right in text
    (tmp_path / "lemniscate" / file).write_text(text.replace(right, wrong))
    monkeypatch.syspath_prepend(tmp_path)
    with mock.patch.dict(sys.modules), pretend():
        for name in [name for name in sys.modules if name.partition(".")[0] in ("lemniscate", "test_devices")]:
            del sys.modules[name]
        with pytest.raises((RuntimeError, TypeError, AssertionError), match=r"cuda|mps"):
            importlib.import_module("test_devices").train_twice(case, torch.device(device), tmp_path)


@pytest.mark.parametrize("name", ["auto", "cpu", "cuda", "cuda:0", "cuda:12", "mps"])
def test_a_config_names_a_device_that_another_computer_may_have(name):
    assert tiny(device=name).device == name


@pytest.mark.parametrize("name", ["tpu", "gpu", "cuda:", "cuda:-1", "cuda:01", "mps:0", "cpu ", ""])
def test_other_names_of_devices_are_refused(name):
    with pytest.raises(UserError, match="device must be one of auto, cpu, cuda, cuda:N"):
        tiny(device=name)


@pytest.mark.parametrize(
    ("name", "gpus", "apple", "found"),
    [
        ("auto", 0, False, "cpu"),
        ("auto", 2, False, "cuda"),
        ("auto", 0, True, "cpu"),
        ("cpu", 2, True, "cpu"),
        ("cuda:1", 2, False, "cuda:1"),
        ("mps", 0, True, "mps"),
        ("cuda", 0, False, "device is cuda, but torch sees no GPU; use cpu or auto."),
        ("cuda:1", 0, True, "device is cuda:1, but torch sees no GPU; use cpu or auto."),
        ("cuda:7", 2, False, "device is cuda:7, but the GPUs that torch sees are: cuda:0, cuda:1."),
        ("cuda:9999", 1, False, "device is cuda:9999, but the GPUs that torch sees are: cuda:0."),
        ("mps", 2, False, "device is mps, but torch sees no Apple GPU; use cpu or auto."),
    ],
)
def test_a_device_that_is_not_there_is_refused_in_one_sentence(name, gpus, apple, found, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpus > 0)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: gpus)
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: apple)
    if " " not in found:
        assert device_for(name) == torch.device(found)
        return
    with pytest.raises(UserError) as refused:
        device_for(name)
    assert str(refused.value) == found


@pytest.mark.parametrize("new", [True, False])
def test_bfloat16_on_mps_is_a_matter_of_metal_not_of_the_cpu(monkeypatch, new):
    monkeypatch.setattr(torch.backends.mps, "is_macos_or_newer", lambda major, minor: new and (major, minor) == (14, 0))
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"amx_bf16": not new})
    assert has_bfloat16(torch.device("mps")) == new
