"""Settings and training state of the algorithms that learn from a replay buffer."""

from dataclasses import dataclass
from typing import Any, Literal

import torch

from lemniscate.data.hindsight import LONGEST, HindsightReplay
from lemniscate.data.replay import ActionNoise, Kind, ReplayBuffer, bytes_per_transition
from lemniscate.envs import registry
from lemniscate.envs.vec_env import VecEnv
from lemniscate.errors import UserError
from lemniscate.nn.networks import Activation, Layers, Matmul
from lemniscate.run.config import Count, Fraction, Natural, NonNegative, NumEnvs, Positive, RunConfig, Scheduled, Width
from lemniscate.run.state import Networks, TrainState
from lemniscate.spec import Spec


@dataclass(frozen=True, kw_only=True)
class OffPolicyConfig(RunConfig):
    """The settings of algorithms that learn from a replay buffer."""

    num_envs: NumEnvs = 1
    """parallel environments, N; usually 1 to 8"""
    gamma: Fraction = 0.99
    """discount factor γ; usually 0.95 to 0.999"""
    symmetry: Literal["auto", "on", "off"] = "off"
    """also learn from mirrored steps; auto: where robots can be mirrored"""
    replay: Literal["uniform", "hindsight"] = "uniform"
    """hindsight stores steps again, with goals that were reached"""
    hindsight_goals: Count = 4
    """further goals of each step, k; usually 4 to 8"""
    buffer_size: Count = 1_000_000
    """transitions in the replay buffer; the oldest are replaced"""
    batch_size: Count = 256
    """rows of each gradient step, M; usually 64 to 512"""
    learning_starts: Natural = 5_000
    """environment steps at random before the first update; usually 1,000 to 25,000"""
    update_every: Count = 1
    """steps of each environment between updates"""
    num_updates: Count = 1
    """gradient steps of the critics at each update; usually N · update_every"""
    log_every: Count = 500
    """steps of each environment between lines of metrics, evaluations and checkpoints"""
    actor_learning_rate: Scheduled[Positive] = 3e-4
    """step size of the policy's Adam; usually 1e-4 to 1e-3"""
    critic_learning_rate: Scheduled[Positive] = 3e-4
    """step size of the critics' Adam; usually 1e-4 to 1e-3"""
    final_learning_rate: Fraction = 1.0
    """fraction of both learning rates at the end, linearly; 1: constant"""
    tau: Fraction = 0.005
    """τ, the share by which the target networks move at each update; usually 0.001 to 0.02"""
    policy_delay: Count = 1
    """gradient steps of the critics for each of the policy and the targets; usually 1 or 2"""
    action_noise: Kind = "white"
    """noise of actions in training: white, ou (Ornstein–Uhlenbeck) or coloured"""
    noise_time: Positive = 6.7
    """correlation time of Ornstein–Uhlenbeck noise in steps; in DDPG's paper 1 / 0.15"""
    noise_exponent: NonNegative = 1.0
    """β of coloured noise, whose power falls as f^(−β); 1 is pink"""
    hidden: tuple[Width, ...] = (256, 256)
    """widths of the policy's hidden layers"""
    critic_hidden: tuple[Width, ...] = (256, 256)
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
        self._require_divisible("batch_size")
        for name in ("batch_size", "num_envs", *["hindsight_goals"] * (self.replay == "hindsight")):
            rows = getattr(self, name) * (2 if name == "num_envs" and self.symmetry != "off" else 1)  # mirrored, too
            if self.capacity < rows:
                raise UserError(
                    f"The replay buffer must hold a batch, and a step of every environment: the smaller of buffer_size"
                    f" {self.buffer_size:,} and the {self.num_envs * self.steps_per_env:,} steps of the run is"
                    f" below the {rows:,} rows of {name} {getattr(self, name):,}."
                )

    def memory_bytes(self, spec: Spec) -> dict[str, int]:
        """The bytes of the replay buffer, the action noise, an update's minibatches, and the metrics of a line."""
        actions, length = spec.bounded_box().size, spec.max_episode_steps or 1000
        width = max((*self.hidden, *self.critic_hidden), default=0)
        updates = -(-self.log_every // self.update_every)
        return {
            "buffer_size": self.capacity * bytes_per_transition(spec),
            "num_envs": 4 * self.num_envs * actions * length,
            "num_updates": self.num_updates * (8 * self.batch_size + 1_000),
            "batch_size": 4 * self.batch_size * width,
            "log_every": 1_000 * updates,
        }

    def notices(self, spec: Spec, device: torch.device) -> list[str]:
        """The size of the replay buffer; and products in bfloat16 where the processor has none."""
        size = self.capacity * bytes_per_transition(spec) / 1e6
        notices = [f"Replay buffer: {self.capacity:,} transitions, {size:,.1f} MB (also in each checkpoint)."]
        if spec.has_images and not spec.image:
            notices.append("Beside numbers, pixels are stored as float32, four times the bytes of images alone.")
        if self.matmul == "bfloat16" and not has_bfloat16(device):
            notices.append("This processor has no products in bfloat16; --matmul float32 is faster.")
        return notices

    @property
    def network_settings(self) -> tuple[Layers, Layers, bool]:
        """The hidden layers of the policy and of each critic, and whether observations are normalized."""
        shared = self.activation, self.network, self.matmul
        return Layers(self.hidden, *shared), Layers(self.critic_hidden, *shared), self.normalize_observations

    @property
    def capacity(self) -> int:
        """The rows of the replay buffer: no more than the run can fill."""
        rows_per_step = 1 + self.hindsight_goals * (self.replay == "hindsight") + (self.symmetry != "off")
        return min(self.buffer_size, self.num_envs * self.steps_per_env * rows_per_step)

    @property
    def steps_per_env(self) -> int:
        """Steps of each environment in the whole run: the first multiple of log_every that reaches total_steps."""
        return -(-self.total_steps // (self.num_envs * self.log_every)) * self.log_every

    @property
    def gradient_steps(self) -> int:
        """The number of gradient steps of the critics in the whole run."""
        updates = self.steps_per_env // self.update_every
        return self.num_updates * (updates - self.learning_starts // self.num_envs // self.update_every)

    def make_replay(self, spec: Spec, device: torch.device) -> ReplayBuffer:
        """An empty replay buffer. Raises `UserError` for hindsight where there are no goals, or no whole episodes."""
        if self.replay == "uniform":
            return ReplayBuffer(spec, self.capacity, device)
        least = self.num_envs * min(spec.max_episode_steps or 0, LONGEST)
        once = self.backend and registry.backend_class(self.backend).exists_once(self.env, self.num_envs)
        cuts = {"checkpoint_every": "a checkpoint"} | (
            {"evaluate_every": "an evaluation", "video_every": "a video"} if once else {}
        )
        for field, what in cuts.items():
            if 0 < (every := getattr(self, field)) < least:
                raise UserError(
                    f"{field} {every:,} is less than an episode of each environment, which {what} cuts, and hindsight"
                    f" stores whole ones: it must be {least:,} at least."
                )
        copies = {"num_envs": self.num_envs, "goals": self.hindsight_goals, "seed": self.seed}
        return HindsightReplay(spec, self.capacity, device, **copies)

    def make_action_noise(self, spec: Spec, device: torch.device) -> ActionNoise:
        """Action noise for the environments of a run; a sequence is as long as an episode may be."""
        shape, length = (self.num_envs, spec.bounded_box().size), spec.max_episode_steps or 1000
        return ActionNoise(self.action_noise, shape, length, device, time=self.noise_time, exponent=self.noise_exponent)


@dataclass(kw_only=True)
class OffPolicyState(TrainState[Networks]):
    """The training state of the algorithms that learn from a replay buffer."""

    targets: Any
    """target networks, which follow the others slowly"""
    replay: ReplayBuffer
    action_noise: ActionNoise
    updates: int = 0
    """gradient steps of the critics taken"""

    def on_restart(self, env: VecEnv) -> None:
        """Begin new sequences of action noise, and new episodes in the replay buffer."""
        super().on_restart(env)
        self.action_noise.on_restart()
        self.replay.mirror = env.mirror
        self.replay.on_restart(env.backend.judge_goals)

    def on_change(self) -> None:
        """Drop the episodes under way where goals are judged: other rules paid them."""
        self.replay.drop()

    def on_warm_start(self) -> None:
        """Copy the loaded networks into the targets."""
        self.targets.load_state_dict(self.networks.target().state_dict())


def has_bfloat16(device: torch.device) -> bool:
    """Whether the processor, or on mps Metal, has products in bfloat16; elsewhere they are emulated, and slow."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    if device.type == "mps":
        return torch.backends.mps.is_macos_or_newer(14, 0)
    return any(able for name, able in torch.cpu.get_capabilities().items() if "bf16" in name)
