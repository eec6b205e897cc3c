"""Training states: what a checkpoint holds, and what a run asks of it."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import Any, Generic, TypeVar

from lemniscate.errors import NonFiniteError
from lemniscate.maths import ONE_SHARD, Shards
from lemniscate.nn.normalizer import RewardScale
from lemniscate.nn.policies import Policy
from lemniscate.optim.adam import Adam
from lemniscate.optim.compiled import Compiled
from lemniscate.optim.learner import Learner
from lemniscate.optim.shards import GradientOverShards
from lemniscate.optim.vector import ParameterVector
from lemniscate.run.seeding import Generators

Networks = TypeVar("Networks", bound=Any)


@dataclass(kw_only=True)
class TrainState(Generic[Networks]):
    """Training state; saved whole in every checkpoint. An algorithm adds its optimizers and counters.

    A field is a number, or has `state_dict` and `load_state_dict`; `learn` is the only one that is not saved.
    """

    networks: Networks
    """with a `policy`; what is loaded to evaluate it"""
    rng: Generators
    learn: Callable[..., Any] = field(metadata={"saved": False})
    """the algorithm's gradient steps; in a compiled run, their compiled form"""
    step: int = 0
    """environment steps taken"""
    shards: Shards = field(default=ONE_SHARD, metadata={"saved": False})
    """those that the environments and every batch are divided into"""

    @property
    def policy(self) -> Policy:
        """The policy that acts and is evaluated."""
        return self.networks.policy

    def saved(self) -> dict[str, Any]:
        """The fields that a checkpoint holds, by name."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.metadata.get("saved", True)}

    def whole(self) -> dict[str, Any]:
        """The fields that a checkpoint holds, numbers and tensors by name, of all shards; only rank 0 gets all."""
        fields = self.saved()
        for name, value in fields.items():
            if hasattr(value, "state_dict"):
                local = getattr(value, "local", ())
                entries = value.state_dict().items()
                fields[name] = {key: self.shards.to_first(t) if key in local else t for key, t in entries}
        return fields

    def join(self, shards: Shards) -> None:
        """Keep what belongs to the shards held, and take part in what is computed over all of them.

        A new state, and a restored one, is that of all shards. A field with `hold` keeps a part of itself: `local`
        names the entries of its `state_dict` that have a row for each shard or environment.
        """
        if shards.count == 1:
            return
        self.shards = shards
        for module in [*self.networks.modules(), *vars(self).values()]:
            if isinstance(getattr(module, "shards", None), Shards):
                module.shards = shards
        for value in vars(self).values():
            if isinstance(value, Adam):
                value.over_shards = GradientOverShards(value, shards)
        if len(shards.held) < shards.count:
            self.hold(shards.held)

    def hold(self, held: range) -> None:
        """Keep of the fields that belong to shards what belongs to these."""
        self.rng.hold(held)

    def optimizers(self) -> list[Adam]:
        """All optimizers of the state."""
        return [value for value in vars(self).values() if isinstance(value, Adam)]

    def require_finite(self) -> None:
        """Raise `NonFiniteError` where a parameter is NaN or infinite."""
        vectors = [value.vector for value in vars(self).values() if isinstance(value, Adam | ParameterVector)]
        if not math.isfinite(sum(vector.sum().item() for vector in vectors)):  # a NaN shows in the sum
            for name, values in self.networks.named_parameters():
                bad = values[~values.isfinite()]
                if len(bad):
                    said = f"The parameter {name} is {bad[0].item()} after the update"
                    raise NonFiniteError(f"{said} that ends at step {self.step:,}.")

    def on_restart(self) -> None:
        """Forget the running episodes: the environments have been restarted."""

    def on_warm_start(self) -> None:
        """Follow `networks`, whose parameters have been loaded from another run."""

    def per_step_methods(self) -> list[tuple[object, str]]:
        """(owner, name) of the methods that are called all the time, always with the same shapes."""
        return [(self.policy, "act")]

    def compile(self) -> None:
        """Compile the gradient steps and `per_step_methods`, from the next call on."""
        self.learn = Learner(self.learn, self.optimizers())
        device = next(self.networks.parameters()).device
        for owner, name in self.per_step_methods():
            vars(owner)[name] = Compiled(getattr(owner, name), device)  # over the method of the class


@dataclass(kw_only=True)
class ScaledState(TrainState[Networks]):
    """A training state with the scale of the rewards."""

    reward_scale: RewardScale

    def hold(self, held: range) -> None:
        """Keep the running returns of these shards, too."""
        super().hold(held)
        self.reward_scale.hold(rows_of(held, self.shards.count, len(self.reward_scale.running)))

    def on_restart(self) -> None:
        """Forget the running returns."""
        super().on_restart()
        self.reward_scale.on_restart()


def rows_of(held: range, shards: int, rows: int) -> slice:
    """The rows of the shards held, of so many rows in equal parts."""
    size = rows // shards
    return slice(held.start * size, held.stop * size)
