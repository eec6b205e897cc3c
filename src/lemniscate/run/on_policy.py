"""Settings and training state of the algorithms that learn from their newest rollout."""

from dataclasses import dataclass, replace
from typing import Annotated, Any

import torch

from lemniscate.data.rollout import rollout_bytes
from lemniscate.errors import UserError
from lemniscate.nn.actor_critic import ActorCritic
from lemniscate.nn.networks import Activation, Layers
from lemniscate.run.config import Count, Fraction, LogStd, Range, RunConfig, Width
from lemniscate.run.state import Networks, ScaledState
from lemniscate.spec import Spec


@dataclass(frozen=True, kw_only=True)
class OnPolicyConfig(RunConfig):
    """The settings of algorithms that learn from their newest rollout."""

    num_steps: Count = 128
    """steps of each environment between updates, T; usually 16 to 2048, so that N · T is about 2048"""
    gamma: Fraction = 0.99
    """discount factor γ; usually 0.9 to 0.999"""
    hidden: tuple[Width, ...] = (64, 64)
    """widths of the policy's hidden layers"""
    activation: Activation = "tanh"
    """activation function between the layers"""
    network: str = "mlp"
    """mlp, layer_norm (the same with layer normalization), simba (residual blocks of one width), or module:Class"""
    normalize_observations: bool = True
    """normalize observations by their running mean and standard deviation, inside the policy"""
    scale_rewards: bool = True
    """divide rewards by the running standard deviation of the discounted return"""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.layers.check()

    def memory_bytes(self, spec: Spec) -> dict[str, int]:
        """The bytes of a rollout, and of its rows in the widest layer."""
        widths = *self.hidden, *(getattr(self, "critic_hidden", None) or ())
        rows = 4 * self.num_rows * max(widths, default=0)
        return {"num_steps": rows + rollout_bytes(spec, self.num_steps, self.num_envs)}

    @property
    def layers(self) -> Layers:
        """The hidden layers of the policy."""
        return Layers(self.hidden, self.activation, self.network)

    @property
    def num_rows(self) -> int:
        """The number of rows of a rollout, T · N."""
        return self.num_steps * self.num_envs

    @property
    def num_rollouts(self) -> int:
        """The number of rollouts of the whole run."""
        return -(-self.total_steps // self.num_rows)

    @property
    def gradient_steps(self) -> int:
        """The number of gradient steps of the whole run: passes over each rollout, in minibatches where it has them.

        Where the value is learned apart, in passes of its own, those alone.
        """
        own = "critic_" if hasattr(self, "critic_epochs") else ""
        epochs, size = getattr(self, f"{own}epochs", 1), getattr(self, f"{own}minibatch_size", self.num_rows)
        return self.num_rollouts * epochs * -(-self.num_rows // size)

    def _require_minibatch(self, field: str) -> None:
        """Raise `UserError` if `field`, the size of minibatches, is above the rows of a rollout."""
        if getattr(self, field) > self.num_rows:
            rows = f"{self.num_rows:,} rows of a rollout, num_envs {self.num_envs:,} times num_steps {self.num_steps:,}"
            raise UserError(f"{field} {getattr(self, field):,} is above the {rows}.")
        self._require_divisible(field)

    def _require_constant(self, field: str, adapted_by: str) -> None:
        """Raise `UserError` if a `field` that another one adapts has a schedule."""
        if getattr(self, adapted_by) is not None and field in self.schedules:
            schedule = f"{field} {getattr(self, field)}"
            raise UserError(f"{schedule} is a schedule, which {adapted_by} does not follow: {adapted_by} must be none.")

    def _require_rows(self, field: str, rows: int) -> None:
        """Raise `UserError` if `field`, which standardizes, would have a single row to do it with."""
        if rows == 1 and getattr(self, field):
            raise UserError(f"{field} needs batches of 2 rows or more; these have 1.")


@dataclass(frozen=True, kw_only=True)
class ActorCriticConfig(OnPolicyConfig):
    """The settings of those that learn a policy and, beside it, a value."""

    critic_hidden: tuple[Width, ...] | None = None
    """widths for the value, or for Q; usually as wide or wider; none: as hidden"""
    initial_log_std: LogStd = -0.5
    """initial log σ of a Gaussian policy, in units of half the action range; usually -1 to 0"""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.network_settings[1].check()

    def networks(self, spec: Spec) -> Any:
        """New networks for the spaces in `spec`: the policy and V(s)."""
        layers, critic_layers, normalize = self.network_settings
        return ActorCritic(spec, layers, self.initial_log_std, normalize, critic_layers=critic_layers)

    @property
    def network_settings(self) -> tuple[Layers, Layers, bool]:
        """The hidden layers of the policy and of the value, and whether observations are normalized."""
        critic_hidden = self.hidden if self.critic_hidden is None else self.critic_hidden
        return self.layers, replace(self.layers, hidden=critic_hidden), self.normalize_observations


@dataclass(frozen=True, kw_only=True)
class RecurrentConfig(ActorCriticConfig):
    """The settings of those that learn from pieces of a rollout too, and so with a memory."""

    network: str = "mlp"
    """mlp, layer_norm, simba, gru (with a memory), or module:Class"""
    sequence_length: Annotated[int, Range(2)] = 16
    """steps of back-propagation through time, L"""
    shared_memory: bool = False
    """the value sees the policy's memory"""

    def networks(self, spec: Spec) -> Any:
        """New networks for the spaces in `spec`: the policy and V(s)."""
        layers, critic_layers, normalize = self.network_settings
        own = {"critic_layers": critic_layers, "length": self.piece_length, "shared_memory": self.shared_memory}
        return ActorCritic(spec, layers, self.initial_log_std, normalize, **own)

    def make_networks(self, spec: Spec, device: torch.device) -> Any:
        """New networks, seeded. Raises `UserError` where those with a memory cannot have whole pieces of a rollout."""
        networks, length = super().make_networks(spec, device), self.piece_length
        for name in ("num_steps", "minibatch_size", "critic_minibatch_size") if networks.memory else ():
            share = self.shards if name != "num_steps" else 1
            if (rows := getattr(self, name, 0)) % (length * share):
                of = f" for each of {share} shards" if share > 1 else ""
                raise UserError(f"{name} {rows:,} is no multiple of sequence_length {length}{of}.")
        return networks

    @property
    def piece_length(self) -> int:
        """The steps of a piece of a rollout, L, where the networks have a memory."""
        return min(self.sequence_length, self.num_steps)


@dataclass(kw_only=True)
class OnPolicyState(ScaledState[Networks]):
    """The training state of the algorithms that learn from their newest rollout."""

    def per_step_methods(self) -> list[tuple[object, str]]:
        """The methods of every algorithm, the estimates on a rollout, and the memory where there is one."""
        memory = [(self.networks, "remember")] if self.networks.memory else []
        return [*super().per_step_methods(), (self.networks, "estimates"), *memory]
