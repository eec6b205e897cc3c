"""Golden numbers: five updates of every algorithm in float64. A change of the eighth digit shows here.

Renew them, where a change of the mathematics is meant: python tests/algos/test_golden.py
"""

import json
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from lemniscate.algos import find
from lemniscate.spec import Box, Discrete, ObservationPart, Spec
from lemniscate.types import Rollout, Transition

FILE = Path(__file__).parent / "golden.json"
CPU = torch.device("cpu")
ACTIONS = {"box": Box((-1.0, -1.0), (1.0, 1.0)), "discrete": Discrete(3)}
ON_POLICY = {
    "num_envs": 4,
    "num_steps": 8,
    "total_steps": 320,
    "hidden": (8, 8),
    "activation": "tanh",
    "gamma": 0.9,
    "normalize_observations": True,
    "scale_rewards": True,
    "seed": 3,
}
OFF_POLICY = {
    "num_envs": 2,
    "total_steps": 1000,
    "log_every": 10,
    "buffer_size": 64,
    "batch_size": 16,
    "learning_starts": 10,
    "num_updates": 2,
    "actor_learning_rate": 1e-3,
    "critic_learning_rate": 2e-3,
    "final_learning_rate": 0.5,
    "tau": 0.1,
    "gamma": 0.9,
    "hidden": (8, 8),
    "critic_hidden": (8, 8),
    "activation": "relu",
    "network": "layer_norm",
    "normalize_observations": True,
    "seed": 3,
}
VALUE = {"critic_epochs": 2, "critic_minibatch_size": 16, "critic_learning_rate": 1e-3}
WIDTH = {"initial_log_std": -0.5}
FIELDS = {
    "reinforce": {**ON_POLICY, **WIDTH, **VALUE, "learning_rate": 3e-3, "entropy_coef": 0.01},
    "a2c": {
        **ON_POLICY,
        **WIDTH,
        "learning_rate": 1e-3,
        "gae_lambda": 0.95,
        "entropy_coef": 0.01,
        "max_grad_norm": 0.5,
    },
    "trpo": {**ON_POLICY, **WIDTH, **VALUE, "max_kl": 0.01, "gae_lambda": 0.95, "final_critic_learning_rate": 0.5},
    "ppo": {
        **ON_POLICY,
        **WIDTH,
        "epochs": 2,
        "minibatch_size": 16,
        "learning_rate": 1e-3,
        "desired_kl": 0.01,
        "adam_beta2": 0.99,
        "clip_value": 0.3,
        "value_coef": 0.5,
        "entropy_coef": 0.01,
        "max_grad_norm": 0.5,
        "recompute_advantages": True,
    },
    "reppo": {
        **ON_POLICY,
        **WIDTH,
        "epochs": 2,
        "minibatch_size": 16,
        "learning_rate": 1e-3,
        "final_learning_rate": 0.5,
        "max_grad_norm": 0.5,
        "td_lambda": 0.9,
        "max_kl": 1e-4,
        "value_range": 5.0,
        "network": "layer_norm",
    },
    "pqn": {
        **ON_POLICY,
        "epochs": 2,
        "minibatch_size": 16,
        "learning_rate": 1e-3,
        "final_learning_rate": 0.5,
        "max_grad_norm": 0.5,
        "td_lambda": 0.9,
        "final_epsilon": 0.1,
        "exploration": 0.5,
        "network": "layer_norm",
    },
    "shac": {
        **ON_POLICY,
        **WIDTH,
        **VALUE,
        "actor_learning_rate": 3e-3,
        "final_learning_rate": 0.5,
        "max_grad_norm": 0.1,
        "td_lambda": 0.9,
    },
    "ddpg": {**OFF_POLICY, "policy_delay": 1},
    "td3": {**OFF_POLICY, "policy_delay": 2},
    "sac": {**OFF_POLICY, "policy_delay": 1, "initial_temperature": 0.5},
}
CASES = [f"{algorithm}-box" for algorithm in FIELDS if algorithm != "pqn"]
CASES += [f"{algorithm}-discrete" for algorithm in ("reinforce", "a2c", "trpo", "ppo", "pqn")]


@pytest.fixture(autouse=True)
def _float64():
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def rollout(actions, generator):
    """Eight steps of four environments, with terminations, truncations and ignored actions."""

    def normal(*shape):
        return torch.randn(*shape, generator=generator)

    def flags():
        return torch.rand(8, 4, generator=generator) < 0.1

    action = normal(8, 4, 2) if actions == "box" else torch.randint(3, (8, 4), generator=generator)
    terminated = flags()
    return Rollout(normal(8, 4, 3), action, normal(8, 4), normal(8, 4, 3), terminated, flags() & ~terminated, ~flags())


def through(policy, rows, generator):
    """The rows of a simulator that can be differentiated: its rewards and observations depend on what the policy does."""
    action = policy(rows.obs).sample(torch.randn(8, 4, 2, generator=generator))
    reward, next_obs = rows.reward - action.square().sum(-1), rows.next_obs + torch.nn.functional.pad(action, (0, 1))
    return replace(rows, action=action, reward=reward, next_obs=next_obs, valid=torch.ones_like(rows.valid))


def transitions(generator, size=64):
    def normal(*shape):
        return torch.randn(*shape, generator=generator)

    obs, action = normal(size, 3), torch.rand(size, 2, generator=generator) * 2 - 1
    reward, next_obs = normal(size), normal(size, 3)
    return Transition(obs, action, reward, next_obs, torch.rand(size, generator=generator) < 0.1)


def five_updates(case):
    """The metrics of each update, and the sum and the sum of squares of each parameter at the end."""
    algorithm, _, actions = case.partition("-")
    module, spec = find(algorithm), Spec("Golden-v0", (ObservationPart((), (3,)),), ACTIONS[actions], 50)
    data = torch.Generator().manual_seed(7)
    torch.manual_seed(0)
    config = module.Config(**FIELDS[algorithm])
    state = module.init(config, spec, CPU)
    off_policy = hasattr(state, "replay")
    if off_policy:
        for name, column in vars(state.replay.transitions).items():
            object.__setattr__(
                state.replay.transitions, name, column.double() if column.is_floating_point() else column
            )
        state.replay.extend(transitions(data))
        state.networks.policy.observe(state.replay.transitions.obs)
    rows = []
    for _ in range(5):
        state.step += 100 if off_policy else 0
        given = [] if off_policy else [rollout(actions, data)]
        if algorithm == "shac":
            given = [through(state.policy, *given, data)]
        metrics = module.update(config, state, *given)
        rows.append({name: float(value) for name, value in metrics.items()})
    parameters = {name: [p.sum().item(), p.square().sum().item()] for name, p in state.networks.named_parameters()}
    return {"metrics": rows, "parameters": parameters}


def flat(record):
    metrics = {f"{name} of update {k}": value for k, row in enumerate(record["metrics"]) for name, value in row.items()}
    sums = {f"{name}[{i}]": value for name, pair in record["parameters"].items() for i, value in enumerate(pair)}
    return metrics | sums


@pytest.mark.parametrize("case", CASES)
def test_five_updates_give_the_stored_numbers(case):
    stored, found = flat(json.loads(FILE.read_text())[case]), flat(five_updates(case))
    assert found.keys() == stored.keys()
    assert found == pytest.approx(stored, rel=1e-8, abs=1e-10)


if __name__ == "__main__":
    torch.set_default_dtype(torch.float64)
    torch.set_num_threads(1)
    FILE.write_text(json.dumps({case: five_updates(case) for case in CASES}, indent=1) + "\n")
    sys.exit()
