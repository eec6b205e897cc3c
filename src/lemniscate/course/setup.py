"""Exercises on the setup of a training loop: seeds, environments, checkpoints, statistics of observations."""

import os
import random
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import SyncVectorEnv
from gymnasium.wrappers.utils import RunningMeanStd
from gymnasium.wrappers.vector import NormalizeObservation, RecordEpisodeStatistics
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from lemniscate.course.exercise import Note, Seen, close
from lemniscate.course.solution import Function, call_by_name, first_that_works, plain
from lemniscate.run.seeding import seed_globals


def see_set_seeds(function: Function, seen: Seen) -> None:
    """`set_seeds(seed)`: every generator, and cuDNN."""
    with ExitStack() as restored:
        restored.enter_context(torch.backends.cudnn.flags(enabled=torch.backends.cudnn.enabled))
        restored.enter_context(patch.dict(os.environ))
        restored.callback(torch.set_deterministic_debug_mode, torch.get_deterministic_debug_mode())
        for seed in (None, 42, 7):
            seed_globals(1)
            torch.backends.cudnn.deterministic, torch.backends.cudnn.benchmark = False, True
            if seed is not None:
                call_by_name(function, {"seed": seed}, {"deterministic": True, "device": "cpu"})
            cuda = torch.cuda.initial_seed() if torch.cuda.is_available() else seed or 1
            seen[f"seed {seed}"] = [random.random(), np.random.random(), torch.initial_seed(), cuda]  # noqa: NPY002
        if not torch.cuda.is_available():
            with suppress(Exception), patch("torch.cuda.is_available", return_value=True):  # some set cuDNN only then
                call_by_name(function, {"seed": 7}, {"deterministic": True, "device": "cpu"})
        seen["cudnn"] = [torch.backends.cudnn.deterministic, torch.backends.cudnn.benchmark]


def set_seeds(seen: Seen) -> Iterator[str]:
    """Sentences on seeds: each generator, cuDNN."""
    calls = {"random": "random", "NumPy": "np.random", "torch": "torch", "CUDA": "torch.cuda"}
    for place, (name, module) in enumerate(calls.items()):
        unseeded, *found = (seen[f"seed {seed}"][place] for seed in (None, 42, 7))
        wanted = [
            (random.Random(seed).random(), np.random.RandomState(seed).random_sample(), seed, seed)[place]
            for seed in (42, 7)
        ]
        call = {"torch": "manual_seed", "CUDA": "manual_seed_all"}.get(name, "seed")
        if found[0] == found[1] == unseeded:
            yield f"{name} is not seeded by the seed. Likely: {module}.{call}(seed) is missing."
        if found != wanted:
            yield f"{name} is seeded by another number than the argument. Likely: a number stands in its place."
    deterministic, benchmark = seen["cudnn"]
    if not deterministic:
        yield "cuDNN may choose kernels that are not reproducible. Likely: cudnn.deterministic = True is missing."
    if benchmark:
        yield "cuDNN's benchmark mode may choose other kernels in each run. Likely: cudnn.benchmark = False is missing."


def see_make_envs(function: Function, seen: Seen) -> None:
    """`make_envs(n_envs, n_eval_envs, …)`: vector environments for training and for evaluation."""
    numbers = {"n_envs num_envs n_train_envs num_train_envs n_train num_train": 3}
    numbers |= {"n_eval_envs num_eval_envs n_eval num_eval n_test_envs": 2}

    def attempt(env_id: str) -> Any:
        others = {"train_device device": "cpu", "env_name env_id env id task": env_id, "seed": 0}
        return call_by_name(function, numbers, others)

    made = first_that_works(attempt, ("CartPole-v1",), ("Pendulum-v1",), ("DroneFigureEightTrajectory-v0",))
    pair = made if isinstance(made, tuple | list) else [made]
    seen["made"] = [hasattr(envs, "num_envs") for envs in pair]
    try:
        norms = [normalizer(envs) for envs in pair]
        seen["same"] = len({id(getattr(envs, "unwrapped", envs)) for envs in pair}) < len(pair)
        seen["numbers"] = [envs.num_envs for envs in pair]
        kinds = ("single_observation_space", "single_action_space")
        spaces = [[getattr(envs, kind, None) for kind in kinds] for envs in pair]
        seen["spaces"] = [[str(getattr(obs, "shape", None)), str(action)] for obs, action in spaces]
        seen["updates"] = [norm and bool(norm.update_running_mean) for norm in norms]
        seen["rewards"] = normalizer(pair[-1], "return_rms") is not None
        starts = [envs.reset(seed=0)[0] for envs in pair]
        seen["rows"] = [len(next(iter(obs.values())) if isinstance(obs, Mapping) else obs) for obs in starts]
        seen["kinds"] = [type(obs).__name__ for obs in starts]
    finally:
        for envs in {id(envs): envs for envs in pair if hasattr(envs, "close")}.values():
            envs.close()


def make_envs(seen: Seen) -> Iterator[str]:
    """Sentences on two vectors of environments."""
    if seen["made"] != [True, True]:
        yield "it should return two vector environments, for training and for evaluation."
    if seen["same"]:
        yield "both are the same environments, so an evaluation would end the episodes of training. Likely: made once."
    numbers = seen["numbers"]
    if numbers != [3, 2]:
        likely = " Likely: n_envs and n_eval_envs are exchanged." if numbers == [2, 3] else ""
        yield f"3 and 2 environments were asked for, and {numbers[0]} and {numbers[1]} made.{likely}"
    for what, train, evaluation in zip(("observations", "actions"), *seen["spaces"], strict=True):
        if train != evaluation:
            other = f"{what} of training are {train}, and of evaluation {evaluation}"
            yield f"{other}. Likely: a wrapper is around one of them only."
    yield from _normalized(seen["rewards"], *seen["updates"])
    for name, rows, number in zip(("training", "evaluation"), seen["rows"], numbers, strict=True):
        if rows != number:
            yield f"reset of the {name} environments returns {rows} observations for {number} environments."
    if len(set(seen["kinds"])) > 1:
        yield f"reset returns {' in training, '.join(seen['kinds'])} in evaluation. Likely: one of them is not wrapped."


def _normalized(are_rewards: bool, train: bool | None, evaluation: bool | None) -> Iterator[str]:
    """Sentences on whether statistics of observations are updated; None where there are none."""
    if (train is None) != (evaluation is None):
        yield "only one of the two normalizes observations: the policy would see other numbers than it was trained on."
    if train is False:
        yield "the statistics of training never change. Likely: update_running_mean = False belongs to evaluation."
    if evaluation:
        yield "evaluation changes the statistics. Likely: eval_envs.update_running_mean = False is missing."
    if train is None and are_rewards:
        yield "rewards are normalized, also in evaluation. Likely: NormalizeReward in place of NormalizeObservation."
    if train is None:
        yield Note("neither normalizes observations; save_model and sync_envs need NormalizeObservation.")


def normalizer(envs: Any, of: str = "obs_rms") -> Any:
    """The wrapper that normalizes observations, or rewards; None where there is none."""
    while envs is not None and not (hasattr(type(envs), "update_running_mean") and of in vars(envs)):
        held = vars(envs).values() if hasattr(envs, "__dict__") else ()
        envs = next((inner for inner in held if hasattr(inner, "num_envs")), None)
    return envs


def _setting(steps: int, wrappers: int = 1) -> tuple[nn.Module, torch.optim.Optimizer, Any]:
    """An agent, its optimizer and its environments, after so many steps."""
    torch.manual_seed(steps)
    agent = nn.ModuleDict({"actor": nn.Linear(4, 2), "critic": nn.Linear(4, 1)})
    optimizer = torch.optim.AdamW(agent.parameters(), lr=1e-3 * steps, eps=1e-5)
    envs: Any = NormalizeObservation(SyncVectorEnv([lambda: gym.make("CartPole-v1")] * 2))
    for _ in range(wrappers):
        envs = RecordEpisodeStatistics(envs)  # so that the normalizer has to be looked for
    envs.reset(seed=steps)
    for _ in range(steps):
        obs, *_ = envs.step(np.ones(2, dtype=np.int64))
        optimizer.zero_grad()
        torch.cat([layer(torch.from_numpy(obs)) for layer in agent.values()], 1).square().mean().backward()
        optimizer.step()
    return agent, optimizer, envs


WRAPPERS = (1, str), (1, Path), (2, str), (2, Path)
"""what is tried: one wrapper around the normalizer, or two for a solution that counts on that; a path as text or not"""


def _statistics(envs: Any) -> dict[str, Tensor]:
    """Mean, variance and number of the observations; copies."""
    statistics = normalizer(envs).obs_rms
    return {name: torch.tensor(np.ravel(getattr(statistics, name))) for name in ("mean", "var", "count")}


def _learned(agent: nn.Module, optimizer: torch.optim.Optimizer, envs: Any) -> list[dict[str, Tensor]]:
    """Copies of all that a checkpoint has to hold: weights, learning rate, moments, statistics of the observations."""
    flat = dict(_flat(plain(optimizer.state_dict())))
    moments = {path[1:]: torch.as_tensor(flat[path]) for path in flat if "state" in path or path.endswith(".lr")}
    return [plain(agent.state_dict()), moments, _statistics(envs)]


def _same_statistics(mine: Any, right: Any, whose: str, whence: str) -> Iterator[str]:
    """Sentences where two running means and variances differ."""
    if not close(mine["mean"], right["mean"]):
        unset = "obs_rms.mean is not set in the wrapper that normalizes"
        likely = "it is the variance" if close(mine["mean"], right["var"]) else unset
        yield f"the mean {whose} is not {whence}. Likely: {likely}."
    if not close(mine["var"], right["var"]):
        std = close(mine["var"], right["var"].sqrt())
        yield f"the variance {whose} is not {whence}." + (" Likely: it is the standard deviation." if std else "")
    if not close(mine["count"], right["count"]):
        said = f"the number of observations {whose} (obs_rms.count) is not {whence}"
        if whose == "of evaluation":
            yield Note(f"{said}; for inference it does not matter.")
        else:
            yield f"{said}: training that goes on would forget mean and variance with its first batch."


def see_sync_envs(function: Function, seen: Seen) -> None:
    """`sync_envs(train_envs, eval_envs)`: training's statistics for evaluation."""

    def attempt(wrappers: int, _: type) -> list[Any]:
        train, evaluation = _setting(5, wrappers)[2], _setting(1, wrappers)[2]
        normalizer(evaluation).update_running_mean = False
        seen["before"] = [_statistics(train), _statistics(evaluation)]
        call_by_name(function, {CHECKPOINT[2]: train, "eval_envs test_envs": evaluation})
        return [train, evaluation]

    both = first_that_works(attempt, *WRAPPERS)
    seen["after"] = [_statistics(envs) for envs in both]
    for name, envs in zip(("trained", "evaluated"), both, strict=True):
        envs.reset(seed=9)
        seen[name] = _statistics(both[1])


def sync_envs(seen: Seen) -> Iterator[str]:
    """Sentences on the statistics of evaluation."""
    (train, evaluation), (train_after, evaluation_after) = seen["before"], seen["after"]
    if not all(close(train_after[name], train[name]) for name in ("mean", "var")):
        likely = " Likely: it copies in the wrong direction." if close(train_after["mean"], evaluation["mean"]) else ""
        yield f"the statistics of training have changed.{likely}"
    yield from _same_statistics(evaluation_after, train, "of evaluation", "that of training")
    if not close(seen["evaluated"]["mean"], seen["trained"]["mean"]):
        yield "an evaluation changes the statistics. Likely: update_running_mean is True in eval_envs."
    if not close(seen["trained"]["mean"], train["mean"]):
        yield Note("both now share one object: the statistics of evaluation follow training without another call.")


CHECKPOINT: tuple[str, ...] = (
    "agent model net network policy actor_critic module",
    "optimizer optim opt optimiser",
    "train_envs envs env vec_env venv training_envs",
    "path pfad datei file filename filepath file_path checkpoint_path ckpt_path model_path save_path load_path",
)
"""the names of what `save_model` and `load_model` are given"""


class _Moves(TorchFunctionMode):
    """Counts the calls that move a tensor to the CPU."""

    count = 0

    def __torch_function__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name, given = getattr(function, "__name__", ""), [*args[1:], *(kwargs or {}).values()]
        self.count += name == "cpu" or (name == "to" and "cpu" in map(str, given))
        return function(*args, **(kwargs or {}))


def see_save_model(function: Function, seen: Seen) -> None:
    """`save_model(agent, optimizer, train_envs, path)`: a file with all that a later run needs."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "checkpoint.pt"

        def attempt(wrappers: int, kind: type) -> None:
            setting = _setting(5, wrappers)
            seen["right"] = _learned(*setting)
            with _Moves() as moves:  # `save` is called so where it has no default
                call_by_name(function, dict(zip(CHECKPOINT, (*setting, kind(path)), strict=True)), {"-": True})
            seen["moves"] = moves.count

        first_that_works(attempt, *WRAPPERS)
        seen["is_there"] = path.exists()
        seen["opens"] = {}
        for safe in (True, False):
            with suppress(Exception):  # torch's refusal has changed its type more than once
                saved = torch.load(path, weights_only=safe)
                parts = saved.values() if isinstance(saved, Mapping) else [saved]
                whole = any(isinstance(part, nn.Module | torch.optim.Optimizer) for part in parts)
                seen["opens"] = {"safe": safe, "whole": whole, "saved": plain(_opened(saved))}
                break


def _opened(saved: Any) -> Any:
    """The same with the content of running statistics as dictionaries."""
    if isinstance(saved, Mapping):
        return {name: _opened(part) for name, part in saved.items()}
    return vars(saved) if isinstance(saved, RunningMeanStd) else saved


def save_model(seen: Seen) -> Iterator[str]:
    """Sentences on a checkpoint: weights, optimizer, statistics."""
    if not seen["is_there"]:
        yield "there is no file at path. Likely: torch.save is missing."
    if not (opens := seen["opens"]):
        yield "torch.load cannot read the file. Likely: it was not written by torch.save."
    saved, (agent, moments, statistics) = opens["saved"], seen["right"]
    if opens["whole"]:
        yield "the agent or the optimizer is pickled whole, with its code. Likely: .state_dict() is missing."
    if not opens["safe"]:
        yield Note("the file needs weights_only=False, which may run code; store torch.as_tensor(array).")
    if not isinstance(saved, dict):
        yield f"the file holds a {type(saved).__name__}; it should hold a dictionary."
    flat = dict(_flat(saved))
    yield from _weights(flat, agent, moments)
    yield from _observed(flat, statistics)
    if seen["moves"] < len(agent) + len(moments) - 1:  # the learning rate is a number
        yield Note(
            "not every tensor of agent and optimizer was moved by .cpu(). A file with tensors of a GPU opens on a"
            ' computer without one only with torch.load(path, map_location="cpu").'
        )


def _weights(flat: Mapping[str, Any], agent: Mapping[str, Tensor], moments: Mapping[str, Tensor]) -> Iterator[str]:
    """Sentences where the weights or the state of the optimizer are not there."""
    missing = [name for name in agent if not any(path.endswith(f".{name}") for path in flat)]
    if len(missing) == len(agent):
        yield "the weights are not in the file. Likely: agent.state_dict() is missing."
    if missing:
        yield f"of the weights {missing[0]} is not in the file."
    if not _holds(flat, agent):
        yield "the weights in the file are not those of the agent."
    if not any(path.endswith(".param_groups.0.lr") for path in flat):
        yield "the optimizer is not in the file: moments are lost. Likely: optimizer.state_dict() is missing."
    if not _holds(flat, moments):
        yield "the optimizer's moments in the file are not those of the optimizer."


def _flat(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """The parts of nested dictionaries and lists by their names, joined by dots; a list of numbers is one part."""
    if isinstance(value, dict):
        parts = value.items()
    elif isinstance(value, list) and not all(isinstance(part, int | float) for part in value):
        parts = enumerate(value)
    else:
        yield path, value
        return
    for name, part in parts:
        yield from _flat(part, f"{path}.{name}")


def _holds(flat: Mapping[str, Any], wanted: Mapping[str, Tensor]) -> bool:
    """Whether each of the tensors is there under its name, in whatever dictionary."""
    return all(
        any(path.endswith(f".{name}") and close(part, want, 1e-3) for path, part in flat.items())
        for name, want in wanted.items()
    )


def _observed(flat: Mapping[str, Any], statistics: Mapping[str, Any]) -> Iterator[str]:
    """Sentences where mean, variance or number of the observations are not there."""

    def where(want: Tensor) -> list[str]:
        arrays = {path: torch.as_tensor(part) for path, part in flat.items() if not isinstance(part, str | None)}
        whole = {path: array for path, array in arrays.items() if array.numel() % len(want) == 0}
        return [path for path, array in whole.items() if any(close(row, want) for row in array.reshape(-1, len(want)))]

    names = [path.rpartition(".")[2] for path in where(statistics["mean"])]
    if names and all("var" in name and "mean" not in name for name in names):
        yield f"{names[0]} in the file is the mean of the observations. Likely: mean and variance are exchanged."
    if not names:
        yield "the mean of the observations is not in the file: the policy would see other numbers than before."
    if not where(statistics["var"]):
        paths = where(statistics["var"].sqrt())
        likely = " Likely: it is the standard deviation." if paths else ""
        said = f"the variance of the observations is not in the file.{likely}"
        yield Note(said) if any("std" in path for path in paths) else said
    if not where(statistics["count"]):
        yield Note("without obs_rms.count a resumed run would forget mean and variance with its first batch.")


def see_load_model(function: Function, seen: Seen) -> None:
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
    seen["right"] = _learned(agent, optimizer, envs)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "checkpoint.pt"
        torch.save(checkpoint, path)

        def attempt(wrappers: int, kind: type) -> None:
            setting = _setting(1, wrappers)
            given = dict(zip(CHECKPOINT, (*setting, kind(path)), strict=True))
            call_by_name(function, given, {"device map_location": "cpu"})
            seen["mine"] = _learned(*setting)

        first_that_works(attempt, *WRAPPERS)


def load_model(seen: Seen) -> Iterator[str]:
    """Sentences on what was loaded."""
    (agent, moments, statistics), (right_agent, right_moments, right_statistics) = seen["mine"], seen["right"]
    for name, weight in right_agent.items():
        if not close(agent[name], weight):
            yield f"the agent's weights are not those of the file ({name}). Likely: agent.load_state_dict is missing."
    if moments.keys() != right_moments.keys() or not all(close(moments[name], right_moments[name]) for name in moments):
        yield "the optimizer's moments or learning rate are not the file's. Likely: load_state_dict is missing."
    yield from _same_statistics(statistics, right_statistics, "of the environments", "the file's")
