"""Training states: what a checkpoint holds, and what a run asks of it."""

from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import dataclass, field, fields
from socket import gethostname
from typing import Any, Generic, TypeVar
from zlib import crc32

import torch
from torch import Tensor
from torch.nn.utils import parameters_to_vector

from lemniscate.envs.vec_env import VecEnv
from lemniscate.errors import RankError
from lemniscate.nn.normalizer import RewardScale
from lemniscate.nn.policies import Policy
from lemniscate.optim.adam import Adam
from lemniscate.optim.compiled import Compiled, Compiler, Learner
from lemniscate.optim.shards import GradientOverShards, estimates_over_shards
from lemniscate.run.config import RunConfig
from lemniscate.run.seeding import Generators
from lemniscate.system.world import World

Networks = TypeVar("Networks", bound=Any)
C = TypeVar("C", bound=RunConfig)


class PolicyMean:
    """The mean of a policy's parameters over the last updates of a run: Polyak & Juditsky 1992, doi:10.1137/0330046.

    Single updates of a constant step size jump about a good policy; their mean lies nearer to it than most of them.
    """

    def __init__(self) -> None:
        self._count, self._mean = 0, torch.zeros(0)

    def add(self, policy: Policy) -> None:
        """Take the parameters as they are into the mean."""
        now = parameters_to_vector(policy.parameters()).detach()
        self._count += 1
        self._mean = now if self._count == 1 else self._mean.to(now.device).lerp(now, 1 / self._count)

    def move_to(self, policy: Policy) -> None:
        """Give the mean to the policy, and begin again."""
        sizes = [parameter.numel() for parameter in policy.parameters()]
        for parameter, values in zip(policy.parameters(), self._mean.split(sizes), strict=True):
            parameter.data.copy_(values.view_as(parameter))  # in place: an optimizer has it as a view
        self.load_state_dict({})

    def state_dict(self) -> dict[str, Tensor]:
        """The mean [P], and over how many updates it is; nothing where it has not begun."""
        return {"mean": self._mean, "count": torch.tensor(self._count)} if self._count else {}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restore what `state_dict` returned."""
        self._count, self._mean = int(state.get("count", 0)), state.get("mean", torch.zeros(0))


@dataclass(kw_only=True)
class TrainState(Generic[Networks]):
    """Training state; saved whole in every checkpoint, and the same in every process of a run.

    An algorithm adds its optimizers and counters. A field is a number, or has `state_dict` and `load_state_dict`;
    `learn` is the only one that is not saved.
    """

    networks: Networks
    """with a `policy`; what is loaded to evaluate it"""
    rng: Generators
    learn: Callable[..., Any] = field(metadata={"saved": False})
    """the algorithm's gradient steps; in a compiled run, their compiled form"""
    step: int = 0
    """environment steps taken"""
    mean: PolicyMean = field(default_factory=PolicyMean)
    """of the policy, where the run is to end with it (`average_last`)"""

    @property
    def policy(self) -> Policy:
        """The policy that acts and is evaluated."""
        return self.networks.policy

    def saved(self) -> dict[str, Any]:
        """The fields that a checkpoint holds, by name."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.metadata.get("saved", True)}

    def optimizers(self) -> list[Adam]:
        """All optimizers of the state."""
        return [value for value in vars(self).values() if isinstance(value, Adam)]

    def apply_schedules(self, config: C) -> C:
        """A copy of `config` that has the present value in the place of each schedule.

        It is a tensor, since a compiled gradient step takes a number of a Config for a constant.
        """
        now, progress = copy(config), self.step / config.total_steps
        device = next(self.networks.parameters()).device
        for name, schedule in config.schedules.items():
            object.__setattr__(now, name, torch.tensor(schedule.at(progress), device=device))
        return now

    def on_restart(self, env: VecEnv) -> None:
        """Forget the running episodes: the environments have been restarted."""

    def on_change(self) -> None:
        """Drop what a change of the environments, by a curriculum, makes wrong."""

    def on_warm_start(self) -> None:
        """Follow `networks`, whose parameters have been loaded from another run."""

    def per_step_methods(self) -> list[tuple[object, str]]:
        """(owner, name) of the methods that are called all the time, always with the same shapes."""
        return [(self.policy, "act")]

    def prepare(self, world: World, compiler: Compiler | None) -> None:
        """Compile what is called all the time, if there is a compiler, and share it with the processes of the world.

        With one shard the gradient steps are compiled several at a time. With more, each shard's gradient is a program
        of its own: programs that a compiler may merge would not give the same bits on another number of processes.
        """
        device = next(self.networks.parameters()).device
        if compiler:
            for owner, name in self.per_step_methods():
                vars(owner)[name] = Compiled(getattr(owner, name), device, compiler)  # over the method of the class
        if world.shards > 1:
            for optimizer in self.optimizers():
                optimizer.over_shards = GradientOverShards(optimizer, world, compiler)
            if hasattr(self.networks, "estimates"):
                self.networks.estimates = estimates_over_shards(self.networks.estimates, world)
        elif compiler:
            self.learn = Learner(self.learn, self.optimizers(), compiler)

    def release(self) -> None:
        """Take back what `prepare` put over methods, which is for the shapes and the processes of training alone."""
        for owner, name in [*self.per_step_methods(), (self.networks, "estimates")]:
            vars(owner).pop(name, None)


@dataclass(kw_only=True)
class ScaledState(TrainState[Networks]):
    """A training state with the scale of the rewards."""

    reward_scale: RewardScale

    def on_restart(self, env: VecEnv) -> None:
        """Forget the running returns."""
        super().on_restart(env)
        self.reward_scale.on_restart()


def require_agreement(world: World, state: TrainState) -> None:
    """Raise `RankError` where the networks of a process are not those of the first."""
    said = world.each((fingerprint(state), gethostname()))
    for rank, (theirs, host) in enumerate(said):
        if theirs != said[0][0]:
            sentence = f"The networks of rank {rank} on {host} differ from those of rank 0 on {said[0][1]}"
            raise RankError(f"{sentence} after the update that ends at step {state.step:,}." if world.is_first else "")


def fingerprint(state: TrainState) -> int:
    """A checksum of the networks, the same in every process of a run."""
    checksum = 0
    for values in state.networks.state_dict().values():
        checksum = crc32(values.detach().cpu().contiguous().view(-1).view(torch.uint8).numpy(), checksum)
    return checksum
