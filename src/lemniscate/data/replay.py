"""Replay (Lin 1992; Mnih et al. 2015): a ring buffer of transitions, and the steps that fill it."""

import math

import torch
from torch import Generator, Tensor

from lemniscate.data.action_noise import ActionNoise
from lemniscate.envs.vec_env import VecEnv
from lemniscate.maths import uniform
from lemniscate.nn.policies import Policy
from lemniscate.spec import Spec
from lemniscate.types import Step, Transition


class ReplayBuffer:
    """The last `capacity` transitions of all parallel environments, preallocated on `device`."""

    def __init__(self, spec: Spec, capacity: int, device: torch.device) -> None:
        columns = {
            name: torch.zeros(capacity, *shape, dtype=kind, device=device) for name, shape, kind in _columns(spec)
        }
        self.transitions = Transition(**columns)
        self.capacity = capacity
        self._written = 0

    def __len__(self) -> int:
        return min(self._written, self.capacity)

    def add(self, obs: Tensor, action: Tensor, step: Step) -> None:
        """Add the transitions of one step of N environments; rows whose action was ignored are left out."""
        rows = Transition(obs, action, step.reward, step.next_obs, step.terminated)
        self.extend(rows if step.valid.all() else rows[step.valid])

    def extend(self, rows: Transition) -> None:
        """Add `rows` [B, …], in place of the oldest."""
        start, count = self._written % self.capacity, len(rows.reward)
        room = min(count, self.capacity - start)
        for name, ring in vars(self.transitions).items():
            new = getattr(rows, name)
            ring[start : start + room] = new[:room]
            if count > room:
                ring[: count - room] = new[room:]
        self._written += count

    def sample_indices(self, minibatches: int, size: int, generator: Generator) -> Tensor:
        """Rows of `transitions`, drawn uniformly with replacement: [minibatches, size] int64."""
        return torch.randint(len(self), (minibatches, size), generator=generator, device=generator.device)

    def state_dict(self) -> dict[str, Tensor]:
        """The filled rows, not copied, and the number of rows ever written."""
        filled = {name: ring[: len(self)] for name, ring in vars(self.transitions).items()}
        return {**filled, "written": torch.tensor(self._written)}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore what `state_dict` returned."""
        self._written = int(state["written"])
        for name, ring in vars(self.transitions).items():
            ring[: len(self)] = state[name]


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
) -> None:
    """One step of every parallel environment, added to the replay buffer.

    Args:
        env: the environments.
        policy: acts with `noise_std` times the noise of the next step.
        replay: the buffer.
        action_noise: standard normal noise [N, A], correlated in time or not.
        generator: of the noise.
        noise_std: standard deviation of the noise of a deterministic policy, in units of half the action range; 1 for a
            stochastic policy, which takes standard normal numbers.
        random: act uniformly in [-1, 1]^A instead.
    """
    with env.collecting:
        obs, noise = env.obs, action_noise(generator)
        action = uniform(noise) if random else policy.act(obs, noise_std * noise)
        step = env.step(action)
        replay.add(obs, action, step)
        action_noise.on_episode_end(step.terminated | step.truncated | ~step.valid)
        policy.observe(obs[step.valid])


def bytes_per_transition(spec: Spec) -> int:
    """The size of one transition in memory."""
    return sum(math.prod(shape) * kind.itemsize for _, shape, kind in _columns(spec))


def _columns(spec: Spec) -> list[tuple[str, tuple[int, ...], torch.dtype]]:
    obs = ((spec.observation_size,), torch.uint8 if spec.image else torch.float32)
    return [
        ("obs", *obs),
        ("action", (spec.bounded_box().size,), torch.float32),
        ("reward", (), torch.float32),
        ("next_obs", *obs),
        ("terminated", (), torch.bool),
    ]
