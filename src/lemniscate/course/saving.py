"""Exercises on saving: the contents of a checkpoint of one's own, and their return."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from gymnasium.wrappers.utils import RunningMeanStd
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from lemniscate.course.exercise import Function, Note, call_by_name
from lemniscate.course.setup import normalizer, same_statistics, setting


class _Moves(TorchFunctionMode):
    """Counts the calls that move a tensor to the CPU."""

    def __init__(self) -> None:
        self.count = 0

    def __torch_function__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name, given = getattr(function, "__name__", ""), [*args[1:], *(kwargs or {}).values()]
        self.count += name == "cpu" or (name == "to" and "cpu" in map(str, given))
        return function(*args, **(kwargs or {}))


def save_model(function: Function) -> Iterator[str]:
    """`save_model(agent, optimizer, train_envs, path)`: a file with all that a later run needs."""
    agent, optimizer, envs = setting(5)
    given = {"agent": agent, "optimizer": optimizer, "train_envs": envs, "envs": envs}
    with TemporaryDirectory() as folder:
        path = Path(folder) / "checkpoint.pt"
        with _Moves() as moves:
            call_by_name(function, **given, path=str(path), save=True)
        if not path.exists():
            yield "there is no file at path. Likely: torch.save is missing."
            return
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
        return
    parts = list(_parts(saved))
    yield from _learned(parts, agent, optimizer)
    yield from _observed(parts, normalizer(envs).obs_rms)
    if moves.count < len(agent.state_dict()) + len(list(_moments(optimizer))):
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
    """Whether the weights and the state of the optimizer are there."""
    dictionaries = [part for part in parts if isinstance(part, Mapping)]
    weights = [part for part in dictionaries if set(part) == set(agent.state_dict())]
    if not weights:
        yield "the weights are not in the file. Likely: agent.state_dict() is missing."
    elif any(not torch.equal(weights[0][name], tensor) for name, tensor in agent.state_dict().items()):
        yield "the weights in the file are not those of the agent."
    state = [part for part in dictionaries if {"state", "param_groups"} <= set(part)]
    if not state:
        yield (
            "the optimizer is not in the file: a resumed run would begin with empty moments. Likely:"
            " optimizer.state_dict() is missing."
        )
    elif not _same_moments(state[0], optimizer):
        yield "the optimizer's moments in the file are not those of the optimizer."


def _observed(parts: list[Any], statistics: Any) -> Iterator[str]:
    """Whether mean, variance and number of the observations are there."""
    arrays = [np.asarray(part) for part in parts if isinstance(part, Tensor | np.ndarray | float | int)]
    held = [array for array in arrays if array.shape == statistics.mean.shape]
    if not any(np.allclose(array, statistics.mean, rtol=1e-4) for array in held):
        yield (
            "the mean of the observations is not in the file: the policy would see other numbers than it was trained"
            " on."
        )
    if not any(np.allclose(array, statistics.var, rtol=1e-4) for array in held):
        std = any(np.allclose(array, np.sqrt(statistics.var), rtol=1e-4) for array in held)
        likely = " Likely: it is the standard deviation." if std else ""
        yield f"the variance of the observations is not in the file.{likely}"
    if not any(array.size == 1 and np.isclose(array.item(), statistics.count, rtol=1e-4) for array in arrays):
        yield Note(
            "without the number of observations behind mean and variance (obs_rms.count) a resumed run would forget"
            " them with its first batch."
        )


def _same_moments(mine: Any, right: Any) -> bool:
    both = list(_moments(mine)), list(_moments(right))
    return len(both[0]) == len(both[1]) and all(map(torch.equal, *both))


def _moments(optimizer: Any) -> Iterator[Tensor]:
    state = optimizer.state_dict() if isinstance(optimizer, torch.optim.Optimizer) else optimizer
    for parameter in state["state"].values():
        yield from (value for value in parameter.values() if isinstance(value, Tensor))


def load_model(function: Function) -> Iterator[str]:
    """`load_model(agent, optimizer, train_envs, path)`: the inverse, of a file with the keys of the course."""
    agent, optimizer, envs = setting(5)
    statistics = normalizer(envs).obs_rms
    checkpoint = {
        "model_state_dict": agent.state_dict(),
        "optim_state_dict": optimizer.state_dict(),
        "obs_mean": torch.as_tensor(statistics.mean),
        "obs_var": torch.as_tensor(statistics.var),
        "obs_count": float(statistics.count),
    }
    mine, my_optimizer, my_envs = setting(1)
    with TemporaryDirectory() as folder:
        path = str(Path(folder) / "checkpoint.pt")
        torch.save(checkpoint, path)
        call_by_name(function, agent=mine, optimizer=my_optimizer, train_envs=my_envs, envs=my_envs, path=path)
    if any(not torch.equal(mine.state_dict()[name], tensor) for name, tensor in agent.state_dict().items()):
        yield "the agent's weights are not those of the file. Likely: agent.load_state_dict is missing."
    if not _same_moments(my_optimizer, optimizer):
        yield "the optimizer's moments are not those of the file. Likely: optimizer.load_state_dict is missing."
    yield from same_statistics(normalizer(my_envs).obs_rms, statistics, "of the environments", "the file's")
