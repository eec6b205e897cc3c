"""Exercises on the setup of a training loop: seeds, environments, and the statistics of their observations."""

import random
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import SyncVectorEnv
from gymnasium.wrappers.vector import NormalizeObservation
from torch import nn

from lemniscate.course.exercise import Function, Note, call_by_name
from lemniscate.run.seeding import seed_globals

# ruff: noqa: NPY002  (the legacy generator of NumPy is one that is to be seeded)


def set_seeds(function: Function) -> Iterator[str]:
    """`set_seeds(seed)`: every generator, and cuDNN."""
    with _cudnn_undisturbed():
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
                elif found != want:
                    yield f"{name} is seeded by another number than the argument. Likely: a number stands in its place."
        if not torch.backends.cudnn.deterministic:
            yield "cuDNN may choose kernels that are not reproducible. Likely: cudnn.deterministic = True is missing."
        if torch.backends.cudnn.benchmark:
            said = "cuDNN's benchmark mode may choose other kernels in each run."
            yield f"{said} Likely: cudnn.benchmark = False is missing."


@contextmanager
def _cudnn_undisturbed() -> Iterator[None]:
    """Restore the switches of determinism afterwards."""
    before = torch.backends.cudnn.deterministic, torch.backends.cudnn.benchmark
    algorithms = torch.are_deterministic_algorithms_enabled(), torch.is_deterministic_algorithms_warn_only_enabled()
    try:
        yield
    finally:
        torch.backends.cudnn.deterministic, torch.backends.cudnn.benchmark = before
        torch.use_deterministic_algorithms(algorithms[0], warn_only=algorithms[1])


def make_envs(function: Function) -> Iterator[str]:
    """`make_envs(n_envs, n_eval_envs, …)`: vector environments for training and for evaluation."""
    numbers = {"n_envs": 3, "n_eval_envs": 2, "train_device": "cpu", "device": "cpu", "env_name": "CartPole-v1"}
    made = call_by_name(function, **numbers, env_id="CartPole-v1")
    if not isinstance(made, tuple) or len(made) != 2 or not all(hasattr(envs, "num_envs") for envs in made):
        yield "it should return two vector environments, for training and for evaluation."
        return
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
    if (train.num_envs, evaluation.num_envs) == (2, 3):
        yield "3 for training and 2 for evaluation were asked for. Likely: n_envs and n_eval_envs are exchanged."
    elif (train.num_envs, evaluation.num_envs) != (3, 2):
        made = f"{train.num_envs} and {evaluation.num_envs}"
        yield f"3 for training and 2 for evaluation were asked for, and {made} made."
    if train.single_observation_space.shape != evaluation.single_observation_space.shape:
        yield "observations of training and evaluation have other shapes. Likely: a wrapper is around one of them only."
    norms = normalizer(train), normalizer(evaluation)
    if (norms[0] is None) != (norms[1] is None):
        yield "only one of the two normalizes observations: the policy would see other numbers than it was trained on."
    elif norms[0] is not None:
        if norms[0].update_running_mean is False:
            yield "the statistics of training never change. Likely: update_running_mean = False belongs to evaluation."
        if norms[1].update_running_mean:
            yield "evaluation changes the statistics. Likely: eval_envs.update_running_mean = False is missing."
    else:
        yield Note(
            "neither normalizes observations; save_model and sync_envs of the drone's course need NormalizeObservation."
        )


def normalizer(envs: Any) -> Any:
    """The wrapper that normalizes observations; None where there is none."""
    while envs is not None and not hasattr(type(envs), "update_running_mean"):
        envs = vars(envs).get("env")
    return envs


class _Agent(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.actor, self.critic = nn.Linear(4, 2), nn.Linear(4, 1)
        self.actor_logstd = nn.Parameter(torch.zeros(1, 2))


def setting(steps: int) -> tuple[nn.Module, torch.optim.Optimizer, Any]:
    """An agent, its optimizer and its environments, after so many steps."""
    torch.manual_seed(steps)
    agent = _Agent()
    optimizer = torch.optim.AdamW(agent.parameters(), lr=1e-3, eps=1e-5)
    inner = NormalizeObservation(SyncVectorEnv([lambda: gym.make("CartPole-v1")] * 2))
    envs = gym.wrappers.vector.RecordEpisodeStatistics(inner)  # so that the normalizer has to be looked for
    envs.reset(seed=steps)
    for _ in range(steps):
        obs, *_ = envs.step(np.ones(2, dtype=np.int64))
        loss = sum(layer(torch.from_numpy(obs)).square().mean() for layer in (agent.actor, agent.critic))
        optimizer.zero_grad()
        (loss + agent.actor_logstd.sum()).backward()
        optimizer.step()
    return agent, optimizer, envs


def same_statistics(mine: Any, right: Any, whose: str, whence: str) -> Iterator[str]:
    """Whether two running means and variances are equal."""
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
    train, evaluation = setting(5)[2], setting(1)[2]
    normalizer(evaluation).update_running_mean = False
    before = normalizer(train).obs_rms
    mean, var, count = np.copy(before.mean), np.copy(before.var), before.count
    other = np.copy(normalizer(evaluation).obs_rms.mean)
    function(train, evaluation)
    if not np.array_equal(normalizer(train).obs_rms.mean, mean):
        swapped = np.array_equal(normalizer(train).obs_rms.mean, other)
        yield "the statistics of training have changed." + (
            " Likely: it copies in the wrong direction." if swapped else ""
        )
    right = type(before)(shape=mean.shape)
    right.mean, right.var, right.count = mean, var, count
    yield from same_statistics(normalizer(evaluation).obs_rms, right, "of evaluation", "that of training")
    evaluation.reset(seed=9)
    if not np.array_equal(normalizer(evaluation).obs_rms.mean, mean):
        yield "an evaluation changes the statistics. Likely: update_running_mean is True in eval_envs."
    train.reset(seed=9)
    if not np.array_equal(normalizer(evaluation).obs_rms.mean, mean):
        yield Note("both now share one object: the statistics of evaluation follow training without another call.")
