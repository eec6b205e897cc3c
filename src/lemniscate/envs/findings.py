"""Obstacles to learning that random play shows: in rewards, ends of episodes, sizes of numbers."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from textwrap import wrap

import torch
from torch import Tensor

from lemniscate.spec import Spec
from lemniscate.types import Rollout

GOOD, NOTE, BAD = "good", "note", "bad"
MARKS = {GOOD: "✓", NOTE: "!", BAD: "✗"}
WILD = 1e4
"""a ratio of sizes of observations from which on a network does not see the small ones"""
LARGE = 100
"""a reward from which on the errors of the value network are too large for its learning rate"""


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


def verdict(env_id: str, findings: Sequence[Finding]) -> str:
    """Whether an environment is suitable for training, in one sentence."""
    bad, notes = (sum(finding.grade == grade for finding in findings) for grade in (BAD, NOTE))
    if bad:
        return f"{env_id} is not suitable for training: {bad} finding{'s' * (bad > 1)} above, marked {MARKS[BAD]}."
    look = f"; look at the {notes} note{'s' * (notes > 1)} above, marked {MARKS[NOTE]}" if notes else ""
    return f"{env_id} is suitable for training{look}."


def learnable(rollouts: Sequence[Rollout], spec: Spec) -> Iterator[Finding]:
    """Notes on what random play has shown, each with what it means for learning and what to do."""
    rewards = torch.cat([rollout.reward[rollout.valid] for rollout in rollouts])
    lengths = torch.cat([episode_lengths(rollout) for rollout in rollouts])
    terminated = any(rollout.terminated.any() for rollout in rollouts)
    truncated = any(rollout.truncated.any() for rollout in rollouts)
    alike = len(lengths) > 2 and bool((lengths == lengths[0]).all())
    if spec.max_episode_steps is None and not truncated:
        yield Finding(
            NOTE,
            "It has no time limit: an episode that a policy does not end cannot be evaluated; register it with"
            " max_episode_steps, or add --wrappers 'gymnasium.wrappers:TimeLimit(max_episode_steps=1000)'.",
        )
    if alike and terminated and not truncated and lengths[0] > 1:
        yield Finding(
            NOTE,
            f"Each of {len(lengths)} episodes terminated after exactly {int(lengths[0])} steps: if that is a time"
            " limit, report it as truncated, or learning takes the value there to be 0.",
        )
    if (rewards == rewards[0]).all() and (rewards[0] == 0 or alike or not len(lengths)):
        yield Finding(
            NOTE,
            f"Every reward was {rewards[0]:g}, whatever was done: nothing is learned until random actions meet another;"
            " if rewards are meant to be rare, reward the way there too.",
        )
    if rewards.abs().max() > LARGE:
        yield Finding(
            NOTE,
            f"Rewards reach {rewards.abs().max():.3g}, which makes the first value errors too large; train with"
            " --scale-rewards (on-policy), or pay less.",
        )
    if not spec.image:
        yield from _sizes(torch.cat([rollout.obs[rollout.valid] for rollout in rollouts]), spec)


def episode_lengths(rollout: Rollout) -> Tensor:
    """The lengths of the whole episodes of a rollout, in steps that were not ignored."""
    lengths: list[Tensor] = []
    running = torch.zeros(rollout.reward.shape[1])
    for done, valid in zip(rollout.done, rollout.valid, strict=True):
        running = running + valid
        lengths.append(running[done & valid])
        running = running * ~(done & valid)
    return torch.cat(lengths)


def _sizes(obs: Tensor, spec: Spec) -> Iterator[Finding]:
    largest = obs[:, : spec.observation_size].abs().amax(dim=0)
    sizes = torch.where(largest > 0, largest, torch.nan)
    if sizes.isnan().all():
        return
    high, low = sizes.nan_to_num(0).argmax(), sizes.nan_to_num(torch.inf).argmin()
    if sizes[high] >= WILD * sizes[low]:
        names = [f"{part.name}[{i}]" for part in spec.observation_parts for i in range(part.size)]
        yield Finding(
            NOTE,
            f"Observations reach {sizes[high]:.1g} in {names[high]} and {sizes[low]:.1g} in {names[low]}: the network"
            " does not see the small ones; train with --normalize-observations, or bring them to about 1.",
        )
