"""Every algorithm passes the contract that `lemniscate.testing` offers for algorithms of one's own."""

import tempfile

import pytest
import torch
from torch import nn

import lemniscate as lem
from helpers import COMPILERS, long, require_in_own_process
from lemniscate.algos import ALGORITHMS, ppo
from lemniscate.run import checkpoint
from lemniscate.testing import ALGORITHM_CONTRACT, check_learning, check_resume

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


def settings_of(algorithm):
    settings = OFF_POLICY if algorithm in ("ddpg", "td3", "sac") else ON_POLICY
    if algorithm == "reppo":
        settings = settings | {"env": "Pendulum-v1"}
    if algorithm == "shac":
        settings = settings | {"env": "Glide-v0", "backend": "own_simulator:Glide", "num_steps": 16}
    minibatch = {
        "reppo": "minibatch_size",
        "pqn": "minibatch_size",
        "ppo": "minibatch_size",
        "trpo": "critic_minibatch_size",
        "shac": "critic_minibatch_size",
        "reinforce": "critic_minibatch_size",
    }
    return settings | ({minibatch[algorithm]: 64} if algorithm in minibatch else {})


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
@pytest.mark.one_in(2)
def test_the_contract_holds(check, algorithm, tmp_path):
    settings = settings_of(algorithm)
    check(algorithm, tmp_path, **settings, checkpoint_every=settings["total_steps"] // 4, evaluate_episodes=2)


FAST = {"learning_rate": 3e-3}
FAST_Q = {
    "total_steps": 2_000,
    "actor_learning_rate": 3e-3,
    "critic_learning_rate": 3e-3,
    "tau": 0.05,
    "hidden": (32,),
    "critic_hidden": (32,),
    "batch_size": 64,
}
LEARNING = {
    "reinforce": {"total_steps": 10_000, **FAST},
    "a2c": {"total_steps": 20_000, "learning_rate": 1e-2},
    "trpo": {"total_steps": 5_000},
    "ppo": {"total_steps": 5_000},
    "reppo": {"total_steps": 10_000, "hidden": (32,), "learning_rate": 5e-3},
    "pqn": {"total_steps": 20_000, "hidden": (32,), "learning_rate": 1e-3},
    **dict.fromkeys(("ddpg", "td3", "sac"), FAST_Q),
}


def learns(algorithm, folder):
    settings = {**settings_of(algorithm), **LEARNING[algorithm]}
    check_learning(algorithm, folder, **settings, gamma=0.9, evaluate_episodes=2)


def test_what_wraps_the_environment_is_not_for_the_question(tmp_path):
    limit = ("gymnasium.wrappers:TimeLimit(max_episode_steps=3)",)
    settings = {**settings_of("ppo"), **LEARNING["ppo"], "env": "CartPole-v1", "wrappers": limit}
    settings |= {"reset_options": {"low": -0.01, "high": 0.01}, "backend": "gymnasium"}
    check_learning("ppo", str(tmp_path), **settings, gamma=0.9, evaluate_episodes=2)


@pytest.mark.parametrize("algorithm", [*long("reinforce", "trpo", "reppo", "pqn", "td3", "sac"), "a2c", "ppo", "ddpg"])
def test_every_algorithm_learns_what_is_right_and_the_value_beyond_a_cut(algorithm, tmp_path):
    learns(algorithm, tmp_path)


def opposite(surrogate):
    return lambda *args: -surrogate(*args)


def ending(estimate):
    return lambda reward, value, after, terminated, done, **rest: estimate(reward, value, after, done, done, **rest)


@pytest.mark.parametrize(
    ("name", "wrong", "said"),
    [
        ("clipped_surrogate", opposite, "The policy has learned the opposite, a return of 0 of 10: a sign is wrong."),
        ("gae", ending, "% of the value is missing: where episodes are cut off, that of the last state."),
    ],
)
def test_a_wrong_sign_and_a_missing_bootstrap_are_named(name, wrong, said, tmp_path, monkeypatch):
    monkeypatch.setattr(ppo, name, wrong(getattr(ppo, name)))
    with pytest.raises(AssertionError, match=said):
        learns("ppo", tmp_path)


class Pretrained(nn.Module):
    """A frozen encoder, whole numbers, a constant buffer and one weight in two places; it takes rows alone."""

    scale: torch.Tensor

    def __init__(self, inputs, outputs):
        super().__init__()
        self.order = nn.Parameter(torch.arange(inputs).flip(0), requires_grad=False)
        self.register_buffer("scale", torch.tensor(0.5))
        self.encoder = nn.Linear(inputs, 8).requires_grad_(False)
        self.one, self.other, self.head = nn.Linear(8, 8), nn.Linear(8, 8), nn.Linear(8, outputs)
        self.other.weight = self.one.weight

    def forward(self, x):
        if x.dim() != 2:  # an assertion that pytest rewrites cannot be compiled
            raise ValueError(x.shape)
        return self.head(self.other(torch.tanh(self.one(self.encoder(self.scale * x[:, self.order])))))


def frozen_stays(algorithm, **options):
    settings = settings_of(algorithm) | {"network": Pretrained, "progress": False, **options}
    settings |= {"shards": 2} if algorithm != "shac" else {}
    every = settings["total_steps"] // 4
    with tempfile.TemporaryDirectory() as folder:
        path = lem.train(algorithm, run=f"{folder}/r", checkpoint_every=every, **settings).path / "checkpoints"
        steps = checkpoint.list_steps(path)
        first, last = (checkpoint.read(path / f"step-{step}").tensors for step in (steps[0], steps[-1]))
    own = [name for name in first if ".module." in name]
    assert own
    for name in own:
        frozen = name.rpartition(".module.")[2] in ("order", "scale", "encoder.weight", "encoder.bias")
        assert torch.equal(first[name], last[name]) == frozen, name


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.one_in(3)
def test_in_a_network_of_ones_own_what_is_frozen_stays_and_the_rest_learns(algorithm):
    frozen_stays(algorithm, compile="off")


@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("algorithm", ["sac", *long("ppo", "trpo", "reppo", "td3")])
def test_the_same_compiled_on_two_shards(algorithm, compiler):
    """Each optimizer's descent is a program of its own: their vectors differ in length."""
    require_in_own_process(__name__, f"frozen_stays({algorithm!r}, compile='on')", compiler)


TINY = {"env": "CartPole-v1", "num_envs": 2, "num_steps": 8, "minibatch_size": 8, "hidden": (4,), "progress": False}


def test_an_algorithm_that_restores_nothing_does_not_pass(tmp_path, monkeypatch):
    def train(config, run):
        run.restore(ppo.init(config, run.spec, run.env.device))
        state = ppo.init(config, run.spec, run.env.device)
        for env in run.until(config.total_steps, state):
            rollout = ppo.collect(env, state.networks.policy, config.num_steps, state.rng.action)
            run.log(state, ppo.update(config, state, rollout), env.take_episodes())
        return state

    settings = {name: value for name, value in TINY.items() if name != "progress"} | {"total_steps": 256}
    check_resume("ppo", tmp_path / "right", **settings)
    monkeypatch.setattr(ppo, "train", train)
    with pytest.raises(AssertionError, match="begins at step 0 after a resume"):
        check_resume("ppo", tmp_path / "wrong", **settings)


def test_an_algorithm_that_counts_no_steps_or_returns_nothing_is_told(tmp_path, monkeypatch):
    right = ppo.update

    def stands(config, state, rollout):
        before, metrics = state.step, right(config, state, rollout)
        state.step = before
        return metrics

    monkeypatch.setattr(ppo, "update", stands)
    with pytest.raises(lem.UserError, match=r"An update of ppo leaves state.step as it was: add its steps to it"):
        lem.train("ppo", run=tmp_path / "a", total_steps=64, **TINY)
    monkeypatch.setattr(
        ppo, "train", lambda config, run: run.restore(ppo.init(config, run.spec, run.env.device)) and None
    )
    with pytest.raises(lem.UserError, match=r"must return the state that run.restore gave, not None"):
        lem.train("ppo", run=tmp_path / "b", total_steps=64, **TINY)
