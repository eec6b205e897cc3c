"""Environments with known values, and the steps that many tests share."""

import sys
from functools import cache
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch

import toy
from forks import Forks
from lemniscate.algos import ppo, pqn, reinforce, reppo, sac, trpo
from lemniscate.data.replay import interact
from lemniscate.data.rollout import collect
from lemniscate.envs.gymnasium import GymnasiumBackend
from lemniscate.envs.vec_env import VecEnv
from lemniscate.spec import Box, Discrete, ObservationPart, Spec
from lemniscate.types import DrawnBatch

CPU = torch.device("cpu")
MODES = ["NEXT_STEP", "SAME_STEP", "DISABLED"]


def long(*values):
    """Values of a parameter that only `make test-long` tries."""
    return [pytest.param(value, marks=pytest.mark.long) for value in values]


ONE_MODE = ["NEXT_STEP", *long("SAME_STEP", "DISABLED")]
TESTS = Path(__file__).parent


def spec_of(action="box", observation_size=5):
    """A Spec of vectors of 5 numbers and two continuous actions, or three discrete ones."""
    actions = {"box": Box((-1.0, -1.0), (1.0, 1.0)), "discrete": Discrete(3)}
    return Spec("x", (ObservationPart((), (observation_size,)),), actions[action])


class Endless(toy.Countdown):
    """Reward 1 for ever, truncated every 4 steps, nothing to see: V = 1 / (1 − γ)."""

    def _observe(self):
        return np.ones((self.num_envs, 3), dtype=np.float32)


class Levers(toy.Countdown):
    """Countdown with a continuous action."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.single_action_space = gym.spaces.Box(-1, 1, (1,))
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, self.num_envs)


class EndlessLevers(Levers):
    """Endless with a continuous action: Q = 1 / (1 − γ)."""

    def _observe(self):
        return np.ones((self.num_envs, 3), dtype=np.float32)


class Greedy(EndlessLevers):
    """The reward is the action."""

    def _reward(self, actions):
        return actions[:, 0]


class FourNumbers(gym.Env):
    """As many numbers as CartPole observes, and continuous actions."""

    observation_space = gym.spaces.Box(-1, 1, (4,), np.float32)
    action_space = gym.spaces.Box(-2, 2, (3,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.time = 0
        return self._look(), {}

    def step(self, action):
        self.time += 1
        return self._look(), float(-np.square(action).sum()), False, self.time >= 10, {}

    def _look(self):
        return self.np_random.uniform(-1, 1, 4).astype(np.float32)


for world in (Endless, Levers, EndlessLevers, Greedy):
    gym.register(f"{world.__name__}-v0", vector_entry_point=f"helpers:{world.__name__}")


def vectorize(env, num_envs=4, **kwargs):
    """A restarted VecEnv in Gymnasium, with arguments of the environment."""
    vec = VecEnv(GymnasiumBackend(env, num_envs, CPU, kwargs=kwargs))
    vec.restart(0)
    return vec


def small(algo, env="Countdown-v0", **fields):
    """A Config of an on-policy algorithm that takes an update in a moment."""
    defaults = {"env": env, "num_envs": 4, "num_steps": 8, "total_steps": 100_000, "hidden": (16,)}
    defaults |= {"minibatch_size": 16} if algo in (ppo, pqn, reppo) else {}
    fields = {**defaults, **fields}
    if algo in (trpo, reinforce):  # one minibatch, as far as the rows go
        fields = {"critic_minibatch_size": min(128, fields["num_envs"] * fields["num_steps"]), **fields}
    return algo.Config(**fields)


def begin(algo, config, mode="DISABLED", **kwargs):
    """A new state, and its environments."""
    torch.manual_seed(0)
    vectors = {"mode": mode, **kwargs} if config.env in ("Countdown-v0", "Endless-v0", "Matching-v0") else {}
    env = vectorize(config.env, config.num_envs, **vectors)
    return algo.init(config, env.spec, CPU), env


def one_rollout(algo, **fields):
    """A Config, a new state and its first rollout, in Pendulum-v1."""
    config = small(algo, "Pendulum-v1", **fields)
    state, env = begin(algo, config)
    return config, state, collect(env, state.policy, config.num_steps, state.rng.action)


def learned_with(algo, config, state, rollout):
    """The advantages or weights of the policy's gradient steps of an update, one tensor for each call of `learn`."""
    given = []

    def record(config, state, batch, minibatches, *advantage, **flags):
        if flags.get("update_policy", True):
            given.extend(advantage or [batch.advantage[minibatches]])
        return algo.learn(config, state, batch, minibatches, *advantage, **flags)

    state.learn = record
    algo.update(config, state, rollout)
    return given


def small_off_policy(algo, env="Levers-v0", **fields):
    """A Config of an off-policy algorithm that takes an update in a moment."""
    defaults = {
        "env": env,
        "num_envs": 4,
        "total_steps": 10_000,
        "learning_starts": 40,
        "batch_size": 32,
        "hidden": (16,),
        "critic_hidden": (),
        "critic_learning_rate": 0.05,
        "tau": 0.1,
        "gamma": 0.9,
        "log_every": 10,
    }
    if algo is sac:
        defaults |= {"initial_temperature": 1e-8}  # values are known without entropy
    return algo.Config(**{**defaults, **fields})


def begin_off_policy(algo, config, mode="DISABLED", **kwargs):
    """A state whose replay buffer holds 40 steps of four environments, and these."""
    torch.manual_seed(0)
    env = vectorize(config.env, config.num_envs, mode=mode, **kwargs)
    state = algo.init(config, env.spec, CPU)
    for _ in range(40):
        play(config, state, env)
    return state, env


def with_random_targets(algo, rng, **fields):
    """Config, state and a batch of 50 rows; the target networks have nothing to do with the others."""
    config = small_off_policy(algo, critic_hidden=(8,), **fields)
    state, _ = begin_off_policy(algo, config)
    for parameter in state.targets.parameters():
        parameter.data = torch.randn(parameter.shape, generator=rng)
    return config, state, state.replay.transitions[:50]


def q_of(critics, obs, action):
    """Each Q(s, a) of `critics`, by its layers: C tensors [B]."""
    return [q.net(torch.cat([obs, action], dim=-1))[:, 0] for q in critics.members]


def half_square(value, target):
    """½ (V − y)², the mean over a batch."""
    return 0.5 * (value - target).square().mean()


def numbers(actions="box", size=24, dtype=torch.float64):
    """A batch of random numbers for the losses of `small_networks`."""
    generator = torch.Generator().manual_seed(3)
    obs, numbers = (torch.randn(size, n, generator=generator, dtype=dtype) for n in (5, 4))
    box = torch.randn(size, 2, generator=generator, dtype=dtype)
    discrete = torch.randint(3, (size,), generator=generator)
    log_prob, *others = numbers.unbind(-1)
    return DrawnBatch(obs, box if actions == "box" else discrete, *others, log_prob)


def small_networks(actions="box", dtype=torch.float64, **fields):
    """New networks for `numbers`, always the same, and a Config of PPO."""
    torch.manual_seed(0)
    fields = {"num_envs": 4, "num_steps": 6, "minibatch_size": 8, "clip_value": 0.3, "entropy_coef": 0.01, **fields}
    config = ppo.Config(hidden=(8,), normalize_observations=True, **fields)
    networks = config.networks(spec_of(actions))
    networks.policy.observe(torch.randn(50, 5))
    return networks.to(dtype), config


def loss_of(config, networks):
    """PPO's loss as a function of the value network alone."""
    return lambda value, batch: ppo.loss(config, networks, batch)


def copy_of(parameters):
    """The parameters as they are now."""
    return [parameter.detach().clone() for parameter in parameters]


def equal(before, parameters):
    """Whether each parameter is what it was, bit by bit."""
    return [torch.equal(a, b) for a, b in zip(before, parameters, strict=True)]


def slope(loss, module):
    """The gradient of a loss, as one vector."""
    gradients = torch.autograd.grad(loss, list(module.parameters()), materialize_grads=True)
    return torch.cat([gradient.flatten() for gradient in gradients])


def play(config, state, env):
    """One step of an off-policy algorithm in its environments, without an update."""
    random, noise_std = state.step < config.learning_starts, getattr(config, "noise_std", 1.0)
    policy, noise = state.networks.policy, state.action_noise
    step = interact(env, policy, state.replay, noise, state.rng.action, noise_std=noise_std, random=random)
    if bins := getattr(state.networks, "bins", None):
        state.move_bins(bins, step)
    state.step += env.num_envs


class Loop:
    """What an algorithm's `train` asks of a run, without files: `updates` rounds in `env`."""

    def __init__(self, env, updates):
        self.env, self.spec, self.updates = env, env.spec, updates

    def restore(self, state):
        return state

    def until(self, total_steps, state):
        for _ in range(self.updates):
            yield self.env

    def steps(self, count):
        return range(count)

    def log(self, state, metrics, episodes):
        self.metrics = metrics


class CompiledCalls:
    """Counts the programs that torch.compile makes and the calls of each, from its construction on."""

    def __init__(self):
        self.calls = []
        original = torch.compile

        def counted(function, **options):
            program, number = original(function, **options), len(self.calls)
            self.calls.append(0)

            def call(*args, **kwargs):
                result = program(*args, **kwargs)
                self.calls[number] += 1
                return result

            return call

        torch.compile = counted


COMPILERS = ["eager", pytest.param("inductor", marks=pytest.mark.long)]
"""of torch.compile: "eager" traces the program and calls it, in a few seconds; "inductor" makes machine code of it"""


def compile_with(compiler):
    """From here on torch.compile traces as before, but leaves the program to another compiler than its own."""
    original = torch.compile

    def compiled(function, options, **others):
        guards = {"guard_filter_fn": options["guard_filter_fn"]}
        return original(function, backend=compiler, options=guards, **others)

    if compiler != "inductor":
        torch.compile = compiled


def require_in_own_process(module, call, compiler="inductor"):
    """Run `call` of a test module in a new process: the shape checks of this one are not for the compiler."""
    folder = Path(sys.modules[module].__file__).parent
    prepare = (
        f"import sys; sys.path[:0] = {[str(folder), str(TESTS)]!r}; import helpers; helpers.compile_with({compiler!r})"
    )
    process = compilers().start(f"{prepare}; from {module.rpartition('.')[2]} import *; {call}", folder)
    said = process.communicate()[1]
    assert process.returncode == 0, said
    assert "torch.compile failed" not in said


@cache
def compilers():
    """A process with torch's compiler, and without the checks of shapes."""
    return Forks("import gymnasium, hypothesis.strategies, pytest, torch, torch._dynamo, torch._inductor.compile_fx")
