"""Memory: what a network carries from one step to the next travels beside the observation, as further columns.

So a policy with a memory is one without on a longer observation, [o, m]: whoever bootstraps from the true next row has
the memory of its episode there, and everything that is shared, saved or cut by rows takes the memory along. The columns
are [O | policy's | P | critic's | mask], O the observation, P what is privileged; in front of each memory stands 1, or
0 where a row's memory does not follow from the row before.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from lemniscate.errors import UserError
from lemniscate.maths import tanh
from lemniscate.nn.networks import NETWORKS, Layers, OwnNetwork, orthogonal
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


class Recall:
    """The memory of the episodes that someone plays call by call: of one, or of a batch of B.

    Args:
        memory: the columns.
        remember: as that of `Carrier`.
    """

    def __init__(self, memory: Memory, remember: Callable[[Tensor], Tensor]) -> None:
        self._memory, self._remember = memory, remember
        self._kept: Tensor | None = None

    def rows(self, obs: Tensor) -> Tensor:
        """Observations [B, …] with their memory. Raises `UserError` for another B than before, without `reset`."""
        nothing = obs.new_zeros(len(obs), self._memory.policy + self._memory.critic)
        kept = nothing if self._kept is None else self._kept  # asking alone begins no episode
        if len(obs) != len(kept):
            raise UserError(
                f"This policy remembers {len(kept)} episodes, and is given {len(obs)} observations: policy.reset()"
                " forgets them, for new ones."
            )
        return self._memory.join(obs, kept)

    def advance(self, rows: Tensor) -> None:
        """Remember these rows too."""
        self._kept = self._remember(rows)

    def reset(self, done: Tensor | None = None) -> None:
        """Forget the episodes that are over, `done` [B]; without it all of them."""
        if done is None:
            self._kept = None
        elif self._kept is not None:
            done = done.reshape(1) if done.dim() == 0 else done
            if done.shape != self._kept.shape[:1]:
                raise UserError(f"done has the shape {tuple(done.shape)}, of {len(self._kept)} episodes.")
            self._kept = self._kept.masked_fill(done[:, None], 0)


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


class OwnCell(OwnNetwork):
    """A module of one's own with a memory of `size` numbers: [B, inputs], [B, size] to [B, outputs], [B, size]."""

    def __init__(self, name: str, inputs: int, outputs: int) -> None:
        super().__init__(name, inputs, outputs)
        self.outputs, self.size = outputs, int(self.module.memory_size)

    def prepare(self, x: Tensor) -> Tensor:
        """The inputs as they are."""
        return x

    def step(self, prepared: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """[B, inputs] and [B, size] to the outputs [B, outputs], and the next memory."""
        return self.module(prepared.clone() if self.writes else prepared, memory.clone())  # it may write into it

    def over(self, prepared: Tensor, goes_on: Tensor, memory: Tensor) -> Tensor:
        """The outputs [P, L, outputs] of pieces, [P, L, inputs], [P, L, 1] and [P, L, size]; see `side_by_side`."""
        rows, after = [], memory[:, 0]
        for t in range(prepared.shape[1]):
            row, after = self.step(prepared[:, t], torch.where(goes_on[:, t], after, memory[:, t]) if t else after)
            rows.append(row)
        return torch.stack(rows, dim=1)

    def _expected_shapes(self, inputs: int, outputs: int) -> str:
        return f"[B, {inputs}] and memory_size numbers, [B, K], to [B, {outputs}] and the next [B, K]"

    def _call(self, rows: Tensor) -> Tensor:
        memory = rows.new_zeros(len(rows), self.module.memory_size)
        out, after = self.step(rows, memory)
        if (after.shape, after.dtype) != (memory.shape, memory.dtype):
            raise ValueError(f"the next memory is {list(after.shape)} of {after.dtype}")
        out, _ = self.step(rows, after)  # on from there, so that what the memory is for takes part
        return out


class GRU(nn.Module):
    """Gated recurrent units behind the layers before them: Cho et al. 2014, arXiv:1406.1078, eq. 5 to 8.

    As in torch, the reset gate acts on the product, r ⊙ (W h + b), and z is what the memory keeps of itself.
    """

    def __init__(self, layers: nn.Module, inputs: int, size: int) -> None:
        super().__init__()
        self.size = self.outputs = size
        self.layers = layers
        self.input, self.state = nn.Linear(inputs, 3 * size), nn.Linear(size, 3 * size)
        for layer in (self.input, self.state):
            for block in layer.weight.data.split(size):
                nn.init.orthogonal_(block)
            nn.init.zeros_(layer.bias)

    def prepare(self, x: Tensor) -> Tensor:
        """The products that do not depend on the memory, […, inputs] to […, 3 size]."""
        return self.input(self.layers(x))

    def step(self, prepared: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """[B, 3 size] and h [B, size] to the output, which is h', and h'."""
        sizes = [2 * self.size, self.size]
        (gates_x, new_x), (gates_h, new_h) = prepared.split(sizes, dim=-1), self.state(memory).split(sizes, dim=-1)
        reset, keep = torch.sigmoid(gates_x + gates_h).chunk(2, dim=-1)
        after = torch.lerp(tanh(torch.addcmul(new_x, reset, new_h)), memory, keep)
        return after, after

    def over(self, prepared: Tensor, goes_on: Tensor, memory: Tensor) -> Tensor:
        """The outputs [P, L, size] of pieces, [P, L, 3 size], [P, L, 1] and [P, L, size]; see `side_by_side`."""
        return _through_pieces([self], [prepared], goes_on, [memory])[0]


def _through_pieces(cells: Sequence[GRU], prepared: Any, goes_on: Tensor, memory: Any) -> Sequence[Tensor]:
    """`GRU.over` of C cells of one size, each with its own products and memory, in one loop over the steps."""
    by_time = torch.stack([*prepared]).transpose(1, 2), goes_on.transpose(0, 1), torch.stack([*memory]).transpose(1, 2)
    parameters = [torch.stack([getattr(cell.state, name) for cell in cells]) for name in ("weight", "bias")]
    kind = _Pieces if torch.compiler.is_compiling() else _PiecesForward
    return kind.apply(*by_time, *parameters)[0].transpose(1, 2).unbind()


class _Pieces(torch.autograd.Function):
    """`_through_pieces`, with its own derivatives: each step has a few operations that depend on the step beside it.

    What does not, the gates and what they change with, is computed of all steps at once; in derivatives of the
    derivative from the inputs and outputs alone, so that these are exact too. The memory in the rows is constant.
    Tensors are [C, L, P, …].
    """

    @staticmethod
    def forward(
        prepared: Tensor, goes_on: Tensor, memory: Tensor, weight: Tensor, bias: Tensor
    ) -> tuple[Tensor, Tensor]:
        size, h, outs, states, transposed = weight.shape[-1], memory[:, 0], [], [], weight.mT
        candidates, sums = prepared[..., 2 * size :], _sums(prepared, bias)
        compiling = torch.compiler.is_compiling()  # a program does not ask for the numbers in a tensor
        begins = [True] * len(goes_on) if compiling else (~goes_on).flatten(1).any(1).tolist()
        for t, (candidate, part) in enumerate(zip(candidates.unbind(1), sums.unbind(1), strict=True)):
            h = torch.where(goes_on[t], h, memory[:, t]) if t and begins[t] else h
            states.append(torch.baddbmm(part, h, transposed))
            gates, new_h = states[-1].split([2 * size, size], dim=-1)
            reset, keep = torch.sigmoid(gates).chunk(2, dim=-1)
            h = torch.lerp(torch.tanh(torch.addcmul(candidate, reset, new_h)), h, keep)
            outs.append(h)
        return torch.stack(outs, dim=1), torch.stack(states, dim=1)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: tuple[Tensor, Tensor]) -> None:
        ctx.mark_non_differentiable(output[1])
        ctx.save_for_backward(*inputs, *output)
        ctx.save_for_forward(*inputs, *output)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        weight, goes_on, before, keep, by_new, by_state = _changes(*ctx.saved_tensors)
        by_out, changes = gradients[0].unbind(1), by_state.unbind(1)
        going_on, keep = goes_on.to(keep).unbind(), keep.unbind(1)
        total, totals, states = by_out[-1], [], []
        for t in reversed(range(len(by_out))):
            state = (changes[t] * total[:, :, None]).flatten(2)
            totals.append(total)
            states.append(state)
            if t:
                total = torch.addcmul(by_out[t - 1], going_on[t], torch.addcmul(state @ weight, keep[t], total))
        state = torch.stack(states[::-1], dim=1)
        gates = state[..., : -weight.shape[-1]]
        by_prepared = torch.cat([gates, by_new * torch.stack(totals[::-1], dim=1)], dim=-1)
        by_weight = state.flatten(1, 2).mT @ before.flatten(1, 2)
        return by_prepared, None, None, by_weight, state.sum((1, 2))


class _PiecesForward(_Pieces):
    """With derivatives in forward mode, which a compiled function cannot have."""

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Any:
        weight, goes_on, before, keep, by_new, by_state = _changes(*ctx.saved_tensors)
        prepared, _, _, weight_tangent, bias_tangent = tangents
        *gates, new = prepared.unflatten(-1, (3, -1)).unbind(3)
        state = (before @ weight_tangent.mT[:, None] + bias_tangent[:, None, None]).unflatten(-1, (3, -1))
        own = (by_state * state).sum(3) + (by_state[..., :2, :] * torch.stack(gates, dim=3)).sum(3) + by_new * new
        tangent, outs = own[:, 0], [own[:, 0]]
        for t in range(1, own.shape[1]):
            h = goes_on[t] * tangent
            change = (by_state[:, t] * (h @ weight.mT).unflatten(-1, (3, -1))).sum(2)
            tangent = own[:, t] + keep[:, t] * h + change
            outs.append(tangent)
        return torch.stack(outs, dim=1), None


def _sums(prepared: Tensor, bias: Tensor) -> Tensor:
    """What the product with h is added to, [C, L, P, 3 size]: both gates' inputs, and nothing of the candidate's."""
    size, bias = bias.shape[-1] // 3, bias[:, None, None]
    new = bias[..., 2 * size :].expand_as(prepared[..., 2 * size :])
    return torch.cat([prepared[..., : 2 * size] + bias[..., : 2 * size], new], dim=-1)


def _changes(
    prepared: Tensor, goes_on: Tensor, memory: Tensor, weight: Tensor, bias: Tensor, out: Tensor, state: Tensor
) -> Any:
    """W, the 1 or 0, h, z, and ∂h'/∂ of the candidate [C, L, P, size] and of each third of the product, with a 3."""
    before = torch.cat([memory[:, :1], torch.where(goes_on[1:], out[:, :-1], memory[:, 1:])], dim=1)
    if torch.is_grad_enabled():  # for derivatives of this derivative
        state = _sums(prepared, bias) + before @ weight.mT[:, None]
    size = weight.shape[-1]
    new_h, (reset, keep) = state[..., 2 * size :], torch.sigmoid(state[..., : 2 * size]).chunk(2, dim=-1)
    new = tanh(torch.addcmul(prepared[..., 2 * size :], reset, new_h))
    by_new = (1 - keep) * (1 - new * new)
    by_reset, by_keep = by_new * new_h * reset * (1 - reset), (before - new) * keep * (1 - keep)
    return weight, goes_on, before, keep, by_new, torch.stack([by_reset, by_keep, by_new * reset], dim=3)


def cell_of(layers: Layers, inputs: int, outputs: int) -> GRU | OwnCell:
    """The part of a network that remembers, for layers that do; only one's own needs the number of its outputs."""
    if layers.kind != "gru":
        return OwnCell(layers.kind, inputs, outputs)
    before, width = NETWORKS["mlp"](replace(layers, hidden=layers.hidden[:-1]), inputs)
    return GRU(nn.Sequential(*before), width, layers.hidden[-1])


def head_of(layers: Layers, cell: GRU | OwnCell, actions: int, outputs: int, last_gain: float) -> nn.Module:
    """From the outputs of a cell, and actions, to those of the network."""
    if actions:
        own = replace(layers, kind="layer_norm", hidden=layers.hidden[-1:])
        return own.network(cell.outputs + actions, outputs, last_gain)
    return nn.Identity() if isinstance(cell, OwnCell) else orthogonal(nn.Linear(cell.outputs, outputs), last_gain)


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
        prepared, goes_on, memory, action = self.parts(x)
        in_pieces = x.dim() > 2
        out = self.cell.over(prepared, goes_on == 1, memory) if in_pieces else self.cell.step(prepared, memory)[0]
        return self.head(torch.cat([out, action], dim=-1))

    def remember(self, x: Tensor) -> Tensor:
        """The memory after rows [B, I], with a 1 in front: [B, 1 + size]."""
        prepared, _, memory, _ = self.parts(x)
        _, after = self.cell.step(prepared, memory)
        return torch.cat([torch.ones_like(after[:, :1]), after], dim=-1)

    def parts(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The cell's prepared inputs, the 1 or 0, the memory and the actions of rows […, I]."""
        obs, _, privileged, goes_on, memory, action = _split(x, self.columns)
        inputs = torch.cat([self.encoder(obs), privileged], dim=-1)
        return self.cell.prepare(inputs), goes_on, memory, action


def side_by_side(nets: Sequence[Any], inputs: Sequence[Tensor]) -> list[Tensor]:
    """The outputs of networks at pieces [P, L, I] of their own, as of `Remembering`.

    The memories of GRUs of one size go through them in one loop: its operations are small, and cost by their number.
    """
    cells: list[Any] = [getattr(net, "cell", None) for net in nets]
    if not all(isinstance(cell, GRU) and cell.size == cells[0].size for cell in cells):
        return [net(x) for net, x in zip(nets, inputs, strict=True)]
    prepared, goes_on, memory, _ = zip(*(net.parts(x) for net, x in zip(nets, inputs, strict=True)), strict=True)
    outs = _through_pieces(cells, prepared, goes_on[0] == 1, memory)
    return [net.head(out) for net, out in zip(nets, outs, strict=True)]


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
    """The columns of a policy's and a critic's network, None where they have none; the policy gets its own."""
    if size := remembered_by(policy.net):
        policy.memory = Memory(spec.observation_size, size, spec.privileged, 0, length)
        return replace(policy.memory, critic=remembered_by(critic))
    return None
