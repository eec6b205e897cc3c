"""PPO here beside rsl_rl's runner, with the same settings in the same environment, in turns: steps per second.

    .venv/bin/python benchmarks/door.py            a simulator of 1,024 carts in torch; and HalfCheetah-v5, 64 of ours

Both collect 24 steps of every environment and learn from them in 5 epochs of 4 minibatches, with networks of 3 × 128
ELU, on two threads.
"""

import sys
import tempfile
import time
from pathlib import Path
from statistics import median

import torch
from rsl_rl.runners import OnPolicyRunner

import lemniscate as lem
from lemniscate.envs.rsl_rl import RslRlVecEnv

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "envs"))
sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
STEPS, EPOCHS, MINIBATCHES, HIDDEN = 24, 5, 4, (128, 128, 128)
MODEL = {"class_name": "rsl_rl.models:MLPModel", "hidden_dims": list(HIDDEN), "activation": "elu"}
MODEL |= {"obs_normalization": True}
GAUSSIAN = {"class_name": "rsl_rl.modules.distribution:GaussianDistribution", "init_std": 1.0}
THEIRS = {
    "num_steps_per_env": STEPS,
    "save_interval": 10**9,
    "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
    "actor": MODEL | {"distribution_cfg": GAUSSIAN},
    "critic": MODEL,
    "algorithm": {
        "class_name": "rsl_rl.algorithms:PPO",
        "num_learning_epochs": EPOCHS,
        "num_mini_batches": MINIBATCHES,
    },
}


def carts(num_envs: int):
    """A simulator of rsl_rl's kind."""
    from test_rsl_rl import Cart

    return Cart(num_envs, gives=("final_obs", "reset", "seed"))


def ours(env, num_envs: int, iterations: int) -> float:
    """Steps per second of PPO here, evaluation left out."""
    rows = STEPS * num_envs
    fields = {"num_envs": num_envs, "num_steps": STEPS, "epochs": EPOCHS, "minibatch_size": rows // MINIBATCHES}
    fields |= {"hidden": HIDDEN, "activation": "elu", "total_steps": rows * iterations, "evaluate_every": 0}
    fields |= {"threads": torch.get_num_threads(), "recompute_advantages": False}
    with tempfile.TemporaryDirectory() as scratch:
        run = lem.train("ppo", env, run=f"{scratch}/run", progress=False, **fields)
    return rows * iterations / run.seconds


def theirs(env, num_envs: int, iterations: int) -> float:
    """Steps per second of rsl_rl's runner."""
    runner = OnPolicyRunner(env, THEIRS, log_dir=None, device="cpu")
    began = time.perf_counter()
    runner.learn(iterations)
    return STEPS * num_envs * iterations / (time.perf_counter() - began)


if __name__ == "__main__":
    torch.set_num_threads(2)
    for name, num_envs, iterations, mine, other in (
        ("carts", 1024, 10, lambda: carts(1024), lambda: carts(1024)),
        ("HalfCheetah-v5", 64, 20, lambda: "HalfCheetah-v5", lambda: RslRlVecEnv("HalfCheetah-v5", 64)),
    ):
        rates = [(ours(mine(), num_envs, iterations), theirs(other(), num_envs, iterations)) for _ in range(3)]
        ratio = median(one / two for one, two in rates)
        one, two = (median(column) for column in zip(*rates, strict=True))
        print(f"{name}: {one:,.0f} steps/s here, {two:,.0f} there, {ratio:.2f} ×", flush=True)
