"""Every algorithm passes the contract that `lemniscate.testing` offers for algorithms of one's own."""

import pytest

from lemniscate.algos import ALGORITHMS
from lemniscate.testing import ALGORITHM_CONTRACT

ON_POLICY = {"env": "CartPole-v1", "num_envs": 4, "num_steps": 32, "total_steps": 1280, "hidden": (8,)}
OFF_POLICY = {
    "env": "Pendulum-v1",
    "num_envs": 2,
    "total_steps": 400,
    "log_every": 20,
    "learning_starts": 50,
    "batch_size": 16,
    "hidden": (8,),
    "critic_hidden": (8,),
}


TRAINS_OFTEN = ("check_seeds", "check_resume")


@pytest.mark.parametrize(
    ("algorithm", "check"),
    [
        pytest.param(
            algorithm,
            check,
            marks=pytest.mark.long if check.__name__ in TRAINS_OFTEN and algorithm not in ("ppo", "sac") else (),
            id=f"{algorithm}-{check.__name__}",
        )
        for algorithm in ALGORITHMS
        for check in ALGORITHM_CONTRACT
    ],
)
def test_the_contract_holds(check, algorithm, tmp_path):
    settings = OFF_POLICY if algorithm in ("ddpg", "td3", "sac") else ON_POLICY
    if algorithm == "reppo":
        settings = settings | {"env": "Pendulum-v1"}
    minibatch = {
        "reppo": "minibatch_size",
        "ppo": "minibatch_size",
        "trpo": "critic_minibatch_size",
        "reinforce": "critic_minibatch_size",
    }
    settings = settings | ({minibatch[algorithm]: 64} if algorithm in minibatch else {})
    check(algorithm, tmp_path, **settings, checkpoint_every=settings["total_steps"] // 4, evaluate_episodes=2)
