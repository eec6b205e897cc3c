"""Replay (Lin 1992; Mnih et al. 2015): a ring buffer of transitions, and the steps that fill it."""

import math

import torch
from torch import Tensor

from lemniscate.data.action_noise import ActionNoise
from lemniscate.envs.vec_env import VecEnv
from lemniscate.maths import uniform
from lemniscate.nn.policies import Policy
from lemniscate.spec import Spec
from lemniscate.types import Step, Streams, Transition


class ReplayBuffer:
    """The last `capacity` transitions of all parallel environments, preallocated on `device`.

    Each shard has an equal part of the capacity, a ring of its own: rows [c·s, c·(s + 1)) of `transitions`.
    """

    local = ("obs", "action", "reward", "next_obs", "terminated", "written")

    def __init__(self, spec: Spec, capacity: int, device: torch.device, shards: int = 1) -> None:
        columns = {
            name: torch.zeros(capacity, *shape, dtype=kind, device=device) for name, shape, kind in _columns(spec)
        }
        self.transitions = Transition(**columns)
        self.capacity = capacity
        self._shards, self._written = shards, [0] * shards
        """rows ever added, of each shard"""

    def __len__(self) -> int:
        return sum(min(written, self._room) for written in self._written)

    @property
    def _room(self) -> int:
        """The rows of each shard's ring."""
        return self.capacity // len(self._written)

    def add(self, obs: Tensor, action: Tensor, step: Step) -> None:
        """Add the transitions of one step of N environments; rows whose action was ignored are left out."""
        rows, shards = Transition(obs, action, step.reward, step.next_obs, step.terminated), len(self._written)
        for shard in range(shards):
            mine = slice(shard * len(obs) // shards, (shard + 1) * len(obs) // shards)
            part, valid = (rows, step.valid) if shards == 1 else (rows[mine], step.valid[mine])
            self.extend(part if valid.all() else part[valid], shard)

    def extend(self, rows: Transition, shard: int = 0) -> None:
        """Add `rows` [B, …] to a shard's ring, in place of the oldest."""
        first, start, count = shard * self._room, self._written[shard] % self._room, len(rows.reward)
        room = min(count, self._room - start)
        for name, ring in vars(self.transitions).items():
            new = getattr(rows, name)
            ring[first + start : first + start + room] = new[:room]
            if count > room:
                ring[first : first + count - room] = new[room:]
        self._written[shard] += count

    def sample_indices(self, minibatches: int, size: int, streams: Streams) -> Tensor:
        """Rows of `transitions`, of each shard an equal part of `size`, drawn uniformly with replacement.

        Returns [minibatches, M] int64, M = `size` where all shards are held.
        """
        parts = []
        for shard, stream in enumerate(streams):
            filled = min(self._written[shard], self._room)
            drawn = torch.randint(filled, (minibatches, size // self._shards), generator=stream, device=stream.device)
            parts.append(shard * self._room + drawn)
        return torch.cat(parts, dim=1)

    def hold(self, held: range) -> None:
        """Keep only these shards."""
        rows = slice(held.start * self._room, held.stop * self._room)
        self.transitions = self.transitions[rows].map(torch.clone)
        self._written, self.capacity = self._written[held.start : held.stop], len(held) * self._room

    def state_dict(self) -> dict[str, Tensor]:
        """The rows up to the largest that is filled, not copied, [S, B, …]; and the number ever written of each [S]."""
        shards, filled = len(self._written), min(self._room, max(self._written))
        rows = {name: ring.unflatten(0, (shards, -1))[:, :filled] for name, ring in vars(self.transitions).items()}
        return {**rows, "written": torch.tensor(self._written)}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore what `state_dict` returned."""
        shards = len(self._written)
        for name, ring in vars(self.transitions).items():
            ring.unflatten(0, (shards, -1))[:, : state[name].shape[1]] = state[name]
        self._written = state["written"].tolist()


@torch.no_grad()
def interact(
    env: VecEnv,
    policy: Policy,
    replay: ReplayBuffer,
    action_noise: ActionNoise,
    streams: Streams,
    *,
    noise_std: float = 1.0,
    random: bool = False,
) -> Step:
    """One step of every parallel environment, [N, …], added to the replay buffer.

    Args:
        env: the environments.
        policy: acts with `noise_std` times the noise of the next step.
        replay: the buffer.
        action_noise: standard normal noise [N, A], correlated in time or not.
        streams: of the noise.
        noise_std: standard deviation of the noise of a deterministic policy, in units of half the action range; 1 for a
            stochastic policy, which takes standard normal numbers.
        random: act uniformly in [-1, 1]^A instead.
    """
    with env.collecting:
        obs, noise = env.obs, action_noise(streams)
        action = uniform(noise) if random else env.act(policy.act, noise_std * noise)
        step = env.step(action)
        replay.add(obs, action, step)
        action_noise.on_episode_end(step.terminated | step.truncated | ~step.valid)
        policy.observe(obs, step.valid)
    return step


def bytes_per_transition(spec: Spec) -> int:
    """The size of one transition in memory."""
    return sum(math.prod(shape) * kind.itemsize for _, shape, kind in _columns(spec))


def _columns(spec: Spec) -> list[tuple[str, tuple[int, ...], torch.dtype]]:
    obs = ((spec.observation_size + spec.privileged,), torch.uint8 if spec.image else torch.float32)
    return [
        ("obs", *obs),
        ("action", (spec.bounded_box().size,), torch.float32),
        ("reward", (), torch.float32),
        ("next_obs", *obs),
        ("terminated", (), torch.bool),
    ]
