"""The contract of an algorithm as checks for a test suite; the library's own algorithms pass the same ones.

    from lemniscate.testing import ALGORITHM_CONTRACT

    @pytest.mark.parametrize("check", ALGORITHM_CONTRACT)
    def test_contract(check, tmp_path):
        check(my_algorithm, tmp_path, env="CartPole-v1", total_steps=4_000)

Each check takes the algorithm (its name or module), an empty folder, and the arguments of `lemniscate.train`; it raises
`AssertionError` with a sentence. Choose settings with which a run takes a few seconds and several updates.
"""

import dataclasses
import inspect
import math
from contextlib import closing
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from lemniscate import algos
from lemniscate.api import results, training
from lemniscate.api.policy import load
from lemniscate.envs import registry
from lemniscate.run import checkpoint
from lemniscate.run.config import RunConfig
from lemniscate.run.metrics import read_metrics
from lemniscate.run.state import TrainState
from lemniscate.spec import Discrete

MISSING = 0.6
"""the share of the value that may be missing: without the value behind a cut, 1.4 is, and learning is slow at first"""
SIGNATURES = {"init": ["config", "spec", "device"], "train": ["config", "run"]}


def check_names(algorithm: str | ModuleType, folder: Path, **settings: Any) -> None:
    """The module has `Config`, `State`, `init` and `train`, of the common kinds and with the common arguments."""
    module = algos.find(algorithm)
    for name, base in (("Config", RunConfig), ("State", TrainState)):
        kind = getattr(module, name, None)
        assert inspect.isclass(kind), f"There is no class {name}."
        assert issubclass(kind, base), f"{name} must be a subclass of {base.__name__}."
        assert dataclasses.is_dataclass(kind), f"{name} must be a dataclass."
    for name, expected in SIGNATURES.items():
        function = getattr(module, name, None)
        assert callable(function), f"There is no function {name}({', '.join(expected)})."
        found = list(inspect.signature(function).parameters)
        assert found == expected, f"{name} must take ({', '.join(expected)}), not ({', '.join(found)})."
    module.Config()  # every setting has a default


def check_training(algorithm: str | ModuleType, folder: Path, **settings: Any) -> None:
    """A run reaches its last step with finite metrics, and its policy can be loaded and evaluated."""
    run = training.train(algorithm, run=Path(folder) / "run", progress=False, **settings)
    total = run.policy.config.total_steps
    assert run.policy.step >= total, f"The run ended at step {run.policy.step}, before its {total} steps."
    metrics = read_metrics(run.path)
    assert metrics, "No metrics were logged: call run.log after every update."
    bad = {name for line in metrics for name, x in line.items() if isinstance(x, float) and not math.isfinite(x)}
    assert not bad, f"These metrics are not finite: {', '.join(sorted(bad))}."
    scores = results.evaluate(load(run.path), episodes=2, seed=0)
    assert scores == results.evaluate(run.policy, episodes=2, seed=0), "The loaded policy differs from the trained one."


def check_seeds(algorithm: str | ModuleType, folder: Path, **settings: Any) -> None:
    """The seed determines the run: the same one gives the same bits, another one others."""
    again = {"seed": 1, **settings}
    runs = [training.train(algorithm, run=Path(folder) / f"run-{i}", progress=False, **again).path for i in range(2)]
    assert not _difference(*map(_last_checkpoint, runs)), "Two runs with the same seed end in different bits."
    other = training.train(
        algorithm, run=Path(folder) / "other", progress=False, **{**again, "seed": again["seed"] + 1}
    ).path
    assert _difference(_last_checkpoint(runs[0]), _last_checkpoint(other)), "Another seed ends in the same bits."


def check_resume(algorithm: str | ModuleType, folder: Path, **settings: Any) -> None:
    """A run that was stopped and resumed ends in the bits of one that was not."""
    quarter = training.config_for(algorithm, **settings).total_steps // 4
    settings["checkpoint_every"] = settings.get("checkpoint_every") or max(1, quarter)  # else it would begin anew
    whole = training.train(algorithm, run=Path(folder) / "whole", progress=False, **settings)
    half = whole.policy.config.total_steps // 2
    stopped = Path(folder) / "stopped"
    training.train(algorithm, run=stopped, progress=False, callbacks=[lambda step, *_: step >= half], **settings)
    first, seen = read_metrics(whole.path)[0]["step"], list[int]()
    training.resume(stopped, progress=False, callbacks=[lambda step, *_: seen.append(step)])
    assert min(seen) > first, "It begins at step 0 after a resume: is the state what run.restore(state) returns?"
    difference = _difference(_last_checkpoint(whole.path), _last_checkpoint(stopped))
    assert difference is None, f"{difference} differs after a resume: is it a field of State that is saved?"


def check_compilation(algorithm: str | ModuleType, folder: Path, **settings: Any) -> None:
    """A compiled run computes what one without compilation does, to rounding, for its first update."""
    rows = []
    for compile in ("off", "on"):
        path = training.train(
            algorithm, run=Path(folder) / compile, progress=False, **{**settings, "compile": compile}
        ).path
        rows.append({name: x for name, x in read_metrics(path)[0].items() if name.startswith("losses/")})
    off, on = rows
    for name, value in off.items():
        assert math.isclose(value, on[name], rel_tol=1e-3, abs_tol=1e-5), (
            f"Compiled, {name} is {on[name]}, not {value}."
        )


class Answers(gym.Env):
    """The right action says the observation, −1 or 1: a reward of 1, of 0 for the opposite; cut off after 10 steps.

    The return of a policy that knows nothing is 5, of one that has learned the answer 10, of one that has learned the
    opposite 0. The value is that of answering for ever, since no episode ends.
    """

    def __init__(self, discrete: bool) -> None:
        self.observation_space = gym.spaces.Box(-1, 1, (1,))
        self.action_space = gym.spaces.Discrete(2) if discrete else gym.spaces.Box(-1, 1, (1,))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Gymnasium's."""
        super().reset(seed=seed)
        self._steps = 0
        return self._ask(), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Gymnasium's."""
        given = 2.0 * action - 1 if isinstance(self.action_space, gym.spaces.Discrete) else float(np.asarray(action)[0])
        reward = 1 - abs(given - float(self._asked[0])) / 2
        self._steps += 1
        return self._ask(), reward, False, self._steps == 10, {}

    def _ask(self) -> np.ndarray:
        self._asked = np.array([self.np_random.choice((-1, 1))], dtype=np.float32)
        return self._asked


def check_learning(algorithm: str | ModuleType, folder: Path, **settings: Any) -> None:
    """The policy gets better in `Answers`, not worse, and where an episode is cut off its value goes on.

    The settings are to be those that learn it: some thousand steps, and a discount of 0.9. Of `env`, only the kind of
    its actions is looked at: what wraps it, resets it or makes it harder is left out.
    """
    config = training.config_for(algorithm, **settings)
    arguments = {"kwargs": config.env_kwargs, "wrappers": config.wrappers, "backend": config.backend}
    with closing(registry.make(config.env, 1, **arguments)) as env:
        own = {"env": "lemniscate.testing:Answers", "env_kwargs": {"discrete": isinstance(env.spec.action, Discrete)}}
    usual: dict[str, Any] = {"wrappers": (), "reset_options": {}, "curriculum": None, "backend": "gymnasium"}
    run = training.train(algorithm, run=Path(folder) / "run", progress=False, **{**settings, **usual, **own})
    reached = results.evaluate(run.policy, episodes=20, seed=0).mean_return
    assert reached > 4, f"The policy has learned the opposite, a return of {reached:.2g} of 10: a sign is wrong."
    assert reached > 6, f"The policy has not learned: its return is {reached:.2g} of 10, and 5 without learning."
    missing = [line["value/missing"] for line in read_metrics(run.path) if "value/missing" in line]
    late = float(np.mean(missing[-len(missing) // 4 :])) if missing else 0.0
    assert late < MISSING, f"{late:.0%} of the value is missing: where episodes are cut off, that of the last state."


ALGORITHM_CONTRACT = (check_names, check_training, check_seeds, check_resume)
"""all checks but `check_compilation`, which takes a minute, and `check_learning`, which needs settings of its own"""


def _last_checkpoint(path: Path) -> checkpoint.Checkpoint:
    last = checkpoint.list_steps(path / "checkpoints")[-1]
    return checkpoint.read(path / "checkpoints" / f"step-{last}")


def _difference(one: checkpoint.Checkpoint, other: checkpoint.Checkpoint) -> str | None:
    """The name of the first tensor or number that differs."""
    for name in {**one.tensors, **other.tensors}:
        both = name in one.tensors and name in other.tensors
        if not (both and torch.equal(one.tensors[name], other.tensors[name])):
            return name
    return next((name for name, x in one.numbers.items() if other.numbers.get(name) != x), None)
