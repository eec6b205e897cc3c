"""Whether an environment is suitable for training: Gymnasium's own checker, and what random play shows."""

import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from copy import deepcopy
from dataclasses import dataclass
from functools import partial, reduce
from operator import getitem
from textwrap import wrap
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env, data_equivalence
from torch import Tensor

from lemniscate.envs import registry
from lemniscate.envs.conversion import SingleEnv
from lemniscate.envs.factory import make_one, maker_of
from lemniscate.envs.returned import flat_mask, mask_in, shown_space
from lemniscate.envs.spaces import observation_parts, random_action
from lemniscate.envs.vec_env import VecEnv
from lemniscate.envs.vector_view import action_space
from lemniscate.errors import NonFiniteError, UserError
from lemniscate.spec import Action, Box, Discrete, MultiDiscrete, ObservationPart, Spec
from lemniscate.system.named import find, find_callable
from lemniscate.types import Rollout

GOOD, NOTE, BAD = "good", "note", "bad"
MARKS = {GOOD: "✓", NOTE: "!", BAD: "✗"}
RESETS = {
    "SAME_STEP": "Resets in the step that ends an episode, and gives the final observation in its info.",
    "NEXT_STEP": "Resets in the step after an end; the action of that step is ignored and not learned from.",
    "DISABLED": "Is reset here, right after an episode's end; the final observation is kept.",
}
NUM_ENVS, STEPS = 4, 500
LARGE_RATIO = 1e4
"""a ratio of sizes of observations from which on a network does not see the small ones"""
LARGE_REWARD = 100
"""a reward from which on the errors of the value network are too large for its learning rate"""
BESIDE_THE_POINT = ("infinity. This is probably", "we recommend using a symmetric and normalized space")
"""Gymnasium's warnings about spaces that do not matter here, where observations are normalized and actions scaled"""


@dataclass(frozen=True)
class Finding:
    """One sentence about what is checked. `grade` is "good", "note" (works, but look at it) or "bad"."""

    grade: str
    sentence: str

    def __str__(self) -> str:
        return self.listed(112)

    def listed(self, width: int) -> str:
        """The sentence as an item of a list, wrapped at `width` columns."""
        lines = wrap(self.sentence, width - 2, break_long_words=False, break_on_hyphens=False)
        return f"{MARKS[self.grade]} " + "\n  ".join(lines)


good, note, bad = (partial(Finding, grade) for grade in (GOOD, NOTE, BAD))


def verdict(env_id: str, findings: Sequence[Finding]) -> str:
    """Whether an environment is suitable for training, in one sentence."""
    flaws, notes = (sum(finding.grade == grade for finding in findings) for grade in (BAD, NOTE))
    if flaws:
        return f"{env_id} is not suitable for training: {flaws} finding{'s' * (flaws > 1)} above, marked {MARKS[BAD]}."
    look = f"; look at the {notes} note{'s' * (notes > 1)} above, marked {MARKS[NOTE]}" if notes else ""
    return f"{env_id} is suitable for training{look}."


def each_finding(
    env_id: str,
    backend: str | None,
    env_kwargs: Mapping[str, Any] | None,
    wrappers: Sequence[str],
    judge: Callable[[Sequence[Rollout], Spec], Sequence[str]],
) -> Iterator[Finding]:
    """The findings about an environment, one by one. Raises `UserError` if there is none of that name.

    Beside what is found here, `judge` says what rollouts [T, N, …] of random play show of its rewards, observations and
    actions.
    """
    served_by = backend or registry.backend_for(env_id, wrappers)
    cls = registry.backend_class(served_by)  # an unknown backend is an error of the question, not a finding
    num_envs = (registry.count_of(find(env_id)) if ":" in env_id else None) or NUM_ENVS
    try:
        with warnings.catch_warnings(action="ignore"):
            env = registry.make(env_id, num_envs, kwargs=env_kwargs, wrappers=wrappers, backend=backend)
    except Exception as error:  # the environment's own code, here and below: whatever it raises is the finding
        yield _raised(error, "It cannot be made")
        return
    try:
        yield good(f"Served by {served_by}; observes {_observation_text(env.spec)}; acts by {_acts(env.spec.action)}.")
        yield good(RESETS[env.backend.mode.name])
        if cls.wraps(env_id):
            maker = maker_of(env_id)
            one = make_one(maker, tuple(map(find_callable, wrappers)), **(env_kwargs or {}))
            yield from _gymnasium(one, env_id, wrapped=bool(wrappers) or not isinstance(maker, EnvSpec))
        yield from _random_play(env, judge)
    finally:
        env.close()


def _raised(error: Exception, what: str) -> Finding:
    if isinstance(error, NonFiniteError):
        return bad(f"{error} Learning would stop there.")
    known = isinstance(error, UserError)
    return bad(str(error) if known else f"{what}: {type(error).__name__}: {_one_line(error).rstrip('.')}.")


def _one_line(message: object) -> str:
    """A message of Gymnasium's or of an exception, without colours and line breaks."""
    text = str(message).replace("\x1b[33m", "").replace("\x1b[0m", "").removeprefix("WARN: ")
    return " ".join(text.split())


def spaces_of(spec: Spec) -> tuple[str, str]:
    """The observation and the space of actions of an environment, as parts of a sentence."""
    return _observation_text(spec), shown_space(action_space(spec.action))


def _observation_text(spec: Spec) -> str:
    seen, numbers = list[str](), list[ObservationPart]()
    for part in spec.observation_parts:
        if not part.image:
            numbers.append(part)
            continue
        height, width, channels = part.shape
        name = f" {part.name}" if part.path else ""
        how = f"an image{name} of {height} × {width} bytes with {channels} channel{'s' * (channels > 1)}"
        seen.append(f"{how}, from arrays {part.own_shape}" if part.own_shape else how)
    if numbers:
        size, parts = sum(part.size for part in numbers), ", ".join(f"{part.name} {part.size}" for part in numbers)
        seen.append(f"{size} numbers ({parts})")
    return " and ".join(seen)


def _acts(action: Action) -> str:
    if isinstance(action, Box):
        return f"{action.size} continuous numbers"
    if isinstance(action, Discrete):
        return f"one of {action.n} choices" + (", masked" if action.masked else "")
    if isinstance(action, MultiDiscrete):
        return f"{len(action.nvec)} choices, of {', '.join(map(str, action.nvec))}"
    return f"{action.n} binary choices"


def _random_play(env: VecEnv, judge: Callable[[Sequence[Rollout], Spec], Sequence[str]]) -> Iterator[Finding]:
    """Finite numbers, seeds, effects of actions, rows, ends, and whatever else random play shows."""
    try:
        started = time.perf_counter()
        first, lengths = _play(env, seed=0)
        speed = env.num_envs * STEPS / (time.perf_counter() - started)
        repeated = _same(first, _play(env, seed=0)[0])
        other, more_lengths = _play(env, seed=1)
        acted, _ = _play(env, seed=0, action_seed=8, steps=STEPS // 2)
    except Exception as error:
        yield _raised(error, "It cannot be played with random actions")
        return
    yield good(f"{STEPS} random steps: every observation and reward is finite.")
    yield from map(note, env.backend.notices)
    if not repeated:
        yield bad("The same seed and actions give another episode: runs cannot be repeated, nor resumed.")
    elif torch.equal(first.obs, other.obs):
        yield note("Another seed gives the same episodes: everything about it is deterministic.")
    else:
        yield good("The same seed gives the same episodes, another one others.")
    if _same(first[: STEPS // 2], acted) and not torch.equal(first.action[: STEPS // 2], acted.action):
        yield note(
            "Other actions from the same seed had the same outcome in every step: nothing can be learned where actions"
            " are ignored; look whether step() uses its argument."
        )
    inside = (first.valid & ~first.done)[:-1]
    if not torch.equal(first.next_obs[:-1][inside], first.obs[1:][inside]):
        yield bad("Within an episode, an observation is not the one that the step before ended in.")
    ended, timed_out, ignored = (int(x.sum()) for x in (first.terminated, first.truncated, ~first.valid))
    resets = f", and {ignored} steps in which it ignored its action to reset itself, which are not learned from"
    yield good(f"{ended} episodes ended by its rules and {timed_out} by the time limit{resets if ignored else ''}.")
    both = Rollout(*map(torch.cat, zip(vars(first).values(), vars(other).values(), strict=True)))
    yield from _ends_and_rewards(both, lengths + more_lengths, env.spec)
    yield from _sizes(both.obs[both.valid], env.spec)
    yield from map(note, judge((first, other), env.spec))
    yield good(f"{speed:,.0f} steps a second ({env.num_envs} parallel environments, random actions).")


def _play(env: VecEnv, seed: int, action_seed: int = 7, steps: int = STEPS) -> tuple[Rollout, list[int]]:
    """Random play from a seed, and the lengths of its episodes; `action_seed` is that of its actions, up to masks."""
    rng = torch.Generator().manual_seed(action_seed)
    rows = []
    with warnings.catch_warnings(action="ignore"):  # Gymnasium's, of which we have told already
        env.restart(seed)
        for _ in range(steps):
            obs, action = env.obs, random_action(env.spec, env.obs, rng)
            step = env.step(action)
            rows.append(Rollout(obs, action, step.reward, step.next_obs, step.terminated, step.truncated, step.valid))
    return Rollout.stack(rows), env.take_episodes().lengths


def _same(one: Rollout, other: Rollout) -> bool:
    """Whether two rollouts had the same outcome."""
    outcome = ("obs", "next_obs", "reward", "terminated", "truncated")
    return all(torch.equal(getattr(one, name), getattr(other, name)) for name in outcome)


def _ends_and_rewards(rows: Rollout, lengths: Sequence[int], spec: Spec) -> Iterator[Finding]:
    """Obstacles to learning in the ends of episodes and in the rewards, each with what to do."""
    rewards, terminated, truncated = rows.reward[rows.valid], rows.terminated.any(), rows.truncated.any()
    alike = len(lengths) > 2 and len(set(lengths)) == 1
    if spec.max_episode_steps is None and not truncated:
        yield note(
            f"No time limit was met in {STEPS} steps: without one, an episode that a policy does not end cannot be"
            " evaluated; register it with max_episode_steps, or add --wrappers"
            " 'gymnasium.wrappers:TimeLimit(max_episode_steps=1000)'."
        )
    if alike and terminated and not truncated and lengths[0] > 1:
        yield note(
            f"Each of {len(lengths)} episodes terminated after exactly {lengths[0]} steps: if that is a time"
            " limit, report it as truncated, or learning takes the value there to be 0."
        )
    if (rewards == rewards[0]).all() and (rewards[0] == 0 or alike or not len(lengths)):
        yield note(
            f"Every reward was {rewards[0]:g}, whatever was done: nothing is learned until random actions meet another;"
            " if rewards are meant to be rare, reward the way there too."
        )
    if rewards.abs().max() > LARGE_REWARD:
        yield note(
            f"Rewards reach {rewards.abs().max():.3g}, which makes the first value errors too large; train with"
            " --scale-rewards (on-policy), or pay less."
        )


def _sizes(obs: Tensor, spec: Spec) -> Iterator[Finding]:
    """A note on observations of very different sizes."""
    largest = obs[:, : spec.observation_size].abs().amax(dim=0)
    numbers = torch.tensor([not part.image for part in spec.observation_parts for _ in range(part.size)])
    sizes = torch.where((largest > 0) & numbers, largest, torch.nan)
    if sizes.isnan().all():
        return
    high, low = sizes.nan_to_num(0).argmax(), sizes.nan_to_num(torch.inf).argmin()
    if sizes[high] >= LARGE_RATIO * sizes[low]:
        names = [f"{part.name}[{i}]" for part in spec.observation_parts for i in range(part.size)]
        yield note(
            f"Observations reach {sizes[high]:.1g} in {names[high]} and {sizes[low]:.1g} in {names[low]}: the network"
            " does not see the small ones; train with --normalize-observations, or bring them to about 1."
        )


def _gymnasium(env: SingleEnv, env_id: str, wrapped: bool) -> Iterator[Finding]:
    """The result of Gymnasium's checker without its false alarms, and whether observations are copies.

    `wrapped` checks the environment with its wrappers, the user's own; otherwise what is inside of Gymnasium's.
    """
    found = list[Finding]()
    careful = Careful(env.env if wrapped else env.unwrapped)  # what is looked at are its own returns
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            check_env(careful, skip_render_check=True, skip_close_check=wrapped)
        except Exception as error:
            why = _why_outside(careful) if "not within the observation space" in str(error) else ""
            found.append(bad(f"Gymnasium's checker: {_one_line(error)}{why}"))
    told = {_one_line(warning.message) for warning in caught if warning.category is UserWarning}
    minded = sorted(sentence for sentence in told if not any(part in sentence for part in BESIDE_THE_POINT))
    notes = [note(f"Gymnasium's checker: {sentence}") for sentence in minded]
    yield from found + notes or [good("Gymnasium's checker finds nothing.")]
    if careful.reuses:
        yield note(
            "It writes each observation into the array that it returned before, which changes what others kept of it;"
            " return a copy, obs.copy(). (lemniscate copies every observation.)"
        )
    if not found:
        obs, space = env.reset(seed=0)[0], env.observation_space
        parts = observation_parts(space, env_id)
        kinds = {np.asarray(reduce(getitem, part.path, obs)).dtype.name for part in parts}
        as_what = "stay bytes" if all(part.image for part in parts) else "reach the policy as float32"
        yield good(f"Its observations are {', '.join(sorted(kinds))}, and {as_what}.")
    env.close()


def _why_outside(env: gym.Env) -> str:
    """The difference between the first observation and its space, a Box, in a sentence that follows Gymnasium's."""
    space, obs = env.observation_space, np.asarray(env.reset(seed=0)[0])
    if not isinstance(space, gym.spaces.Box):
        return ""
    if not np.can_cast(obs.dtype, space.dtype):
        return f" It is {obs.dtype}, the space {space.dtype}: return obs.astype(np.{space.dtype})."
    if obs.shape != space.shape:
        return f" Its shape is {obs.shape}, that of the space {space.shape}."
    outside = np.argwhere((obs < space.low) | (obs > space.high))
    if not len(outside):
        return ""
    place = tuple(outside[0])
    bounds = f"[{space.low[place]:g}, {space.high[place]:g}]"
    return f" Its number {', '.join(map(str, place))} is {obs[place]:g}, outside of {bounds}."


class Careful(gym.Env):
    """An environment as learning uses it: only legal actions, and of every observation a copy.

    It is no `gym.Wrapper`, since Gymnasium's checker warns of an environment with one. `reuses` is whether an
    observation changed after it had been returned.
    """

    def __init__(self, env: gym.Env) -> None:
        self.env, self.spec, self.metadata = env, env.spec, env.metadata
        self.observation_space, self.action_space = env.observation_space, env.action_space
        self.reuses, self._mask = False, None
        self._returned = self._copy = None

    @property
    def _np_random(self) -> np.random.Generator | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.env.unwrapped._np_random

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Reset."""
        return self._copied(*self.env.reset(seed=seed, options=options))

    def step(self, action: Any) -> Any:
        """Take the action, or the first legal one."""
        space, mask = self.action_space, self._mask
        if mask is not None and isinstance(space, gym.spaces.Discrete):
            action = action if mask[action - space.start] else space.start + np.argmax(mask)
        elif mask is not None and isinstance(space, gym.spaces.MultiDiscrete):
            parts = np.split(mask, np.cumsum(space.nvec)[:-1])
            action = space.start + np.reshape([np.argmax(part) for part in parts], space.shape)
        obs, *rest, info = self.env.step(action)
        obs, info = self._copied(obs, info)
        return obs, *rest, info

    def _copied(self, obs: Any, info: Any) -> tuple[Any, Any]:
        """A copy of the observation, and the info. Notes the mask, and whether the observation before has changed."""
        comparable = self._copy is not None and data_equivalence(self._copy, self._copy, exact=True)  # not with a NaN
        self.reuses |= comparable and not data_equivalence(self._returned, self._copy, exact=True)
        self._returned, self._copy = obs, deepcopy(obs)
        if isinstance(info, dict):
            _, mask = mask_in(obs, info)
            with suppress(ValueError):  # one that is wrong is found by random play
                self._mask = self._mask if mask is None else flat_mask(mask, self.action_space)
        return deepcopy(obs), info
