"""Hindsight experience replay: Andrychowicz et al. 2017, arXiv:1707.01495.

Episodes are stored again with goals that were reached in them, in place of the one that was desired.
"""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from lemniscate.data.replay import Judge, ReplayBuffer
from lemniscate.errors import UserError
from lemniscate.spec import Spec
from lemniscate.system.console import say
from lemniscate.types import Step, Transition

LONGEST = 1_000
"""steps after which an episode without a time limit is stored as if it ended there; sooner in a smaller buffer"""


class HindsightReplay(ReplayBuffer):
    """A replay buffer of whole episodes, with copies whose goals were achieved later in the same episode.

    Algorithm 1 with the strategy "future" (section 4.5). An episode is stored when it ends; one that a checkpoint cuts
    is dropped. The rewards and ends of the copies are the environment's own answers; an episode that was terminated,
    by its goal or by a fall, ends with its last step in any case. Goals that were achieved when the episode began are
    left out, as of a block that nobody has touched: they are most of the first ones, and teach to do nothing.

    Args:
        spec: of an environment whose observation is a Dict with `achieved_goal` and `desired_goal`; else a `UserError`.
        capacity: rows, copies included.
        device: of the rows.
        num_envs: N.
        goals: copies of each transition, k.
        seed: of the choice of goals.
    """

    def __init__(
        self, spec: Spec, capacity: int, device: torch.device, *, num_envs: int, goals: int, seed: int
    ) -> None:
        self._achieved, self._desired = goal_columns(spec)
        self._longest = max(1, min(spec.max_episode_steps or LONGEST, capacity // (1 + goals)))
        super().__init__(spec, capacity, device)
        self._env_id, self._goals, self._seed = spec.env_id, goals, seed
        self._episodes = [list[Transition]() for _ in range(num_envs)]
        """those under way"""
        self._judge: Judge | None = None

    def on_restart(self, judge: Judge) -> None:
        """Drop the episodes under way: the environments have been restarted, and `judge` is theirs."""
        self._judge = judge
        if not len(self) and (steps := max(map(len, self._episodes))):
            say(
                f"No episode of {self._env_id} has ended in {steps:,} steps, up to a checkpoint, which cuts them, and"
                " hindsight stores whole ones: before one has, nothing is learned. Raise checkpoint_every above that."
            )
        self.drop()

    def drop(self) -> None:
        """Drop the episodes under way."""
        for episode in self._episodes:
            episode.clear()

    def add(self, obs: Tensor, action: Tensor, step: Step) -> None:
        """Keep one step of N environments, and store the episodes that end with it."""
        rows = Transition(obs, action, step.reward, step.next_obs, step.terminated)
        last = step.terminated | step.truncated
        for i in step.valid.nonzero()[:, 0]:
            episode = self._episodes[i]
            episode.append(rows[i])
            if last[i] or len(episode) == self._longest:
                whole = Transition.stack(episode)
                self.extend(whole)
                self.extend(self._copies(whole))
                episode.clear()

    def _copies(self, episode: Transition) -> Transition:
        """Each transition t k times at most, with goals achieved after steps drawn uniformly from t, …, T − 1."""
        assert self._judge is not None
        length = len(episode.reward)
        self._compare(episode)
        times = np.repeat(np.arange(length), self._goals)
        later = np.random.default_rng((self._seed, self._written)).integers(times, length)
        goals, start = episode.next_obs[:, self._achieved], episode.obs[:1, self._achieved]
        new = (self._judge(start.expand_as(goals), goals)[0] != self._judge(goals, goals)[0]).cpu()
        times, later = (torch.from_numpy(x)[new[later]].to(goals.device) for x in (times, later))
        copies, goal = episode[times], goals[later]
        reward, ends = self._judge(copies.next_obs[:, self._achieved], goal)
        for obs in (copies.obs, copies.next_obs):
            obs[:, self._desired] = goal
        return replace(copies, reward=reward, terminated=ends | copies.terminated)  # the last step has no later goal

    def _compare(self, episode: Transition) -> None:
        """Raise `UserError` where the judge does not give the rewards that an episode had, or ends it before.

        Goals are float32 here, and may have been float64 there: at the edge of a threshold the judge is asked on both
        sides of it.
        """
        assert self._judge is not None
        achieved, desired = (episode.next_obs[:, columns] for columns in (self._achieved, self._desired))
        judged, ends = self._judge(achieved, desired)
        right = torch.isclose(episode.reward, judged, rtol=1e-4, atol=1e-5)
        early = ends & ~episode.terminated
        rounding = (achieved - desired).sign() * torch.maximum(achieved.abs(), desired.abs()) * 2**-21
        for edge in (rounding, -rounding) if early.any() or not right.all() else ():
            at_edge, ends = self._judge(achieved + edge, desired)
            right, early = right | torch.isclose(episode.reward, at_edge, rtol=1e-4, atol=1e-5), early & ends
        if early.any():
            step = int(early.int().argmax())
            raise UserError(
                f"In step {step:,} of an episode {self._env_id} goes on, and its compute_terminated says that it ends:"
                " both must say the same. --replay uniform does not ask it."
            )
        if not right.all():
            step = int(right.int().argmin())
            raise UserError(
                f"In step {step:,} of an episode the reward of {self._env_id} is {episode.reward[step]:g}, and its"
                f" compute_reward says {judged[step] + 0.0:g}: hindsight needs rewards that follow from achieved_goal"
                " and desired_goal alone, without wrappers that change them. --replay uniform learns from any."
            )


def goal_columns(spec: Spec) -> tuple[slice, slice]:
    """The columns of the achieved and of the desired goal in the flat observation.

    Raises `UserError` where there are none, or where they are not numbers of one shape.
    """
    columns, begin = {}, 0
    for part in spec.observation_parts:
        columns[part.path], begin = (part, slice(begin, begin + part.size)), begin + part.size
    found = [columns.get((name,)) for name in ("achieved_goal", "desired_goal")]
    if not (found[0] and found[1]) or found[0][0].shape != found[1][0].shape or found[0][0].nvec or found[1][0].nvec:
        raise UserError(
            f"replay is hindsight, which needs goals, and {spec.env_id} has none: its observation must be a Dict with"
            " Boxes achieved_goal and desired_goal of one shape, beside compute_reward. --replay uniform needs none."
        )
    return found[0][1], found[1][1]
