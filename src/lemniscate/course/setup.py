"""Exercises on the setup of a training loop: seeds, environments, checkpoints, statistics of observations."""

import copy
import random
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import SyncVectorEnv
from gymnasium.wrappers.utils import RunningMeanStd
from gymnasium.wrappers.vector import NormalizeObservation, RecordEpisodeStatistics
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from lemniscate.course.exercise import Function, Note, call_by_name
from lemniscate.run.seeding import seed_globals

# ruff: noqa: NPY002  (the legacy generator of NumPy is one that is to be seeded)


def set_seeds(function: Function) -> Iterator[str]:
    """`set_seeds(seed)`: every generator, and cuDNN."""
    with ExitStack() as restored:
        restored.enter_context(torch.backends.cudnn.flags(enabled=torch.backends.cudnn.enabled))
        restored.callback(torch.set_deterministic_debug_mode, torch.get_deterministic_debug_mode())
        for seed in (42, 7):
            seed_globals(1)
            torch.backends.cudnn.deterministic, torch.backends.cudnn.benchmark = False, True
            function(seed)
            wanted = {
                "random": (random.random(), random.Random(seed).random(), "random.seed(seed)"),
                "NumPy": (np.random.random(), np.random.RandomState(seed).random_sample(), "np.random.seed(seed)"),
                "torch": (torch.initial_seed(), seed, "torch.manual_seed(seed)"),
            }
            if torch.cuda.is_available():
                wanted["CUDA"] = (torch.cuda.initial_seed(), seed, "torch.cuda.manual_seed_all(seed)")
            for name, (found, want, call) in wanted.items():
                if found != want and seed == 42:
                    yield f"{name} is not seeded by the seed. Likely: {call} is missing."
                if found != want:
                    yield f"{name} is seeded by another number than the argument. Likely: a number stands in its place."
        if not torch.backends.cudnn.deterministic:
            yield "cuDNN may choose kernels that are not reproducible. Likely: cudnn.deterministic = True is missing."
        if torch.backends.cudnn.benchmark:
            yield (
                "cuDNN's benchmark mode may choose other kernels in each run. Likely: cudnn.benchmark = False is"
                " missing."
            )


def make_envs(function: Function) -> Iterator[str]:
    """`make_envs(n_envs, n_eval_envs, …)`: vector environments for training and for evaluation."""
    numbers = {"n_envs": 3, "n_eval_envs": 2, "train_device": "cpu", "device": "cpu", "env_name": "CartPole-v1"}
    made = call_by_name(function, **numbers, env_id="CartPole-v1")
    if not isinstance(made, tuple) or len(made) != 2 or not all(hasattr(envs, "num_envs") for envs in made):
        yield "it should return two vector environments, for training and for evaluation."
    try:
        yield from _two(*made)
        for name, envs, number in (("training", made[0], 3), ("evaluation", made[1], 2)):
            rows = len(envs.reset(seed=0)[0])
            if rows != number:
                yield f"reset of the {name} environments returns {rows} observations for {number} environments."
    finally:
        for envs in {id(envs): envs for envs in made}.values():
            envs.close()


def _two(train: Any, evaluation: Any) -> Iterator[str]:
    if train is evaluation or getattr(train, "unwrapped", train) is getattr(evaluation, "unwrapped", evaluation):
        yield "both are the same environments, so an evaluation would end the episodes of training. Likely: made once."
    numbers = (train.num_envs, evaluation.num_envs)
    if numbers == (2, 3):
        yield "3 for training and 2 for evaluation were asked for. Likely: n_envs and n_eval_envs are exchanged."
    if numbers != (3, 2):
        yield f"3 for training and 2 for evaluation were asked for, and {numbers[0]} and {numbers[1]} made."
    if train.single_observation_space.shape != evaluation.single_observation_space.shape:
        yield "observations of training and evaluation have other shapes. Likely: a wrapper is around one of them only."
    norms = [norm for norm in (normalizer(train), normalizer(evaluation)) if norm is not None]
    if len(norms) == 1:
        yield "only one of the two normalizes observations: the policy would see other numbers than it was trained on."
    if norms and norms[0].update_running_mean is False:
        yield "the statistics of training never change. Likely: update_running_mean = False belongs to evaluation."
    if norms and norms[1].update_running_mean:
        yield "evaluation changes the statistics. Likely: eval_envs.update_running_mean = False is missing."
    if not norms:
        yield Note(
            "neither normalizes observations; save_model and sync_envs of the drone's course need NormalizeObservation."
        )


def normalizer(envs: Any) -> Any:
    """The wrapper that normalizes observations; None where there is none."""
    while envs is not None and not hasattr(type(envs), "update_running_mean"):
        envs = vars(envs).get("env")
    return envs


def _setting(steps: int) -> tuple[nn.Module, torch.optim.Optimizer, Any]:
    """An agent, its optimizer and its environments, after so many steps."""
    torch.manual_seed(steps)
    agent = nn.ModuleDict({"actor": nn.Linear(4, 2), "critic": nn.Linear(4, 1)})
    optimizer = torch.optim.AdamW(agent.parameters(), lr=1e-3, eps=1e-5)
    inner = NormalizeObservation(SyncVectorEnv([lambda: gym.make("CartPole-v1")] * 2))
    envs = RecordEpisodeStatistics(inner)  # so that the normalizer has to be looked for
    envs.reset(seed=steps)
    for _ in range(steps):
        obs, *_ = envs.step(np.ones(2, dtype=np.int64))
        optimizer.zero_grad()
        torch.cat([layer(torch.from_numpy(obs)) for layer in agent.values()], 1).square().mean().backward()
        optimizer.step()
    return agent, optimizer, envs


def _same_statistics(mine: Any, right: Any, whose: str, whence: str) -> Iterator[str]:
    """Sentences where two running means and variances differ."""
    if not np.allclose(mine.mean, right.mean, rtol=1e-4):
        yield f"the mean {whose} is not {whence}. Likely: obs_rms.mean is not set in the wrapper that normalizes."
    if not np.allclose(mine.var, right.var, rtol=1e-4):
        std = np.allclose(mine.var, np.sqrt(right.var), rtol=1e-4)
        yield f"the variance {whose} is not {whence}." + (" Likely: it is the standard deviation." if std else "")
    if not np.isclose(mine.count, right.count, rtol=1e-4):
        yield Note(
            f"the number of observations {whose} (obs_rms.count) is not {whence}; for inference it does not matter."
        )


def sync_envs(function: Function) -> Iterator[str]:
    """`sync_envs(train_envs, eval_envs)`: training's statistics for evaluation."""
    train, evaluation = _setting(5)[2], _setting(1)[2]
    theirs, mine = normalizer(train), normalizer(evaluation)
    mine.update_running_mean = False
    before, other = copy.deepcopy(theirs.obs_rms), np.copy(mine.obs_rms.mean)
    function(train, evaluation)
    if not np.array_equal(theirs.obs_rms.mean, before.mean):
        swapped = np.array_equal(theirs.obs_rms.mean, other)
        likely = " Likely: it copies in the wrong direction." if swapped else ""
        yield f"the statistics of training have changed.{likely}"
    yield from _same_statistics(mine.obs_rms, before, "of evaluation", "that of training")
    evaluation.reset(seed=9)
    if not np.array_equal(mine.obs_rms.mean, before.mean):
        yield "an evaluation changes the statistics. Likely: update_running_mean is True in eval_envs."
    train.reset(seed=9)
    if not np.array_equal(mine.obs_rms.mean, before.mean):
        yield Note("both now share one object: the statistics of evaluation follow training without another call.")


class _Moves(TorchFunctionMode):
    """Counts the calls that move a tensor to the CPU."""

    count = 0

    def __torch_function__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name, given = getattr(function, "__name__", ""), [*args[1:], *(kwargs or {}).values()]
        self.count += name == "cpu" or (name == "to" and "cpu" in map(str, given))
        return function(*args, **(kwargs or {}))


def save_model(function: Function) -> Iterator[str]:
    """`save_model(agent, optimizer, train_envs, path)`: a file with all that a later run needs."""
    agent, optimizer, envs = _setting(5)
    given = {"agent": agent, "optimizer": optimizer, "train_envs": envs, "envs": envs, "save": True}
    with TemporaryDirectory() as folder:
        path = Path(folder) / "checkpoint.pt"
        with _Moves() as moves:
            call_by_name(function, **given, path=str(path))
        if not path.exists():
            yield "there is no file at path. Likely: torch.save is missing."
        try:
            saved = torch.load(path, weights_only=True)
        except Exception:  # torch's refusal has changed its type more than once
            saved = torch.load(path, weights_only=False)
            parts = saved.values() if isinstance(saved, Mapping) else [saved]
            if any(isinstance(part, nn.Module | torch.optim.Optimizer) for part in parts):
                yield "the agent or the optimizer is pickled whole, with its code. Likely: .state_dict() is missing."
            yield Note(
                "the file opens with weights_only=False alone, which runs what is in it; a tensor in place of each"
                " NumPy array (torch.as_tensor) mends it."
            )
    if not isinstance(saved, Mapping):
        yield f"the file holds a {type(saved).__name__}; it should hold a dictionary."
    parts = list(_parts(saved))
    yield from _learned(parts, agent, optimizer)
    yield from _observed(parts, normalizer(envs).obs_rms)
    if moves.count < len(agent.state_dict()) + len(_moments(optimizer.state_dict())):
        yield Note(
            "not every tensor of agent and optimizer was moved by .cpu(). A file with tensors of a GPU opens on a"
            ' computer without one only with torch.load(path, map_location="cpu").'
        )


def _parts(saved: Mapping[Any, Any]) -> Iterator[Any]:
    """The values of a dictionary, and of the dictionaries and running statistics in it."""
    for part in saved.values():
        yield part
        if isinstance(part, RunningMeanStd | Mapping):
            yield from _parts(vars(part) if isinstance(part, RunningMeanStd) else part)


def _learned(parts: list[Any], agent: nn.Module, optimizer: torch.optim.Optimizer) -> Iterator[str]:
    """Sentences where the weights or the state of the optimizer are not there."""
    dictionaries, right = [part for part in parts if isinstance(part, Mapping)], agent.state_dict()
    weights = [part for part in dictionaries if set(part) == set(right)]
    if not weights:
        yield "the weights are not in the file. Likely: agent.state_dict() is missing."
    if not _same_tensors(weights[0], right):
        yield "the weights in the file are not those of the agent."
    states = [part for part in dictionaries if {"state", "param_groups"} <= set(part)]
    if not states:
        yield (
            "the optimizer is not in the file: a resumed run would begin with empty moments. Likely:"
            " optimizer.state_dict() is missing."
        )
    if not _same_tensors(_moments(states[0]), _moments(optimizer.state_dict())):
        yield "the optimizer's moments in the file are not those of the optimizer."


def _observed(parts: list[Any], statistics: RunningMeanStd) -> Iterator[str]:
    """Sentences where mean, variance or number of the observations are not there."""
    arrays = [np.asarray(part) for part in parts if isinstance(part, Tensor | np.ndarray | float | int)]

    def has(want: Any) -> bool:
        sized = [array for array in arrays if array.size == np.size(want)]
        return any(np.allclose(array.reshape(np.shape(want)), want, rtol=1e-4) for array in sized)

    if not has(statistics.mean):
        yield (
            "the mean of the observations is not in the file: the policy would see other numbers than it was trained"
            " on."
        )
    if not has(statistics.var):
        likely = " Likely: it is the standard deviation." if has(np.sqrt(statistics.var)) else ""
        yield f"the variance of the observations is not in the file.{likely}"
    if not has(statistics.count):
        yield Note(
            "without the number of observations behind mean and variance (obs_rms.count) a resumed run would forget"
            " them with its first batch."
        )


def _moments(state: Mapping[str, Any]) -> dict[tuple[Any, str], Tensor]:
    """The tensors in the state of an optimizer, by parameter and name."""
    return {
        (parameter, name): value
        for parameter, held in state["state"].items()
        for name, value in held.items()
        if isinstance(value, Tensor)
    }


def _same_tensors(mine: Mapping[Any, Tensor], right: Mapping[Any, Tensor]) -> bool:
    return set(mine) == set(right) and all(torch.equal(mine[name], tensor) for name, tensor in right.items())


def load_model(function: Function) -> Iterator[str]:
    """`load_model(agent, optimizer, train_envs, path)`: the inverse, of a file with the keys of the course."""
    agent, optimizer, envs = _setting(5)
    statistics = normalizer(envs).obs_rms
    checkpoint = {
        "model_state_dict": agent.state_dict(),
        "optim_state_dict": optimizer.state_dict(),
        "obs_mean": torch.as_tensor(statistics.mean),
        "obs_var": torch.as_tensor(statistics.var),
        "obs_count": float(statistics.count),
    }
    mine, my_optimizer, my_envs = _setting(1)
    with TemporaryDirectory() as folder:
        path = str(Path(folder) / "checkpoint.pt")
        torch.save(checkpoint, path)
        call_by_name(function, agent=mine, optimizer=my_optimizer, train_envs=my_envs, envs=my_envs, path=path)
    if not _same_tensors(mine.state_dict(), agent.state_dict()):
        yield "the agent's weights are not those of the file. Likely: agent.load_state_dict is missing."
    if not _same_tensors(_moments(my_optimizer.state_dict()), _moments(optimizer.state_dict())):
        yield "the optimizer's moments are not those of the file. Likely: optimizer.load_state_dict is missing."
    yield from _same_statistics(normalizer(my_envs).obs_rms, statistics, "of the environments", "the file's")
