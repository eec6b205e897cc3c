"""Parallel environments as algorithms use them, and the episodes that run in them."""

import math
from collections import deque
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lemniscate.envs.backend import Backend, Joined
from lemniscate.envs.returned import kind_of
from lemniscate.envs.symmetry import Mirror
from lemniscate.errors import NonFiniteError, UserError, shown, wrong_action
from lemniscate.spec import Box, Spec, action_shape
from lemniscate.system.world import ALONE, World
from lemniscate.types import Rollout, Step, wide_float

PATIENCE = 20_000
"""steps that an episode may take in an environment without a time limit, where whole ones are wanted"""
RECENT_ROWS, RECENT_BYTES = 1024, 2**23
"""the newest rows that are kept, and the bytes of their observations: whichever is less"""
LOG_ROWS = 1024
"""steps after which the logged ones are summed up"""


class VecEnv:
    """N parallel environments with their current observation and the statistics of their episodes.

    Where the W processes of a world share them, each steps its own `backend` of N / W, and all learn what came of every
    one.
    """

    def __init__(self, backend: Backend, world: World = ALONE) -> None:
        self.backend, self._world = backend, world
        if not isinstance(getattr(backend, "spec", None), Spec):
            raise UserError(f"{type(backend).__name__} must have a spec, a Spec of lemniscate.spec.")
        self.spec = backend.spec
        self.num_envs = world.size * backend.num_envs
        self._first = world.rank * backend.num_envs
        self.device = backend.device
        self.summaries, self.scene, self.baseline = backend.summaries, backend.scene, backend.baseline
        self.obs = torch.empty(0)
        self.carrier: Any = None
        """the `Carrier` of `nn.memory` that appends what a policy remembers to the observations"""
        self.mirror: Mirror | None = None
        """the mirror image of transitions, where they are learned from too"""
        self.collecting = 0.0
        """seconds that the functions of `data` have spent acting and stepping since the last line of metrics"""
        self.steps = 0
        size = (1 if self.spec.image else 4) * max(1, self.spec.observation_size)
        kept = min(RECENT_ROWS, RECENT_BYTES // size) // self.num_envs
        self._recent: deque[tuple[Tensor, Tensor, Step]] = deque(maxlen=max(4, kept))
        self._statistics = EpisodeStatistics(self.num_envs, self.device)
        self._actions: tuple[torch.Size, torch.dtype] | None = None  # before it is restarted, none is right
        self._kind = type(backend.parts[0] if isinstance(backend, Joined) else backend)
        self._is_own = not self._kind.__module__.startswith("lemniscate.")

    def restart(self, seed: int, steps: int = 0) -> Tensor:
        """Begin again from a seed; also stored as `obs`, [N, O]. `steps` is what the run has taken.

        Raises `UserError` for a seed that is no whole number at least 0.
        """
        if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
            raise UserError(f"seed must be a whole number at least 0, not {shown(seed)}.")
        seed = int(seed)
        self.steps = steps
        self._recent.clear()
        self._statistics = EpisodeStatistics(self.num_envs, self.device)
        mine = self.backend.restart(seed, self._first)
        if self._is_own:
            mine = self._copy("restart", "obs", mine)
            self._copy("restart", "counts", getattr(self.backend, "counts", None), torch.bool)
        self._actions = _action_layout(self.spec, self.num_envs)
        self._require_finite(observation=mine)
        self.obs = self._world.gather(mine)
        if self.carrier:
            self.obs = self.carrier.begin(self.obs)
        return self.obs

    def step(self, action: Tensor) -> Step:
        """Act in every environment and move `obs` on; actions as in `Backend.step`.

        Raises:
            NonFiniteError: an action, an observation or a reward is NaN or infinite; nothing has learned from it yet.
            UserError: actions of another kind or shape.
        """
        if not isinstance(action, Tensor) or (action.shape, action.dtype) != self._actions:
            raise wrong_action(f"{self.num_envs} × {self.spec.env_id}", action, self._actions)
        self._require_finite(action=action)
        mine = action if self._world.size == 1 else action[self._first : self._first + self.backend.num_envs]
        counts = self.backend.counts
        step = self.backend.step(mine.clone())  # an environment may write into the action that it was given
        step = self._copied(step) if self._is_own else step
        self._require_finite(observation=step.next_obs, reward=step.reward)
        if step.obs is not step.next_obs:
            self._require_finite(observation=step.obs)
        own = step.detach() if step.reward.requires_grad else step
        if self._world.size > 1:
            step, counts = self._of_all(step, counts)
        if self.carrier:
            step = self.carrier.follow(self.obs, step)
        seen = step.detach() if step.reward.requires_grad else step
        self._recent.append((self.obs.detach(), action.detach(), seen))
        self.obs = step.obs
        self.steps += self.num_envs
        self._statistics.log(seen, counts, own)
        return step

    def _copied(self, step: Step) -> Step:
        """The step of a backend of one's own, copied, since it may be written over. Raises `UserError` for no step."""
        if not isinstance(step, Step):
            who = self._kind.__name__
            raise UserError(f"{who}.step() returns {kind_of(step)}; it must be a Step of lemniscate.types.")
        flags, names = ("terminated", "truncated", "valid"), ("obs", "next_obs", "reward")
        copies = {name: self._copy("step", name, getattr(step, name), torch.bool) for name in flags}
        copies |= {name: self._copy("step", name, getattr(step, name)) for name in names}
        for name, values in step.measures.items():
            self._copy("step", f"measures[{name!r}]", values)
        return replace(step, **{**copies, "truncated": copies["truncated"] & ~copies["terminated"]})

    def _copy(self, method: str, name: str, value: Any, kind: torch.dtype | None = None) -> Tensor:
        """A copy of what a backend of one's own returned. Raises `UserError` for another shape or type."""
        columns = self.spec.observation_size + self.spec.privileged + self.spec.action.mask_size
        shape = (self.backend.num_envs, columns) if "obs" in name else (self.backend.num_envs,)
        kind = kind or (torch.uint8 if self.spec.image and "obs" in name else torch.get_default_dtype())
        if not isinstance(value, Tensor) or (value.shape, value.dtype) != (shape, kind):
            said = f"{self._kind.__name__}.{method}() returns {kind_of(value)} as {name}"
            raise UserError(f"{said}; it must be a Tensor {list(shape)} of {kind}.")
        return value.clone()

    def detach(self) -> None:
        """Take the present state and `obs` as given; see `Backend.detach`."""
        self.obs = self.obs.detach()
        self.backend.detach()

    def _of_all(self, step: Step, counts: Tensor) -> tuple[Step, Tensor]:
        """The step of the environments of all processes, and its counts; without measures, which nobody reads here."""
        names = ("obs", "next_obs", "reward", "terminated", "truncated", "valid")
        *columns, counts = self._world.gather_columns([*(getattr(step, name) for name in names), counts])
        return replace(step, **dict(zip(names, columns, strict=True)), measures={}), counts

    def _require_finite(self, **quantities: Tensor) -> None:
        for name, values in quantities.items():
            if not values.is_floating_point() or math.isfinite(values.sum().item()):  # a NaN shows in the sum
                continue
            bad = torch.nonzero(~torch.isfinite(values))
            if len(bad):
                first = 0 if name == "action" else self._first  # actions are those of all processes
                value, number = values[tuple(bad[0])].item(), first + int(bad[0, 0])
                why = "" if math.isnan(value) else "; float32 holds numbers up to 3.4e38"
                what = f"The {name} of environment {number} is {value} in the step after {self.steps:,}{why}."
                raise NonFiniteError(what)

    def require_end(self, age: int) -> None:
        """Raise `UserError` where an episode of `age` steps has had its chance to end, and there is no time limit."""
        env_id = self.spec.env_id
        require_end(env_id, age, self.spec.max_episode_steps, type(self.backend).wraps(env_id))

    def recent(self) -> Rollout | None:
        """The newest rows since the last restart, [T, N, …], some thousand; None before the first step."""
        rows = [
            Rollout(obs, action, step.reward, step.next_obs, step.terminated, step.truncated, step.valid)
            for obs, action, step in self._recent
        ]
        return Rollout.stack(rows) if rows else None

    def take_episodes(self) -> "Episodes":
        """The whole episodes that ended since the last call, and the means of all measures over its steps."""
        return self._statistics.take(self._world)

    @property
    def ages(self) -> Tensor:
        """The steps that the present episode of each environment had at the last `take_episodes`, [N]."""
        return self._statistics.ages

    def close(self) -> None:
        """Give back processes and windows."""
        self.backend.close()


def require_end(env_id: str, age: int, limit: int | None, can_wrap: bool = True) -> None:
    """Raise `UserError` where an episode of `age` steps has had its chance to end, beyond its time `limit` if any."""
    if limit is not None and age >= limit + PATIENCE:
        raise UserError(
            f"An episode of {env_id} has not ended after {age:,} steps, and its time limit is {limit:,}: it must return"
            " truncated there."
        )
    if limit is None and age >= PATIENCE:
        said = (
            f"An episode of {env_id} has not ended after {PATIENCE:,} steps, and there is no time limit: return"
            " truncated in its step(), or train with --wrappers 'gymnasium.wrappers:TimeLimit(max_episode_steps=1000)'."
        )
        raise UserError(said if can_wrap else f"{said.partition(', or train')[0]}.")


def _action_layout(spec: Spec, num_envs: int) -> tuple[torch.Size, torch.dtype]:
    kind = torch.float32 if isinstance(spec.action, Box) else torch.int64
    return torch.Size((num_envs, *action_shape(spec.action))), kind


@dataclass(frozen=True)
class Episodes:
    """Whole episodes that ended, in the order of their ends, and the means of what the environments measured."""

    returns: list[float]
    lengths: list[int]
    measures: dict[str, float] = field(default_factory=dict)


class EpisodeStatistics:
    """Returns and lengths, summed up over many logged steps at once, since [T, N] costs hardly more than [N].

    Fragments (episodes that staggering began late or cut early) and ignored actions (`valid` False) are not counted.
    Beside them are the means of all measures, over the steps in which they were given.
    """

    def __init__(self, num_envs: int, device: torch.device) -> None:
        self._log: list[tuple[Tensor, ...]] = []
        self._running = torch.zeros(2, num_envs, dtype=wide_float(device), device=device)
        self._ended: list[Tensor] = []
        self._measured: dict[str, list[tuple[Tensor, Tensor]]] = {}
        """by name: a measure in each logged step, and where it counts, [N] each"""
        self._sums: dict[str, Tensor] = {}
        """by name: [2, N], the sum of each environment, and how many numbers it has"""

    def log(self, step: Step, counts: Tensor, own: Step) -> None:
        """One step of every environment; `counts` [N] is False where the episode is a fragment.

        `own` is that of the environments of this process, which alone have measures here.
        """
        self._log.append((step.reward, step.terminated, step.truncated, step.valid, counts))
        for name, values in own.measures.items():
            self._measured.setdefault(name, []).append((values, own.valid))
        if len(self._log) == LOG_ROWS:
            self._sum_up()

    def take(self, world: World = ALONE) -> Episodes:
        """The whole episodes that ended since the last call, and the means of what all processes measured."""
        if self._log:
            self._sum_up()
        returns, lengths = torch.cat([self._running.new_zeros(2, 0), *self._ended], dim=1)
        self._ended = []
        means = self._means(world) if self._sums or world.size > 1 else {}
        return Episodes(returns.tolist(), lengths.int().tolist(), means)

    @property
    def ages(self) -> Tensor:
        """The length of each unfinished episode at the last `take`, [N]."""
        return self._running[1]

    def _sum_up(self) -> None:
        reward, terminated, truncated, valid, counts = map(torch.stack, zip(*self._log, strict=True))
        done = (terminated | truncated) & valid
        running = episode_sums(torch.stack([reward * valid, valid]).to(self._running.dtype), done, self._running)
        self._ended.append(running[:, done & counts])  # by time, then by environment
        self._running = running[:, -1] * ~done[-1]
        for name, rows in self._measured.items():
            values, valid = map(torch.stack, zip(*rows, strict=True))
            counted = values.isfinite() & valid
            sums = torch.stack([values.where(counted, 0), counted]).to(self._running.dtype).sum(1)
            self._sums[name] = self._sums[name] + sums if name in self._sums else sums
        self._log, self._measured = [], {}

    def _means(self, world: World) -> dict[str, float]:
        """The mean of each measure, summed up over the environments in their order, whichever process has them."""
        own = {name: sums.tolist() for name, sums in self._sums.items()}
        self._sums, totals = {}, dict[str, list[list[float]]]()
        for part in world.each(own):
            for name, (sums, counts) in part.items():
                before = totals.setdefault(name, [[], []])
                totals[name] = [before[0] + sums, before[1] + counts]
        return {name: sum(sums) / sum(counts) for name, (sums, counts) in totals.items() if sum(counts)}


def episode_sums(rows: Tensor, done: Tensor, carried: Tensor) -> Tensor:
    """The running sums of each episode, at each row.

    Args:
        rows: quantities to sum, [K, T, N].
        done: the episode ends with this row, [T, N] bool.
        carried: sums of the episodes that were under way before the first row, [K, N].

    Returns:
        [K, T, N]
    """
    sums = torch.cat([torch.zeros_like(carried)[:, None], carried[:, None] + rows.cumsum(1)], dim=1)  # [K, T + 1, N]
    next_row = torch.arange(1, len(done) + 1, device=done.device)[:, None]
    after_end = torch.where(done, next_row, 0).cummax(0).values
    first_row = torch.cat([torch.zeros_like(after_end[:1]), after_end[:-1]])  # of the episode at hand, or 0
    return sums[:, 1:] - sums.gather(1, first_row.expand(len(rows), -1, -1))


class Stagger:
    """The first episode of each of N environments is cut after a random number of steps, uniform up to the time limit.

    A cut counts as a truncation. Without a `limit`, in steps, there are no cuts, and every episode is whole. `first` is
    the number of the first of these in the run: all are drawn for, so that each is cut alike in any process.
    """

    def __init__(self, num_envs: int, limit: int | None, seed: int, first: int = 0) -> None:
        self._steps_left = np.full(num_envs, -1)
        if limit is not None:
            drawn = np.random.default_rng(seed).integers(1, limit, first + num_envs, endpoint=True)
            self._steps_left = drawn[first:]
        self.counts = self._steps_left < 0
        """[N] bool: the environment's present episode began at its beginning and is not to be cut"""

    def apply(self, terminated: np.ndarray, truncated: np.ndarray) -> np.ndarray:
        """After one more step in every environment: `truncated` [N], with the cuts that are due."""
        if self.counts.all():
            return truncated
        self._steps_left -= 1
        truncated = truncated | ((self._steps_left == 0) & ~terminated)
        self._steps_left[terminated | truncated] = -1
        self.counts = self._steps_left < 0
        return truncated
