"""Presets of the off-policy algorithms: DDPG, TD3, SAC."""

from lemniscate.algos import ddpg, sac, td3
from lemniscate.presets.preset import Preset

CHEETAH = {
    "env": "HalfCheetah-v5",
    "learning_starts": 10_000,
    "actor_learning_rate": 1e-3,
    "critic_learning_rate": 1e-3,
    "batch_size": 128,
}
"""large steps on small batches"""

QUICK = {
    "actor_learning_rate": 1e-3,
    "critic_learning_rate": 1e-3,
    "final_learning_rate": 0.0,
    "batch_size": 128,
    "hidden": (64, 64),
    "critic_hidden": (64, 64),
    "network": "layer_norm",
}
"""small networks, and annealed learning rates"""
SMALL = sac.Config(
    total_steps=600_000,
    num_envs=32,
    num_updates=4,
    log_every=50,
    learning_starts=10_000,
    actor_learning_rate=1e-3,
    critic_learning_rate=1e-3,
    final_learning_rate=0.1,
    tau=0.01,
    policy_delay=2,
    hidden=(128, 128),
    critic_hidden=(128, 128),
    network="layer_norm",
    normalize_observations=True,
    value_range=10.0,
    unit_weights=True,
)
"""for a CPU: many steps for each gradient step, small normalized networks, and a Q that is a distribution"""
SIZED = "search by hand, seven settings on HalfCheetah, four of them on Ant or Walker2d, on seed 101"
PENDULUM = {"env": "Pendulum-v1", "total_steps": 20_000, "learning_starts": 1000, **QUICK}
SWUNG = "search by hand, three settings of each algorithm, on seed 101"

DDPG = [
    Preset(
        "hopper",
        ddpg.Config(
            env="Hopper-v5",
            num_envs=4,
            learning_starts=10_000,
            buffer_size=200_000,
            batch_size=128,
            noise_std=0.3,
            critic_learning_rate=1e-3,
            final_learning_rate=0.0,
        ),
        "search by hand, sixteen settings for 300,000 or a million steps, on seed 101; three of them also on 102",
        "2026-11",
    ),
    Preset(
        "course",
        ddpg.Config(env="Hopper-v5", learning_starts=25_000, policy_delay=2),
        "the reinforcement-learning course's notebook on DDPG: its settings, on the corrected algorithm",
        "2026-11",
    ),
    Preset("pendulum", ddpg.Config(**PENDULUM), SWUNG, "2026-11"),
    Preset(
        "half-cheetah",
        ddpg.Config(**CHEETAH),
        "three settings for 300,000 steps, on seed 101 or 102; the networks of one with the batches of another",
        "2026-11",
    ),
    Preset(
        "mountain-car",
        ddpg.Config(
            env="MountainCarContinuous-v0",
            total_steps=30_000,
            action_noise="ou",
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
            network="layer_norm",
            normalize_observations=True,
        ),
        "search by hand, 24 settings, on seeds 101 and 102; the best two also on 103 and 104",
        "2026-11",
    ),
]
TD3 = [
    Preset("pendulum", td3.Config(**PENDULUM), SWUNG, "2026-11"),
    Preset("half-cheetah", td3.Config(total_steps=300_000, **CHEETAH), "not searched: DDPG's", "2026-11"),
]
SAC = [
    Preset("pendulum", sac.Config(**PENDULUM), SWUNG, "2026-11"),
    *(
        Preset(name, SMALL.replace(env=env), SIZED, "2026-11")
        for name, env in {
            "half-cheetah": "HalfCheetah-v5",
            "hopper": "Hopper-v5",
            "walker2d": "Walker2d-v5",
            "ant": "Ant-v5",
        }.items()
    ),
    Preset("half-cheetah-large", sac.Config(total_steps=300_000, **CHEETAH), "not searched: DDPG's", "2026-11"),
    Preset(
        "lunar-lander-continuous",
        sac.Config(
            env="LunarLanderContinuous-v3",
            total_steps=300_000,
            learning_starts=10_000,
            actor_learning_rate=1e-3,
            critic_learning_rate=1e-3,
            final_learning_rate=0.0,
            tau=0.01,
            hidden=(128, 128),
            critic_hidden=(128, 128),
            network="layer_norm",
        ),
        "search by hand: SAC in two sizes and TD3 in one, on seed 101",
        "2026-11",
    ),
]
