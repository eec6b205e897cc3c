"""What every algorithm's Config shares, and the ranges that all of them are held to."""

import dataclasses
import json
import math
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, Self, get_args, get_origin, get_type_hints

from lemniscate.data.action_noise import Noise
from lemniscate.errors import UserError, unknown_name
from lemniscate.nn.networks import Activation, Architecture, Layers, Matmul


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


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """The fields that every algorithm has. Checked at construction: a value out of range is named in a `UserError`."""

    env: str = "CartPole-v1"
    """environment id; `lemniscate envs` lists them"""
    backend: str | None = None
    """who steps the environments; chosen by the id unless named"""
    num_envs: Count = 8
    """copies of the environment, N"""
    seed: Seed = 1
    """the one seed; every other is derived from it"""
    total_steps: Count = 1_000_000
    """environment steps of the whole run, summed over the copies; it ends with the update that reaches them"""
    device: Literal["auto", "cpu", "cuda"] = "cpu"
    """where networks, and simulators that can, live; auto takes cuda if there is one"""
    threads: Count = 1
    """torch's threads on the CPU; results of one number differ in rounding from another's"""
    engine: Literal["auto", "eager", "native"] = "auto"
    """how gradient steps are taken: one by one through autograd, or as one native call; auto compiles long runs"""
    checkpoint_every: Natural = 0
    """steps between checkpoints, at each of which the environments restart; 0 makes five, fewer of a short run"""
    keep_checkpoints: Count = 3
    """older ones are deleted"""
    evaluate_every: Natural = 0
    """steps between evaluations during training; 0 leaves it to the end"""
    evaluate_episodes: Count = 20
    """episodes of each evaluation"""
    video_every: Natural = 0
    """steps between recordings of an episode into videos/step-N; 0 records none"""
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    """arguments of the environment, as JSON: '{"dynamics": "first_principles"}'"""
    wrappers: tuple[str, ...] = ()
    """wrappers of each environment, the first innermost: module:name or module:name(key=value)"""

    def __post_init__(self) -> None:
        hints = get_type_hints(type(self), include_extras=True)
        for name in self.names():
            value, hint = getattr(self, name), hints[name]
            if get_origin(hint) is not tuple:
                self._check(name, value, hint)
            elif isinstance(value, (tuple, list)):
                for item in value:
                    self._check(name, item, get_args(hint)[0])
            elif name == "wrappers":
                raise UserError(f"wrappers must be several names, such as ('module:Class',), not {value!r}.")
            else:
                raise UserError(f"{name} must be several numbers, such as (64, 64), not {value!r}.")
        try:
            json.dumps(self.env_kwargs)
        except TypeError as error:
            raise UserError(f"env_kwargs must be a dictionary that JSON can keep: {error}.") from None

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
        """Of the whole run."""
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
    """What algorithms that learn from their own newest rollout share."""

    num_steps: Count = 256
    """steps of each copy between updates, T"""
    gamma: Fraction = 0.99
    """discount γ"""
    hidden: tuple[Count, ...] = (64, 64)
    """widths of the hidden layers, the same for policy and value"""
    activation: Activation = "tanh"
    """between the layers"""
    initial_log_std: Annotated[float, Range(-10, 5)] = 0.0
    """log σ at the start, in units of half the action range"""
    normalize_observations: bool = True
    """a running normalizer inside the policy"""
    scale_rewards: bool = False
    """divide rewards by the running standard deviation of the discounted return"""

    @property
    def layers(self) -> Layers:
        """Of the policy, and of the value."""
        return Layers(self.hidden, self.activation)

    @property
    def num_rows(self) -> int:
        """Of a rollout, T · N."""
        return self.num_steps * self.num_envs

    @property
    def num_rollouts(self) -> int:
        """Of the whole run."""
        return -(-self.total_steps // self.num_rows)

    def _require_rows(self, field: str, rows: int) -> None:
        """Raise `UserError` if `field`, which standardizes, would have a single row to do it with."""
        if rows == 1 and getattr(self, field):
            raise UserError(f"{field} needs batches of 2 rows or more; these have 1.")


@dataclass(frozen=True, kw_only=True)
class OffPolicyConfig(RunConfig):
    """What algorithms that learn from memory share: the memory, the rhythm of acting and learning, noise, networks.

    The defaults are those in use today, rather than any paper's.
    """

    num_envs: Count = 1
    """copies of the environment, N"""
    gamma: Fraction = 0.99
    """discount γ"""
    buffer_size: Count = 1_000_000
    """transitions that are remembered; the oldest make room"""
    batch_size: Count = 256
    """of each gradient step, M"""
    learning_starts: Natural = 5_000
    """environment steps with random actions before anything is learned"""
    update_every: Count = 1
    """steps of each copy between updates"""
    num_updates: Count = 1
    """gradient steps at each update; so num_updates / (N · update_every) for each environment step"""
    num_steps: Count = 500
    """steps of each copy between two lines of metrics; evaluations, checkpoints and the end wait for the next one"""
    actor_learning_rate: Positive = 3e-4
    """Adam's step size for the policy"""
    critic_learning_rate: Positive = 3e-4
    """Adam's step size for Q"""
    final_learning_rate: Fraction = 1.0
    """fraction of both that they fall to, linearly over the run; 1 keeps them as they are"""
    tau: Fraction = 0.005
    """how far the target networks move at each of their updates"""
    noise: Noise = "white"
    """what actions are drawn with in training: white; Ornstein–Uhlenbeck; coloured"""
    noise_time: Positive = 6.7
    """steps in which Ornstein–Uhlenbeck noise forgets itself; DDPG's paper has θ = 0.15, which is 1 / 0.15"""
    noise_exponent: NonNegative = 1.0
    """β of coloured noise, whose power falls as f^(−β); 1 is pink"""
    hidden: tuple[Count, ...] = (256, 256)
    """widths of the policy's hidden layers"""
    critic_hidden: tuple[Count, ...] = (256, 256)
    """widths of Q's"""
    activation: Activation = "relu"
    """between the layers; SimBa's is relu in any case"""
    architecture: Architecture = "mlp"
    """plain layers; with layer normalization; or SimBa's residual blocks, all of one width"""
    matmul: Matmul = "float32"
    """of products between hidden layers; bfloat16 is quicker where the processor has it"""
    normalize_observations: bool = False
    """a running normalizer inside the policy"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.learning_starts >= self.total_steps:
            raise UserError(
                f"learning_starts must be below total_steps, or nothing is ever learned: {self.learning_starts:,} is"
                f" not below {self.total_steps:,}."
            )
        if not self.gradient_steps:
            raise UserError(
                f"update_every {self.update_every:,} is so large that nothing is ever learned: after learning_starts"
                f" each copy takes {self.steps_of_each_copy - self.learning_starts // self.num_envs:,} steps."
            )
        if self.architecture == "simba" and any(len(set(widths)) != 1 for widths in (self.hidden, self.critic_hidden)):
            raise UserError(
                f"SimBa's blocks have one width, such as (256, 256): not {self.hidden} and {self.critic_hidden}."
            )
        for name in ("batch_size", "num_envs"):
            if self.capacity < (rows := getattr(self, name)):
                raise UserError(
                    f"The replay must hold a batch, and a step of every copy: the smaller of buffer_size"
                    f" {self.buffer_size:,} and the {self.num_envs * self.steps_of_each_copy:,} steps of the run is"
                    f" below {name} {rows:,}."
                )

    @property
    def actor_layers(self) -> Layers:
        """Of the policy."""
        return Layers(self.hidden, self.activation, self.architecture, self.matmul)

    @property
    def critic_layers(self) -> Layers:
        """Of Q."""
        return Layers(self.critic_hidden, self.activation, self.architecture, self.matmul)

    @property
    def capacity(self) -> int:
        """Rows of the replay: no more than the run can fill."""
        return min(self.buffer_size, self.num_envs * self.steps_of_each_copy)

    @property
    def steps_of_each_copy(self) -> int:
        """In the whole run: the first multiple of num_steps with which all copies reach total_steps."""
        return -(-self.total_steps // (self.num_envs * self.num_steps)) * self.num_steps

    @property
    def gradient_steps(self) -> int:
        """Of the whole run."""
        updates = self.steps_of_each_copy // self.update_every
        return self.num_updates * (updates - self.learning_starts // self.num_envs // self.update_every)
