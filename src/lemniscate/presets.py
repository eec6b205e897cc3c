"""Tuned Configs, as Python values: where each came from, and when.

`default` is what an environment without a preset of its own gets.
"""

from dataclasses import dataclass

from lemniscate.algos import a2c, ddpg, ppo, reinforce, sac, td3, trpo
from lemniscate.errors import unknown
from lemniscate.run.config import RunConfig

FIGURE_EIGHT = "DroneFigureEightTrajectory-v0"


@dataclass(frozen=True)
class Preset:
    """A Config that has been tried, with its provenance."""

    name: str
    config: RunConfig
    source: str
    date: str


ADAPTIVE = ppo.Config(
    num_envs=64,
    num_steps=64,
    minibatch_size=512,
    desired_kl=0.01,
    max_grad_norm=1.0,
    value_coef=1.0,
    scale_rewards=True,
    recompute_advantages=True,
    initial_log_std=-0.5,
    checkpoint_every=250_000,
)
"""many copies, and a learning rate that follows the KL; after rl_games and rsl_rl"""

ANNEALED = ppo.Config(
    num_steps=256,
    minibatch_size=64,
    value_coef=0.25,
    scale_rewards=True,
    recompute_advantages=True,
    normalize_advantage=False,
    initial_log_std=-0.5,
    checkpoint_every=250_000,
)
"""few copies, small minibatches, and a learning rate that falls; after Tianshou"""

PPO = [
    Preset(
        "default",
        ADAPTIVE.replace(num_envs=16, num_steps=128, minibatch_size=256, checkpoint_every=0),
        "the best of five candidates on Pendulum, Acrobot and InvertedDoublePendulum, seeds 101 and 102",
        "2026-11",
    ),
    Preset(
        "figure-eight",
        ppo.Config(
            env=FIGURE_EIGHT,
            num_envs=256,
            num_steps=32,
            total_steps=1_000_000,
            epochs=4,
            minibatch_size=1024,
            learning_rate=3e-3,
            final_learning_rate=0.02,
            adam_beta2=0.99,
            gamma=0.97,
            gae_lambda=0.95,
            clip=0.25,
            initial_log_std=-0.8,
            evaluate_episodes=64,
            checkpoint_every=250_000,
        ),
        "random search, some 200 runs, none with the seeds 1 to 5 that it is evaluated on",
        "2026-11",
    ),
    Preset(
        "course",
        ppo.Config(
            env=FIGURE_EIGHT,
            num_envs=1024,
            num_steps=16,
            total_steps=1_000_000,
            epochs=15,
            minibatch_size=1024,
            learning_rate=1.5e-3,
            final_learning_rate=0.2,
            gamma=0.9,
            gae_lambda=0.95,
            clip=0.25,
            clip_value=0.25,
            entropy_coef=0.01,
            value_coef=0.5,
            max_grad_norm=5.0,
            evaluate_episodes=64,
            checkpoint_every=1_000_000,
        ),
        "the drone course's notebook: its settings, on the corrected algorithm",
        "2026-11",
    ),
    Preset(
        "cart-pole",
        ppo.Config(
            env="CartPole-v1",
            total_steps=50_000,
            num_steps=64,
            minibatch_size=128,
            learning_rate=1e-3,
            normalize_observations=False,
            checkpoint_every=50_000,  # restarts would cut the long episodes in which the cart drifts off the track
        ),
        "search by hand, 27 runs, on seeds 101 to 111",
        "2026-11",
    ),
    Preset(
        "lunar-lander",
        ppo.Config(
            env="LunarLander-v3",
            num_envs=16,
            minibatch_size=512,
            epochs=8,
            learning_rate=1e-3,
            gamma=0.999,
            gae_lambda=0.98,
            entropy_coef=0.01,
            scale_rewards=True,
            checkpoint_every=250_000,
        ),
        "search by hand, 3 runs, on seed 101",
        "2026-11",
    ),
    Preset(
        "course",
        ppo.Config(
            env="LunarLander-v3",
            num_envs=16,
            num_steps=10,
            total_steps=320_000,
            epochs=5,
            minibatch_size=160,
            learning_rate=1e-4,
            final_learning_rate=1.0,
            adam_eps=1e-8,
            gamma=0.9,
            gae_lambda=0.95,
            value_coef=2.0,
            normalize_advantage=False,
            max_grad_norm=None,
            recompute_advantages=True,
            hidden=(128, 128),
            activation="relu",
            normalize_observations=False,
        ),
        "the reinforcement-learning course's exercise on LunarLander: its settings, on the corrected algorithm",
        "2026-11",
    ),
    Preset(
        "half-cheetah",
        ADAPTIVE.replace(env="HalfCheetah-v5"),
        "search by hand, 6 runs, on seeds 101 and 102",
        "2026-11",
    ),
    Preset("ant", ADAPTIVE.replace(env="Ant-v5"), "search by hand, 5 runs, on seeds 101 and 102", "2026-11"),
    Preset("humanoid", ADAPTIVE.replace(env="Humanoid-v5"), "search by hand, 2 runs, on seeds 101 and 102", "2026-11"),
    Preset(
        "hopper",
        ANNEALED.replace(env="Hopper-v5"),
        "Tianshou's settings, best of 11 runs, on seeds 101 and 102",
        "2026-11",
    ),
    Preset(
        "walker2d",
        ANNEALED.replace(
            env="Walker2d-v5",
            num_envs=16,
            num_steps=128,
            minibatch_size=256,
            learning_rate=1e-3,
            normalize_advantage=True,
        ),
        "search by hand, 7 runs, on seeds 101 and 102",
        "2026-11",
    ),
    Preset("paper", ppo.Config(), "Schulman et al. 2017, table 3, on 8 copies with a running normalizer", "2026-11"),
]

REINFORCE = [
    Preset("default", reinforce.Config(), "first values, tried on CartPole and InvertedPendulum, seed 101", "2026-11")
]

SURE = a2c.Config(
    num_envs=16,
    num_steps=16,
    learning_rate=1e-3,
    gae_lambda=0.95,
    normalize_advantage=True,
    scale_rewards=True,
    initial_log_std=-1.0,
)
"""little noise: with a step for each rollout, most of what is tried has to be good"""

A2C = [
    Preset("default", SURE, "what serves HalfCheetah", "2026-11"),
    Preset("half-cheetah", SURE.replace(env="HalfCheetah-v5"), "search by hand, 12 runs, on seed 101", "2026-11"),
    Preset(
        "figure-eight",
        a2c.Config(
            env=FIGURE_EIGHT,
            num_envs=32,
            num_steps=16,
            learning_rate=3e-3,
            gamma=0.92,
            gae_lambda=0.95,
            normalize_advantage=True,
            initial_log_std=-0.8,
            evaluate_episodes=64,
        ),
        "search by hand, 9 settings, on seeds 101 to 104",
        "2026-11",
    ),
]

BOUNDED = trpo.Config(num_envs=16, num_steps=64, critic_epochs=20, initial_log_std=-0.5, scale_rewards=True)
"""small rollouts, and a critic that is fitted well"""

TRPO = [
    Preset("default", BOUNDED, "what serves HalfCheetah and Walker2d", "2026-11"),
    Preset(
        "half-cheetah",
        BOUNDED.replace(env="HalfCheetah-v5"),
        "search by hand, 3 runs, on seed 101",
        "2026-11",
    ),
    Preset("walker2d", BOUNDED.replace(env="Walker2d-v5"), "a run on seed 101", "2026-11"),
    Preset(
        "hopper",
        BOUNDED.replace(env="Hopper-v5", num_envs=8, num_steps=256),
        "search by hand, 2 runs, on seed 101",
        "2026-11",
    ),
    Preset(
        "swimmer",
        trpo.Config(
            env="Swimmer-v5",
            num_envs=4,
            num_steps=512,
            max_kl=0.04,
            final_max_kl=0.0,
            gamma=0.9999,
            gae_lambda=0.98,
            critic_epochs=20,
        ),
        "search by hand, 3 runs, on seed 101",
        "2026-11",
    ),
    Preset(
        "figure-eight",
        trpo.Config(
            env=FIGURE_EIGHT,
            num_envs=64,
            num_steps=32,
            max_kl=0.03,
            gamma=0.97,
            initial_log_std=-0.8,
            evaluate_episodes=64,
        ),
        "a run on seed 101",
        "2026-11",
    ),
]

SHARED = "the settings that most libraries share today"
BOLD = {
    "learning_starts": 10_000,
    "actor_learning_rate": 1e-3,
    "critic_learning_rate": 1e-3,
    "architecture": "layer_norm",
}
"""layer normalization bears the larger steps"""

QUICK = {
    "actor_learning_rate": 1e-3,
    "critic_learning_rate": 1e-3,
    "final_learning_rate": 0.0,
    "batch_size": 128,
    "hidden": (64, 64),
    "critic_hidden": (64, 64),
    "architecture": "layer_norm",
}
"""small networks, and learning rates that fall"""
PENDULUM = {"env": "Pendulum-v1", "total_steps": 20_000, "learning_starts": 1000, **QUICK}
SWUNG = "search by hand, three settings of each algorithm, on seed 101"

DDPG = [
    Preset("default", ddpg.Config(), SHARED, "2026-11"),
    Preset(
        "course",
        ddpg.Config(env="Hopper-v5", learning_starts=25_000, policy_delay=2),
        "the reinforcement-learning course's notebook on DDPG: its settings, on the corrected algorithm",
        "2026-11",
    ),
    Preset("pendulum", ddpg.Config(**PENDULUM), SWUNG, "2026-11"),
    Preset(
        "half-cheetah",
        ddpg.Config(env="HalfCheetah-v5", **BOLD),
        "a run of 300,000 steps on seed 101",
        "2026-11",
    ),
    Preset(
        "mountain-car",
        ddpg.Config(
            env="MountainCarContinuous-v0",
            total_steps=30_000,
            noise="ou",
            noise_std=0.6,
            gamma=0.998,
            batch_size=128,
            learning_starts=2000,
            actor_learning_rate=3e-4,
            critic_learning_rate=1e-3,
            final_learning_rate=0.0,
            policy_delay=2,
            hidden=(64, 64),
            critic_hidden=(64, 64),
            architecture="layer_norm",
            normalize_observations=True,
        ),
        "search by hand, 24 settings, on seeds 101 and 102; the best two also on 103 and 104",
        "2026-11",
    ),
]
TD3 = [
    Preset("default", td3.Config(), SHARED, "2026-11"),
    Preset("pendulum", td3.Config(**PENDULUM), SWUNG, "2026-11"),
]
SAC = [
    Preset("default", sac.Config(), SHARED, "2026-11"),
    Preset("pendulum", sac.Config(**PENDULUM), SWUNG, "2026-11"),
]

PRESETS: dict[str, list[Preset]] = {
    "reinforce": REINFORCE,
    "a2c": A2C,
    "trpo": TRPO,
    "ppo": PPO,
    "ddpg": DDPG,
    "td3": TD3,
    "sac": SAC,
}


def names(algorithm: str) -> list[str]:
    """Every preset's name, each once."""
    return list(dict.fromkeys(preset.name for preset in PRESETS[algorithm]))


def best(algorithm: str, env_id: str | None) -> str:
    """The preset that an environment gets unasked: the first that is its own, or the default."""
    own = (preset.name for preset in PRESETS[algorithm][1:] if preset.config.env == env_id)
    return next(own, "default")


def choose(algorithm: str, env_id: str | None, name: str | None) -> tuple[str, RunConfig]:
    """The preset asked for, or the best known for the environment, or the default: (its name, its Config).

    Where several environments have a preset of one name, the environment decides. The Config's `env` is `env_id` if one
    is given. Raises `UserError` with the nearest names for an unknown preset.
    """
    name = name or best(algorithm, env_id)
    named = [preset.config for preset in PRESETS[algorithm] if preset.name == name]
    if not named:
        raise unknown("preset", name, names(algorithm))
    config = next((config for config in named if config.env == env_id), named[0])
    return name, config.replace(env=env_id) if env_id else config
