"""Whether an environment is suitable for training: Gymnasium's own checker, and what it does not look at."""

import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode

from lemniscate.envs import registry
from lemniscate.envs.factory import make_one, maker_of
from lemniscate.envs.findings import BAD, GOOD, NOTE, Finding, learnable
from lemniscate.envs.gymnasium_check import api_findings, one_line
from lemniscate.envs.random_action import random_action
from lemniscate.envs.vec_env import VecEnv
from lemniscate.errors import NonFiniteError, UserError
from lemniscate.spec import Action, Box, Discrete, MultiDiscrete, Spec
from lemniscate.system.named import find_callable
from lemniscate.types import Rollout

NUM_ENVS, STEPS = 4, 500


def each_finding(
    env_id: str, backend: str | None, env_kwargs: Mapping[str, Any] | None, wrappers: Sequence[str]
) -> Iterator[Finding]:
    """The findings about an environment, one by one. Raises `UserError` if there is none of that name."""
    served_by = registry.backend_for(env_id, wrappers) if backend is None else registry.require_backend(backend)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            env = registry.make(env_id, NUM_ENVS, kwargs=env_kwargs, wrappers=wrappers, backend=backend)
    except UserError as error:
        yield Finding(BAD, str(error))
        return
    except Exception as error:  # the environment's own code, here and below: whatever it raises is the finding
        yield Finding(BAD, f"It cannot be made: {_told(error)}.")
        return
    try:
        yield from _spaces(env, served_by)
        if registry.can_wrap(served_by, env_id):
            maker = maker_of(env_id)
            make = partial(make_one, maker, tuple(map(find_callable, wrappers)), **(env_kwargs or {}))
            yield from api_findings(make, env_id, wrapped=bool(wrappers) or not isinstance(maker, EnvSpec))
        yield from _behaviour(env)
    finally:
        env.close()


def _spaces(env: VecEnv, served_by: str) -> Iterator[Finding]:
    spec = env.spec
    yield Finding(GOOD, f"Served by {served_by}; observes {_seen(spec)}; acts by {_describe(spec.action)}.")
    flat = [part for part in spec.observation_parts if len(part.shape) > 1 and min(sorted(part.shape)[-2:]) > 16]
    if flat and not spec.image:
        part = flat[0]
        yield Finding(
            NOTE,
            f"The array {part.name} {part.shape} becomes {part.size:,} numbers without their places; if it is an image,"
            " return uint8 of height × width × channels, or with the channels first, for a convolutional network.",
        )
    yield from _autoreset(env)
    if isinstance(spec.action, Box) and not np.isfinite([*spec.action.low, *spec.action.high]).all():
        yield Finding(
            NOTE, "Some actions have no bound: a policy begins around zero, or around one unit from the only bound."
        )


def _seen(spec: Spec) -> str:
    if not spec.image:
        parts = ", ".join(f"{part.name} {part.size}" for part in spec.observation_parts)
        return f"{spec.observation_size} numbers ({parts})"
    (part,) = spec.observation_parts
    height, width, channels = part.shape
    how = f"an image of {height} × {width} bytes with {channels} channel{'s' * (channels > 1)}"
    return f"{how}, from arrays {part.own_shape}" if part.own_shape else how


def _autoreset(env: VecEnv) -> Iterator[Finding]:
    mode = getattr(env.backend, "mode", None)
    if mode is AutoresetMode.SAME_STEP:
        yield Finding(GOOD, "Resets in the step that ends an episode, and gives the final observation in its info.")
    elif mode is AutoresetMode.NEXT_STEP:
        yield Finding(GOOD, "Resets in the step after an end; the action of that step is ignored and not learned from.")
    else:
        yield Finding(GOOD, "Is reset here, right after an episode's end; the final observation is kept.")


def _describe(action: Action) -> str:
    if isinstance(action, Box):
        return f"{action.size} continuous numbers"
    if isinstance(action, Discrete):
        return f"one of {action.n} choices" + (", masked" if action.masked else "")
    if isinstance(action, MultiDiscrete):
        return f"{len(action.nvec)} choices, of {', '.join(map(str, action.nvec))}"
    return f"{action.n} binary choices"


def _behaviour(env: VecEnv) -> Iterator[Finding]:
    try:
        started = time.perf_counter()
        first = _play(env, seed=0)
        speed = NUM_ENVS * STEPS / (time.perf_counter() - started)
        repeated = _same(first, _play(env, seed=0))
        other, acted = _play(env, seed=1), _play(env, seed=0, actions=8, steps=STEPS // 2)
    except NonFiniteError as error:
        yield Finding(BAD, f"{error} Learning would stop there.")
        return
    except UserError as error:
        yield Finding(BAD, str(error))
        return
    except Exception as error:
        yield Finding(BAD, f"It cannot be played with random actions: {_told(error)}.")
        return
    yield Finding(GOOD, f"{STEPS} random steps: every observation and reward is finite.")
    if not repeated:
        yield Finding(BAD, "The same seed and actions give another episode: runs cannot be repeated, nor resumed.")
    elif torch.equal(first.obs, other.obs):
        yield Finding(NOTE, "Another seed gives the same episodes: everything about it is deterministic.")
    else:
        yield Finding(GOOD, "The same seed gives the same episodes, another one others.")
    if _same(first[: STEPS // 2], acted) and not torch.equal(first.action[: STEPS // 2], acted.action):
        yield Finding(
            NOTE,
            "Other actions from the same seed had the same outcome in every step: nothing can be learned where actions"
            " are ignored; look whether step() uses its argument.",
        )
    yield from _rows(first)
    yield from learnable([first, other], env.spec)
    yield Finding(GOOD, f"{speed:,.0f} steps a second ({NUM_ENVS} parallel environments, random actions).")


def _same(one: Rollout, other: Rollout) -> bool:
    """Whether two rollouts had the same outcome."""
    outcome = ("obs", "next_obs", "reward", "terminated", "truncated")
    return all(torch.equal(getattr(one, name), getattr(other, name)) for name in outcome)


def _rows(rollout: Rollout) -> Iterator[Finding]:
    inside = (rollout.valid & ~rollout.done)[:-1]
    if not torch.equal(rollout.next_obs[:-1][inside], rollout.obs[1:][inside]):
        yield Finding(BAD, "Within an episode, an observation is not the one that the step before ended in.")
    ended, timed_out = int(rollout.terminated.sum()), int(rollout.truncated.sum())
    ignored = int((~rollout.valid).sum())
    resets = f", and {ignored} steps in which it ignored its action to reset itself, which are not learned from"
    yield Finding(
        GOOD, f"{ended} episodes ended by its rules and {timed_out} by the time limit{resets if ignored else ''}."
    )


def _play(env: VecEnv, seed: int, actions: int = 7, steps: int = STEPS) -> Rollout:
    """Random actions, the same for the same `actions`, a seed (up to masks)."""
    rng = torch.Generator().manual_seed(actions)
    rows = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Gymnasium's, of which we have told already
        env.restart(seed)
        for _ in range(steps):
            obs, action = env.obs, random_action(env.spec, env.obs, rng)
            step = env.step(action)
            rows.append(Rollout(obs, action, step.reward, step.next_obs, step.terminated, step.truncated, step.valid))
    return Rollout.stack(rows)


def _told(error: Exception) -> str:
    return f"{type(error).__name__}: {one_line(error).rstrip('.')}"
