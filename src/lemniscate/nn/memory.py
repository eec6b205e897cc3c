"""Memory: what a network carries from one step to the next travels beside the observation, as further columns.

So a policy with a memory is one without on a longer observation, [o, m]: whoever bootstraps from the true next row has
the memory of its episode there, and everything that is shared, saved or cut by rows takes the memory along. The columns
are [O | policy's | P | critic's | mask], O the observation, P what is privileged; in front of each memory stands 1, or
0 where a row's memory does not follow from the row before.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from lemniscate.nn.networks import GRU, OwnCell
from lemniscate.spec import Spec
from lemniscate.types import Step

if TYPE_CHECKING:
    from lemniscate.nn.policies import Policy


@dataclass(frozen=True)
class Memory:
    """The columns that a policy and a critic remember, each with its 1 or 0 in front; 0 columns where one has none.

    `length` is L, the steps of a piece: in learning, gradients go back through a memory to the beginning of its piece.
    """

    observation: int
    policy: int
    privileged: int
    critic: int
    length: int

    def join(self, obs: Tensor, kept: Tensor) -> Tensor:
        """Observations [N, O + P + mask] with what is remembered [N, policy + critic] at its place."""
        end = self.observation + self.privileged
        own, critics = kept.split([self.policy, self.critic], dim=-1)
        parts = obs[:, : self.observation], own, obs[:, self.observation : end], critics, obs[:, end:]
        return torch.cat([part.to(kept) for part in parts], dim=-1)


class Carrier:
    """Carries what is remembered of N environments from step to step; nothing at the beginning of an episode.

    Args:
        memory: the columns.
        remember: rows with their memory, [N, …], to the memory after them, [N, policy + critic].
    """

    def __init__(self, memory: Memory, remember: Callable[[Tensor], Tensor]) -> None:
        self._memory, self._remember, self._steps = memory, remember, 0
        self._marks = [0] * (memory.policy > 0) + [memory.policy] * (memory.critic > 0)
        """the columns of the 1 or 0 among those that are remembered"""

    def begin(self, obs: Tensor) -> Tensor:
        """The first rows of all episodes, from their observations [N, …]."""
        self._steps = 0
        nothing = torch.zeros(len(obs), self._memory.policy + self._memory.critic, device=obs.device)
        return self._memory.join(obs, nothing)

    def follow(self, rows: Tensor, step: Step) -> Step:
        """The step from `rows`, with the memory in `obs` and `next_obs`."""
        self._steps += 1
        kept = self._remember(rows)
        ended = step.terminated | step.truncated | ~step.valid
        going_on = kept.masked_fill(ended[:, None], 0)
        if self._steps % self._memory.length == 0:  # the next row begins a piece
            going_on[:, self._marks] = 0
        return replace(step, obs=self._memory.join(step.obs, going_on), next_obs=self._memory.join(step.next_obs, kept))


class Columns(nn.Module):
    """The inputs of a network that remembers nothing, from rows of one that does.

    `sizes` are the columns that are encoded, and those behind them that are left out; all others are as they are.
    """

    def __init__(self, encoder: nn.Module, sizes: tuple[int, int]) -> None:
        super().__init__()
        self.encoder, self.sizes = encoder, sizes

    def forward(self, x: Tensor) -> Tensor:
        """[…, the columns] to […, features and the others]."""
        obs, _, others = _split(x, self.sizes)
        return torch.cat([self.encoder(obs), others], dim=-1)


class Remembering(nn.Module):
    """A network with a memory, of rows […, I]: columns as above, and actions behind them.

    In [B, I] each row has the memory to start from in it. In [B, L, I] the rows are pieces of L steps that follow each
    other: the memory of the first is in it, and so is that of a row with a 0 in front; all others have what the network
    remembers of the rows before, through which gradients go.

    Args:
        encoder: of the observation.
        cell: with a memory of `size` numbers, and `outputs`.
        head: from the cell's outputs and actions to the network's.
        columns: the numbers of those that are encoded, left out (the policy's memory, in a critic), and privileged.
    """

    def __init__(self, encoder: nn.Module, cell: GRU | OwnCell, head: nn.Module, columns: tuple[int, int, int]) -> None:
        super().__init__()
        self.encoder, self.cell, self.head = encoder, cell, head
        self.columns = *columns, 1, cell.size

    def forward(self, x: Tensor) -> Tensor:
        """[B, I] or [B, L, I] to [B, outputs] or [B, L, outputs]."""
        prepared, goes_on, memory, action = self._parts(x)
        if x.dim() < 3:
            out, _ = self.cell.step(prepared, memory)
            return self.head(torch.cat([out, action], dim=-1))
        rows, after = [], memory[:, 0]
        for t in range(x.shape[1]):
            before = torch.where(goes_on[:, t] == 1, after, memory[:, t]) if t else after
            row, after = self.cell.step(prepared[:, t], before)
            rows.append(row)
        return self.head(torch.cat([torch.stack(rows, dim=1), action], dim=-1))

    def remember(self, x: Tensor) -> Tensor:
        """The memory after rows [B, I], with a 1 in front: [B, 1 + size]."""
        prepared, _, memory, _ = self._parts(x)
        _, after = self.cell.step(prepared, memory)
        return torch.cat([torch.ones_like(after[:, :1]), after], dim=-1)

    def _parts(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Of […, I]: the cell's prepared inputs, the 1 or 0, the memory, the actions."""
        obs, _, privileged, goes_on, memory, action = _split(x, self.columns)
        inputs = torch.cat([self.encoder(obs), privileged], dim=-1)
        return self.cell.prepare(inputs), goes_on, memory, action


def _split(x: Tensor, sizes: tuple[int, ...]) -> tuple[Tensor, ...]:
    """Columns of these sizes, and the rest."""
    return x.split([*sizes, x.shape[-1] - sum(sizes)], dim=-1)


def remembered_by(net: nn.Module) -> int:
    """The columns that a network remembers."""
    return 1 + net.cell.size if isinstance(net, Remembering) else 0


def remember(net: nn.Module, inputs: Tensor) -> Tensor:
    """The memory of a network after rows [N, I], [N, columns]; no columns where it has none."""
    return net.remember(inputs) if isinstance(net, Remembering) else inputs[:, :0]


def give_memory(policy: "Policy", critic: nn.Module, spec: Spec, length: int) -> Memory | None:
    """The columns of a policy's and a critic's network, which the policy gets for its own; None where they have none."""
    if size := remembered_by(policy.net):
        policy.memory = Memory(spec.observation_size, size, spec.privileged, 0, length)
        return replace(policy.memory, critic=remembered_by(critic))
    return None
