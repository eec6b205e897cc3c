"""Is this environment fit to be learned in? Gymnasium's own checker, and what it does not look at."""

import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from lemniscate.envs import registry
from lemniscate.envs.factory import make_one, maker_of
from lemniscate.envs.images import is_image
from lemniscate.envs.spaces import follow, observation_parts
from lemniscate.envs.vec_env import VecEnv
from lemniscate.errors import NonFiniteError, UserError
from lemniscate.spec import Action, Box, Discrete, MultiDiscrete
from lemniscate.types import Rollout

NUM_ENVS, STEPS = 4, 500


@dataclass(frozen=True)
class Finding:
    """One sentence about an environment. `grade` is "good", "note" (works, but look at it) or "bad"."""

    grade: str
    sentence: str


def check(env_id: str, backend: str | None = None) -> Iterator[Finding]:
    """Everything found, one by one; the first that keeps it from being made is the last."""
    served_by = registry.backend_for(env_id) if backend is None else registry.require_backend(backend)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            env = registry.make(env_id, NUM_ENVS, backend=backend)
    except UserError as error:
        yield Finding("bad", str(error))
        return
    except Exception as error:  # the environment's own code, here and below: whatever it raises is the finding
        yield Finding("bad", f"It cannot be made: {_told(error)}.")
        return
    try:
        yield from _spaces(env, served_by)
        if registry.can_wrap(served_by, env_id):
            yield from _gymnasium(env_id)
        yield from _behaviour(env)
    finally:
        env.close()


def _spaces(env: VecEnv, served_by: str) -> Iterator[Finding]:
    spec = env.spec
    parts = ", ".join(f"{part.name} {part.size}" for part in spec.observation_parts)
    seen = "an image" if spec.image else f"{spec.observation_size} numbers ({parts})"
    yield Finding("good", f"Served by {served_by}; observes {seen}; acts by {_describe(spec.action)}.")
    yield from _autoreset(env)
    if spec.max_episode_steps is None:
        yield Finding("note", "It has no time limit: an episode that a policy does not end cannot be evaluated.")
    if isinstance(spec.action, Box) and not np.isfinite([*spec.action.low, *spec.action.high]).all():
        yield Finding(
            "note",
            "Some actions have no bound: a policy begins around zero, or around one unit from the only bound.",
        )


def _autoreset(env: VecEnv) -> Iterator[Finding]:
    mode = getattr(env.backend, "mode", None)
    if mode is AutoresetMode.SAME_STEP:
        yield Finding("good", "Resets in the step that ends an episode, and gives the final observation in its info.")
    elif mode is AutoresetMode.NEXT_STEP:
        yield Finding(
            "good", "Resets in the step after an end; the action of that step is ignored, and not learned from."
        )
    else:
        yield Finding("good", "Is reset here, right after an episode's end; the final observation is kept.")


def _describe(action: Action) -> str:
    if isinstance(action, Box):
        return f"{action.size} continuous numbers"
    if isinstance(action, Discrete):
        return f"one of {action.n} choices" + (", masked" if action.masked else "")
    if isinstance(action, MultiDiscrete):
        return f"{len(action.nvec)} choices, of {', '.join(map(str, action.nvec))}"
    return f"{action.n} switches"


def _gymnasium(env_id: str) -> Iterator[Finding]:
    found: list[Finding] = []
    env = make_one(maker_of(env_id))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            check_env(env.unwrapped, skip_render_check=True)
        except Exception as error:
            found.append(Finding("bad", f"Gymnasium's checker: {_one_line(error)}"))
        finally:
            env.close()
    told = sorted({_one_line(warning.message) for warning in caught if warning.category is UserWarning})
    found += [Finding("note", f"Gymnasium's checker: {sentence}") for sentence in told]
    yield from found or [Finding("good", "Gymnasium's checker finds nothing.")]
    if not any(finding.grade == "bad" for finding in found):
        yield from _dtypes(env_id)


def _dtypes(env_id: str) -> Iterator[Finding]:
    env = make_one(maker_of(env_id)).unwrapped
    obs, _ = env.reset(seed=0)
    kinds = {np.asarray(follow(part.path, obs)).dtype.name for part in observation_parts(env.observation_space, env_id)}
    env.close()
    kept = kinds == {"uint8"} and is_image(env.observation_space)
    as_what = "stay bytes" if kept else "reach the policy as float32"
    yield Finding("good", f"Its observations are {', '.join(sorted(kinds))}, and {as_what}.")


def _behaviour(env: VecEnv) -> Iterator[Finding]:
    try:
        started = time.perf_counter()
        first = _play(env, seed=0)
        speed = NUM_ENVS * STEPS / (time.perf_counter() - started)
        again, other = _play(env, seed=0), _play(env, seed=1)
    except NonFiniteError as error:
        yield Finding("bad", f"{error} Learning would stop there.")
        return
    except UserError as error:
        yield Finding("bad", str(error))
        return
    except Exception as error:
        yield Finding("bad", f"It cannot be played with random actions: {_told(error)}.")
        return
    yield Finding("good", f"{STEPS} random steps: every observation and reward is finite.")
    same = all(torch.equal(getattr(first, name), getattr(again, name)) for name in ("obs", "reward", "terminated"))
    if not same:
        yield Finding("bad", "The same seed and actions give another episode: runs cannot be repeated, nor resumed.")
    elif torch.equal(first.obs, other.obs):
        yield Finding("note", "Another seed gives the same episodes: everything about it is deterministic.")
    else:
        yield Finding("good", "The same seed gives the same episodes, another one others.")
    yield from _rows(first)
    rewards = first.reward[first.valid]
    if rewards.abs().max() > 100:
        yield Finding("note", f"Rewards reach {rewards.abs().max():.3g}; train with --scale-rewards.")
    yield Finding("good", f"{speed:,.0f} steps a second ({NUM_ENVS} parallel environments, random actions).")


def _rows(rollout: Rollout) -> Iterator[Finding]:
    inside = (rollout.valid & ~rollout.done)[:-1]
    if not torch.equal(rollout.next_obs[:-1][inside], rollout.obs[1:][inside]):
        yield Finding("bad", "Within an episode, an observation is not the one that the step before ended in.")
    ended, timed_out = int(rollout.terminated.sum()), int(rollout.truncated.sum())
    ignored = int((~rollout.valid).sum())
    resets = f", and {ignored} steps in which it ignored its action to reset itself, which are not learned from"
    yield Finding(
        "good", f"{ended} episodes ended by its rules and {timed_out} by the time limit{resets if ignored else ''}."
    )


def _play(env: VecEnv, seed: int) -> Rollout:
    """Random actions, always the same."""
    rng = np.random.default_rng(7)
    rows = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Gymnasium's, of which we have told already
        env.restart(seed)
        for _ in range(STEPS):
            obs, action = env.obs, torch.from_numpy(_random(env, rng))
            step = env.step(action)
            rows.append(Rollout(obs, action, step.reward, step.next_obs, step.terminated, step.truncated, step.valid))
    return Rollout.stack(rows)


def _random(env: VecEnv, rng: np.random.Generator) -> np.ndarray:
    action = env.spec.action
    if isinstance(action, Box):
        return rng.uniform(-1, 1, (env.num_envs, action.size)).astype(np.float32)
    if isinstance(action, MultiDiscrete):
        return rng.integers(action.nvec, size=(env.num_envs, len(action.nvec)))
    if isinstance(action, Discrete) and action.masked:
        masks = env.obs[:, -action.n :].numpy()
        return np.array([rng.choice(np.flatnonzero(mask)) for mask in masks])
    if isinstance(action, Discrete):
        return rng.integers(action.n, size=env.num_envs)
    return rng.integers(2, size=(env.num_envs, action.n))


def _told(error: Exception) -> str:
    return f"{type(error).__name__}: {_one_line(error).rstrip('.')}"


def _one_line(message: object) -> str:
    text = str(message).replace("\x1b[33m", "").replace("\x1b[0m", "").removeprefix("WARN: ")
    return " ".join(text.split())
