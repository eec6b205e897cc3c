"""Presets of the on-policy algorithms: REINFORCE, A2C, TRPO, PPO, REPPO."""

from lemniscate.algos import a2c, ppo, reppo, trpo
from lemniscate.presets.preset import Preset

FIGURE_EIGHT = "DroneFigureEightTrajectory-v0"

PAPER = ppo.Config(
    num_envs=8,
    num_steps=256,
    minibatch_size=64,
    desired_kl=None,
    value_coef=0.5,
    max_grad_norm=0.5,
    scale_rewards=False,
    recompute_advantages=False,
    initial_log_std=0.0,
)
"""table 3 of the paper, for MuJoCo, on 8 parallel environments with a running normalizer"""

ADAPTIVE = ppo.Config(num_envs=64, num_steps=64, minibatch_size=512, checkpoint_every=250_000)
"""many parallel environments, and a learning rate that follows the KL; after rl_games and rsl_rl"""

ANNEALED = PAPER.replace(
    value_coef=0.25,
    scale_rewards=True,
    recompute_advantages=True,
    normalize_advantage=False,
    initial_log_std=-0.5,
    checkpoint_every=250_000,
)
"""few parallel environments, small minibatches, and an annealed learning rate; after Tianshou"""

DRONES = PAPER.replace(
    env=FIGURE_EIGHT,
    num_envs=256,
    num_steps=32,
    total_steps=600_000,
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
)
"""many drones, short rollouts, a large learning rate that falls to nearly nothing"""

PPO = [
    Preset(
        "figure-eight",
        DRONES,
        "random search, some 200 runs, none with the seeds 1 to 5 that it is evaluated on",
        "2026-11",
    ),
    Preset(
        "figure-eight-robust",
        DRONES.replace(
            env_kwargs={
                "dynamics": ["so_rpy", "so_rpy_rotor_drag", "first_principles", "first_principles"],
                "mass": [0.85, 1.15],
                "inertia": [0.7, 1.3],
                "motor_gain": [0.9, 1.1],
                "action_delay": [0.0, 0.025],
                "wind": [0.0, 0.05],
                "rotors": [0.0, 1.0],
                "history": 5,
                "privileged": True,
            },
            total_steps=7_000_000,
            learning_rate=7e-4,
            gamma=0.98,
            hidden=(128, 128),
            checkpoint_every=2_000_000,
        ),
        "search by hand, 17 settings, on seed 101",
        "2026-11",
    ),
    Preset(
        "course",
        PAPER.replace(
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
        PAPER.replace(
            env="CartPole-v1",
            total_steps=50_000,
            num_steps=64,
            minibatch_size=128,
            learning_rate=1e-3,
            normalize_observations=False,
            scale_rewards=True,  # else the errors of values near 100 take all of the clipped gradient's norm
        ),
        "search by hand, 47 runs, on seeds 101 to 111",
        "2026-11",
    ),
    Preset(
        "lunar-lander",
        PAPER.replace(
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
        PAPER.replace(
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
        "search by hand, 13 settings, mostly on seeds 101 to 106; the three best did not hold on fresh seeds",
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
    Preset(
        "paper", PAPER, "Schulman et al. 2017, table 3, on 8 parallel environments with a running normalizer", "2026-11"
    ),
]

REINFORCE: list[Preset] = []

MANY = reppo.Config(num_envs=256, gamma=0.99, td_lambda=0.8, max_kl=0.5)
"""rollouts of 16,384 rows and 512 gradient steps: for bodies with many joints"""
NOISY = reppo.Config(gamma=0.995, min_temperature=0.003)
"""a longer horizon, and noise that always pays: for robots that can fall"""
TRIED = "search by hand, some 25 settings on four environments, 300,000 steps, mostly on seed 101"
SURE = "search by hand, ten settings, 750,000 steps, on seeds 101 to 105; chosen by the worst seeds"

REPPO = [
    Preset(
        "ant",
        MANY.replace(env="Ant-v5", max_kl=0.1, min_temperature=0.001),  # with no floor α falls to 1e-8
        f"{TRIED}; this one after 16 of a million on 101 to 103",
        "2026-11",
    ),
    Preset("humanoid", MANY.replace(env="Humanoid-v5"), f"{TRIED}; this one after two longer runs on 101", "2026-11"),
    Preset("walker2d", NOISY.replace(env="Walker2d-v5"), SURE, "2026-11"),
    Preset("hopper", NOISY.replace(env="Hopper-v5"), SURE, "2026-11"),
]

A2C = [
    Preset(
        "half-cheetah",
        a2c.Config(env="HalfCheetah-v5", initial_log_std=-1.5),  # a wider first policy rolls onto its back
        "search by hand, 15 settings, on seeds from 101 on; this one on 101 to 116, for 300,000 steps",
        "2026-11",
    ),
    Preset(
        "figure-eight",
        a2c.Config(
            env=FIGURE_EIGHT,
            num_envs=32,
            learning_rate=3e-3,
            gamma=0.92,
            scale_rewards=False,
            initial_log_std=-0.8,
            evaluate_episodes=64,
        ),
        "search by hand, 9 settings, on seeds 101 to 104",
        "2026-11",
    ),
]

TRPO = [
    Preset("half-cheetah", trpo.Config(env="HalfCheetah-v5"), "search by hand, 3 runs, on seed 101", "2026-11"),
    Preset(
        "walker2d",
        trpo.Config(env="Walker2d-v5", num_envs=64),
        "search by hand, 11 runs, on seeds 101 to 104",
        "2026-11",
    ),
    Preset(
        "hopper",
        trpo.Config(env="Hopper-v5", num_envs=8, num_steps=256, gamma=0.995),  # else a dive pays nearly as well
        "search by hand, 10 runs, on seeds 101 to 106",
        "2026-11",
    ),
    Preset(
        "swimmer",
        trpo.Config(env="Swimmer-v5", num_envs=4, num_steps=512, gamma=0.9999, gae_lambda=0.995, initial_log_std=0.0),
        "search by hand, 8 settings, on seeds 101 to 110; this one on 105 to 110",
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
            critic_epochs=10,
            scale_rewards=False,
            initial_log_std=-0.8,
            evaluate_episodes=64,
        ),
        "a run on seed 101",
        "2026-11",
    ),
]
