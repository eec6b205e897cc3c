"""The settings that algorithms share, and the ranges of all settings."""

import dataclasses
import json
import math
import re
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Self, get_args, get_origin, get_type_hints

import torch

from lemniscate.data.action_noise import ActionNoise, Kind
from lemniscate.errors import UserError, unknown_name
from lemniscate.nn.activations import Activation
from lemniscate.nn.actor_critic import ActorCritic
from lemniscate.nn.networks import Layers, Matmul
from lemniscate.spec import Spec


@dataclass(frozen=True)
class Range:
    """A closed interval, or with `above` one open at its lower end."""

    low: float = -math.inf
    high: float = math.inf
    above: bool = False

    def __contains__(self, x: float) -> bool:
        return math.isfinite(x) and (self.low < x if self.above else self.low <= x) and x <= self.high

    def __str__(self) -> str:
        if self.high < math.inf:
            return f"{'above' if self.above else 'from'} {self.low:g} to {self.high:g}"
        return f"{'above' if self.above else 'at least'} {self.low:g}"


Count = Annotated[int, Range(1)]
Natural = Annotated[int, Range(0)]
Seed = Annotated[int, Range(0, 2**32 - 1)]
Fraction = Annotated[float, Range(0, 1)]
Positive = Annotated[float, Range(0, above=True)]
NonNegative = Annotated[float, Range(0)]
Finite = Annotated[float, Range()]
LogStd = Annotated[float, Range(-10, 5)]


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """The fields that every algorithm has. Checked at construction: a value out of range is named in a `UserError`."""

    env: str = "CartPole-v1"
    """environment id; `lemniscate envs` lists them"""
    backend: str | None = None
    """simulation backend (default: chosen from the id)"""
    num_envs: Count = 16
    """number of parallel environments, N; usually 8 to 64"""
    seed: Seed = 1
    """seed of the run, from which all others are derived"""
    total_steps: Count = 1_000_000
    """environment steps of the whole run, summed over the parallel environments; it ends with the update that reaches
    them"""
    device: str = "cpu"
    """device of the networks, and of simulators that can use it: cpu, cuda, cuda:N (GPU N, from 0) or mps; auto takes
    cuda if there is one"""
    threads: Count = 1
    """CPU threads for torch; results differ in rounding between thread counts"""
    compile: Literal["auto", "on", "off"] = "auto"
    """compile the gradient steps and the policy; auto compiles long runs, where it saves time"""
    checkpoint_every: Natural = 0
    """steps between checkpoints, at each of which the environments restart; 0: about five per run"""
    keep_checkpoints: Count = 3
    """number of newest checkpoints kept"""
    evaluate_every: Natural = 0
    """steps between evaluations during training; 0: only at the end"""
    evaluate_episodes: Count = 20
    """episodes of each evaluation"""
    video_every: Natural = 0
    """steps between recordings of an episode into videos/step-N; 0: none"""

    def __post_init__(self) -> None:
        hints = get_type_hints(type(self), include_extras=True)
        for name in self.names():
            value, hint = getattr(self, name), hints[name]
            if get_origin(hint) is not tuple:
                self._check(name, value, hint)
            elif isinstance(value, (tuple, list)):
                for item in value:
                    self._check(name, item, get_args(hint)[0])
            else:
                raise UserError(f"{name} must be several numbers, such as (64, 64), not {value!r}.")
        if not re.fullmatch(r"auto|cpu|mps|cuda(:(0|[1-9][0-9]*))?", str(self.device)):
            raise UserError(f"device must be one of auto, cpu, cuda, cuda:N (like cuda:1), mps, not {self.device!r}.")

    @staticmethod
    def _check(name: str, value: Any, hint: Any) -> None:
        options = [hint] if get_origin(hint) in (Annotated, Literal) else get_args(hint)
        if value is None and type(None) in options:
            return
        for option in options:
            if get_origin(option) is Literal and value not in get_args(option):
                raise UserError(f"{name} must be one of {', '.join(get_args(option))}, not {value!r}.")
            if get_origin(option) is Annotated:
                kind, limits = get_args(option)
                number = isinstance(value, int if kind is int else (int, float)) and not isinstance(value, bool)
                if not (number and value in limits):
                    what = "a whole number" if kind is int else "a number"
                    raise UserError(f"{name} must be {what} {limits}, not {value!r}.")

    @property
    def gradient_steps(self) -> int:
        """The number of gradient steps of the whole run."""
        raise NotImplementedError

    def networks(self, spec: Spec) -> Any:
        """New networks for the spaces in `spec`, a module with a `policy`. Raises `UserError` if they do not fit."""
        raise NotImplementedError

    def replace(self, **changes: object) -> Self:
        """A copy with some fields changed. Raises `UserError` for an unknown field or a value out of range."""
        for name in changes:
            if name not in self.names():
                raise unknown_name("field", name, self.names())
        return dataclasses.replace(self, **changes)

    @classmethod
    def names(cls) -> list[str]:
        """The names of all fields."""
        return [field.name for field in dataclasses.fields(cls)]

    def to_json(self) -> dict[str, Any]:
        """A dictionary that survives JSON."""
        return json.loads(json.dumps(dataclasses.asdict(self)))

    @classmethod
    def from_json(cls, record: dict[str, Any]) -> Self:
        """The Config that `to_json` came from."""
        return cls().replace(**{k: tuple(v) if isinstance(v, list) else v for k, v in record.items()})


@dataclass(frozen=True, kw_only=True)
class OnPolicyConfig(RunConfig):
    """The settings of algorithms that learn from their newest rollout."""

    num_steps: Count = 128
    """steps of each environment between updates, T; usually 16 to 2048, so that N · T is about 2048"""
    gamma: Fraction = 0.99
    """discount factor γ; usually 0.9 to 0.999"""
    hidden: tuple[Count, ...] = (64, 64)
    """widths of the hidden layers of the policy, and of the value"""
    activation: Activation = "tanh"
    """activation function between the layers"""
    network: str = "mlp"
    """mlp, layer_norm (the same with layer normalization), simba (residual blocks of one width), or module:Class"""
    initial_log_std: LogStd = -0.5
    """initial log σ of a Gaussian policy, in units of half the action range; usually -1 to 0"""
    normalize_observations: bool = True
    """normalize observations by their running mean and standard deviation, inside the policy"""
    scale_rewards: bool = True
    """divide rewards by the running standard deviation of the discounted return"""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.layers.check()

    def networks(self, spec: Spec) -> ActorCritic:
        """New networks for the spaces in `spec`: the policy and V(s)."""
        return ActorCritic(spec, self.layers, self.initial_log_std, self.normalize_observations)

    @property
    def layers(self) -> Layers:
        """The hidden layers of the policy, and of the value."""
        return Layers(self.hidden, self.activation, self.network)

    @property
    def num_rows(self) -> int:
        """The number of rows of a rollout, T · N."""
        return self.num_steps * self.num_envs

    @property
    def num_rollouts(self) -> int:
        """The number of rollouts of the whole run."""
        return -(-self.total_steps // self.num_rows)

    def _require_rows(self, field: str, rows: int) -> None:
        """Raise `UserError` if `field`, which standardizes, would have a single row to do it with."""
        if rows == 1 and getattr(self, field):
            raise UserError(f"{field} needs batches of 2 rows or more; these have 1.")


@dataclass(frozen=True, kw_only=True)
class OffPolicyConfig(RunConfig):
    """The settings of algorithms that learn from a replay buffer."""

    num_envs: Count = 1
    """number of parallel environments, N; usually 1 to 8"""
    gamma: Fraction = 0.99
    """discount factor γ; usually 0.95 to 0.999"""
    buffer_size: Count = 1_000_000
    """transitions in the replay buffer; the oldest are replaced"""
    batch_size: Count = 256
    """rows of each gradient step, M; usually 64 to 512"""
    learning_starts: Natural = 5_000
    """environment steps with random actions before the first update; usually 1,000 to 25,000"""
    update_every: Count = 1
    """steps of each environment between updates"""
    num_updates: Count = 1
    """gradient steps of the critics at each update; so num_updates / (N · update_every) for each environment step"""
    log_every: Count = 500
    """steps of each environment between lines of metrics; evaluations and checkpoints wait for the next one"""
    actor_learning_rate: Positive = 3e-4
    """step size of the policy's Adam; usually 1e-4 to 1e-3"""
    critic_learning_rate: Positive = 3e-4
    """step size of the critics' Adam; usually 1e-4 to 1e-3"""
    final_learning_rate: Fraction = 1.0
    """final value of both as a fraction of the initial one, annealed linearly; 1: constant"""
    tau: Fraction = 0.005
    """τ, the share by which the target networks move at each update; usually 0.001 to 0.02"""
    policy_delay: Count = 1
    """gradient steps of the critics for each of the policy and the target networks; usually 1 or 2"""
    action_noise: Kind = "white"
    """noise of actions in training: white, ou (Ornstein–Uhlenbeck) or coloured"""
    noise_time: Positive = 6.7
    """correlation time of Ornstein–Uhlenbeck noise in steps; θ = 0.15 of DDPG's paper is 1 / 0.15"""
    noise_exponent: NonNegative = 1.0
    """β of coloured noise, whose power falls as f^(−β); 1 is pink"""
    hidden: tuple[Count, ...] = (256, 256)
    """widths of the policy's hidden layers"""
    critic_hidden: tuple[Count, ...] = (256, 256)
    """widths of each critic's hidden layers"""
    activation: Activation = "relu"
    """activation function between the layers; simba has its own"""
    network: str = "mlp"
    """mlp, layer_norm (the same with layer normalization), simba (residual blocks of one width), or module:Class"""
    matmul: Matmul = "float32"
    """precision of the products between hidden layers; bfloat16 is faster where the processor has it"""
    normalize_observations: bool = False
    """normalize observations by their running mean and standard deviation, inside the policy"""

    def __post_init__(self) -> None:
        super().__post_init__()
        for layers in self.network_settings[:2]:
            layers.check()
        if self.learning_starts >= self.total_steps:
            raise UserError(
                f"learning_starts must be below total_steps, or nothing is ever learned: {self.learning_starts:,} is"
                f" not below {self.total_steps:,}."
            )
        if not self.gradient_steps:
            raise UserError(
                f"update_every {self.update_every:,} is so large that nothing is ever learned: after learning_starts"
                f" each environment takes {self.steps_per_env - self.learning_starts // self.num_envs:,} steps."
            )
        for name in ("batch_size", "num_envs"):
            if self.capacity < (rows := getattr(self, name)):
                raise UserError(
                    f"The replay buffer must hold a batch, and a step of every environment: the smaller of buffer_size"
                    f" {self.buffer_size:,} and the {self.num_envs * self.steps_per_env:,} steps of the run is"
                    f" below {name} {rows:,}."
                )

    @property
    def network_settings(self) -> tuple[Layers, Layers, bool]:
        """The hidden layers of the policy and of each critic, and whether observations are normalized."""
        shared = self.activation, self.network, self.matmul
        return Layers(self.hidden, *shared), Layers(self.critic_hidden, *shared), self.normalize_observations

    @property
    def capacity(self) -> int:
        """The rows of the replay buffer: no more than the run can fill."""
        return min(self.buffer_size, self.num_envs * self.steps_per_env)

    @property
    def steps_per_env(self) -> int:
        """Steps of each environment in the whole run: the first multiple of log_every that reaches total_steps."""
        return -(-self.total_steps // (self.num_envs * self.log_every)) * self.log_every

    @property
    def gradient_steps(self) -> int:
        """The number of gradient steps of the critics in the whole run."""
        updates = self.steps_per_env // self.update_every
        return self.num_updates * (updates - self.learning_starts // self.num_envs // self.update_every)

    def make_action_noise(self, spec: Spec, device: torch.device) -> ActionNoise:
        """Action noise for the environments of a run; a sequence is as long as an episode may be."""
        shape, length = (self.num_envs, spec.bounded_box().size), spec.max_episode_steps or 1000
        return ActionNoise(self.action_noise, shape, length, device, time=self.noise_time, exponent=self.noise_exponent)

    def updates_at(self, step: int) -> bool:
        """Whether an update follows environment step `step`."""
        return step > self.learning_starts and step // self.num_envs % self.update_every == 0
