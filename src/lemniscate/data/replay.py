"""Replay (Lin 1992; Mnih et al. 2015): a ring buffer of transitions, the steps that fill it, and their noise."""

import math
import time
from collections.abc import Callable
from typing import Literal

import torch
from torch import Generator, Tensor

from lemniscate.envs.symmetry import Mirror
from lemniscate.envs.vec_env import VecEnv
from lemniscate.maths import coloured, ornstein_uhlenbeck, uniform
from lemniscate.nn.policies import Policy
from lemniscate.spec import Spec
from lemniscate.types import Step, Transition

Kind = Literal["white", "ou", "coloured"]
Judge = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""from achieved and desired goals, [B, G] each, to the rewards [B], and whether an episode ends [B]"""


class ReplayBuffer:
    """The last `capacity` transitions of all parallel environments, preallocated on `device`."""

    def __init__(self, spec: Spec, capacity: int, device: torch.device) -> None:
        self.transitions = Transition(
            *(torch.zeros(capacity, *shape, dtype=kind, device=device) for shape, kind in _columns(spec))
        )
        self.capacity = capacity
        self.mirror: Mirror | None = None
        """the mirror image of transitions, where it is stored too"""
        self._written = 0
        """rows ever added"""

    def __len__(self) -> int:
        return min(self._written, self.capacity)

    def add(self, obs: Tensor, action: Tensor, step: Step) -> None:
        """Add the transitions of one step of N environments; rows whose action was ignored are left out."""
        rows = Transition(obs, action, step.reward, step.next_obs, step.terminated)
        rows = rows if step.valid.all() else rows[step.valid]
        self.extend(self.mirror.both(rows, 0) if self.mirror else rows)

    def extend(self, rows: Transition) -> None:
        """Add `rows` [B, …] in the place of the oldest."""
        start, count = self._written % self.capacity, len(rows.reward)
        room = min(count, self.capacity - start)
        for name, ring in vars(self.transitions).items():
            new = getattr(rows, name)
            ring[start : start + room] = new[:room]
            if count > room:
                ring[: count - room] = new[room:]
        self._written += count

    def on_restart(self, judge: Judge) -> None:
        """Nothing here, where rows need no episode: called when environments were restarted; `judge` is theirs."""

    def drop(self) -> None:
        """Nothing here: called where a curriculum changed the rules of the episodes under way."""

    def sample_indices(self, minibatches: int, size: int, generator: Generator) -> Tensor:
        """Rows of `transitions`, drawn uniformly with replacement: [minibatches, size] int64."""
        return torch.randint(len(self), (minibatches, size), generator=generator, device=generator.device)

    def newest(self, count: int) -> Tensor:
        """Rows of `transitions`, the `count` that were added last or as many as there are, oldest first: int64."""
        count = min(count, len(self))
        return torch.arange(self._written - count, self._written, device=self.transitions.reward.device) % self.capacity

    def state_dict(self) -> dict[str, Tensor]:
        """The rows that are filled, not copied, [B, …]; and the number ever written."""
        rows = {name: ring[: len(self)] for name, ring in vars(self.transitions).items()}
        return {**rows, "written": torch.tensor(self._written)}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore what `state_dict` returned."""
        for name, ring in vars(self.transitions).items():
            ring[: len(state[name])] = state[name]
        self._written = int(state["written"])


class ActionNoise:
    """Noise of variance 1 for N parallel environments and A coordinates, each a sequence of its own.

    A sequence is as long as an episode may be, and every episode begins a new one. (Where episodes have no time limit,
    a sequence may end first; then the next one follows.)

    Args:
        kind: white; Ornstein–Uhlenbeck; or coloured, of power f^(−β).
        shape: (N, A).
        length: steps of a sequence, L.
        device: of the sequences.
        time: steps in which an Ornstein–Uhlenbeck correlation falls to 1/e.
        exponent: β.
    """

    def __init__(
        self, kind: Kind, shape: tuple[int, int], length: int, device: torch.device, *, time: float, exponent: float
    ) -> None:
        self._kind, self._time, self._exponent = kind, time, exponent
        self._length = length + length % 2  # `coloured` is for even lengths
        self._sequences = torch.zeros(*shape, self._length, device=device)
        self._position = torch.full((shape[0],), self._length)
        self._rows = torch.arange(shape[0])

    def __call__(self, generator: Generator) -> Tensor:
        """The noise of the next step, [N, A]."""
        due = self._position == self._length
        if due.any():
            shape = (int(due.sum()), *self._sequences.shape[1:])
            new = torch.randn(shape, generator=generator, device=generator.device)
            if self._kind == "ou":
                new = ornstein_uhlenbeck(new, self._time)
            elif self._kind == "coloured":
                new = coloured(new, self._exponent)
            self._sequences[due] = new
            self._position[due] = 0
        noise = self._sequences[self._rows, :, self._position]
        self._position += 1
        return noise

    def on_episode_end(self, done: Tensor) -> None:
        """Begin new sequences in the environments `done` [N] bool, whose episodes ended."""
        self._position[done.cpu()] = self._length

    def on_restart(self) -> None:
        """Begin new sequences everywhere: the environments have been restarted."""
        self._position.fill_(self._length)

    def state_dict(self) -> dict[str, Tensor]:
        """The sequences, and the position in each."""
        return {"sequences": self._sequences, "position": self._position}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore what `state_dict` returned, unless episodes have another length now: a restart begins them anew."""
        if state["sequences"].shape == self._sequences.shape:
            self._sequences.copy_(state["sequences"])
            self._position.copy_(state["position"])


@torch.no_grad()
def interact(
    env: VecEnv,
    policy: Policy,
    replay: ReplayBuffer,
    action_noise: ActionNoise,
    generator: Generator,
    *,
    noise_std: float = 1.0,
    random: bool = False,
) -> Step:
    """One step of every parallel environment, [N, …], added to the replay buffer.

    The policy acts with `noise_std` times the noise [N, A] of the next step, whose standard deviation is 1: for a
    deterministic policy in units of half the action range; of a stochastic one `noise_std` is 1. With `random`, it acts
    uniformly in [-1, 1]^A instead.
    """
    began = time.perf_counter()
    obs, noise = env.obs, action_noise(generator)
    action = uniform(noise) if random else policy.act(obs, noise_std * noise)
    step = env.step(action)
    replay.add(obs, action, step)
    action_noise.on_episode_end(step.terminated | step.truncated | ~step.valid)
    policy.observe(obs, step.valid)
    env.collecting += time.perf_counter() - began
    return step


def bytes_per_transition(spec: Spec) -> int:
    """The size of one transition in memory."""
    return sum(math.prod(shape) * kind.itemsize for shape, kind in _columns(spec))


def _columns(spec: Spec) -> list[tuple[tuple[int, ...], torch.dtype]]:
    """The shape and the type of each column of a transition."""
    obs = (spec.observation_size + spec.privileged,), torch.uint8 if spec.image else torch.float32
    action, number = (spec.bounded_box().size,), torch.float32
    return [obs, (action, number), ((), number), obs, ((), torch.bool)]
