"""The zoo's solutions of the exercises around the loop, judged by tests of our own: the right pass, the wrong fail.

The course's checker has no part in this: it is what says that a solution of the zoo is what its title claims.
"""

import functools
import random
import tempfile
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector.utils import batch_space
from gymnasium.wrappers.vector import NormalizeObservation as GymNormalizeObservation

import lemniscate as lem
from lemniscate.envs.vector_view import NormalizeObservation
from zoo_files import ZOO, Solution, execute, find, load

LOW, HIGH = np.float32([-1, 0, -3]), np.float32([3, 1, 5])

pytestmark = pytest.mark.long  # of the zoo itself, which the quick suite takes as it is


def spaces_of(num_envs=1):
    """What a network is told of the environments: 4 observations, 3 actions in bounds that are not symmetric."""
    one = gym.spaces.Box(-np.inf, np.inf, (4,), np.float32), gym.spaces.Box(LOW, HIGH)
    many = (batch_space(space, num_envs) for space in one)
    names = ("single_observation_space", "single_action_space", "observation_space", "action_space")
    return SimpleNamespace(num_envs=num_envs, **dict(zip(names, (*one, *many), strict=True)))


def close(a, b, tolerance=1e-4):
    a, b = torch.as_tensor(a).detach().double(), torch.as_tensor(b).detach().double()
    assert a.shape == b.shape, (a.shape, b.shape)
    assert torch.allclose(a, b, atol=tolerance, rtol=tolerance), (a, b)


def depends(output, module):
    """The names of the parameters that an output depends on."""
    names, parameters = zip(*((n, p) for n, p in module.named_parameters() if p.requires_grad), strict=True)
    gradients = torch.autograd.grad(output, parameters, allow_unused=True)
    return {n for n, g in zip(names, gradients, strict=True) if g is not None}


def nonlinear(function, *inputs):
    """A map that is affine has no second difference: it is compared with the first."""
    first, second = ([3 * torch.randn_like(x) for x in inputs] for _ in range(2))
    middle = [(a + b) / 2 for a, b in zip(first, second, strict=True)]
    a, b, c = function(*first), function(*second), function(*middle)
    return (a + b - 2 * c).abs().max() > 1e-2 * (a - b).abs().max()


def agent_oracle(cls):
    agent, x = cls(spaces_of(8)), torch.randn(6, 4)
    value = agent.value(x)
    assert value.numel() == 6
    action, log_prob, entropy, again = agent.action_and_value(x)
    assert action.shape == (6, 3)
    close(value.flatten(), again.flatten())
    mean = agent.action_and_value(x, deterministic=True)[0].detach()
    close(mean, agent.action_and_value(x, None, True)[0])
    free = [name for name, p in agent.named_parameters() if p.numel() == 3 and not p.any()]
    gaussian = torch.distributions.Normal(torch.zeros(6, 3), 1.0)
    close(log_prob, torch.distributions.Normal(mean, 1.0).log_prob(action).sum(1))
    close(entropy, gaussian.entropy().sum(1))
    many = agent.action_and_value(x.repeat(1000, 1))[0].detach() - mean.repeat(1000, 1)
    assert abs(many.mean()) < 0.05, many.mean()
    assert abs(many.std() - 1) < 0.05, many.std()
    given = torch.randn(6, 3)
    same, log_prob, _, _ = agent.action_and_value(x, given)
    close(same, given)
    actor, critic = depends(log_prob.sum(), agent), depends(agent.value(x).sum(), agent)
    assert not actor & critic, "they share parameters"
    sigma = depends(agent.action_and_value(x)[2].sum(), agent)
    assert len(sigma) == 1, sigma
    assert sigma <= set(free) & actor
    weights = dict(agent.named_parameters())
    for names, last in ((actor - sigma, 0.01), (critic, 1.0)):
        matrices = [weights[n] for n, p in agent.named_parameters() if n in names and p.dim() == 2]
        assert len(matrices) >= 3
        for matrix in matrices:
            gain = last if matrix is matrices[-1] else 2**0.5
            close(torch.linalg.svdvals(matrix), torch.full((min(matrix.shape),), gain))
        assert not any(weights[n].any() for n in names if n.endswith("bias"))
    with torch.no_grad():
        weights[next(iter(sigma))].add_(torch.tensor([0.5, -0.7, 0.4]).reshape(weights[next(iter(sigma))].shape))
        matrices[-1].mul_(50)  # the critic's: a value is not bounded
    std = torch.tensor([0.5, -0.7, 0.4]).exp()
    close(agent.action_and_value(x, given)[1], torch.distributions.Normal(mean, std).log_prob(given).sum(1))
    close(agent.action_and_value(x)[2], torch.distributions.Normal(mean, std).entropy().sum(1))
    assert agent.value(100 * x).abs().max() > 2
    assert nonlinear(lambda x: agent.action_and_value(x, deterministic=True)[0], x)


def actor_oracle(cls):
    torch.manual_seed(0)
    actor, x = cls(spaces_of()), torch.randn(500, 4)
    close(actor(x), actor(x))
    assert actor(x).shape == (500, 3)
    assert all(p.grad_fn is None for p in actor.parameters())
    assert len(depends(actor(x).sum(), actor)) >= 6
    assert len([p for p in actor.parameters() if p.requires_grad and p.numel() == 3]) <= 1  # the last bias
    low, high = torch.tensor(LOW), torch.tensor(HIGH)
    bias = next(p for p in actor.parameters() if p.requires_grad and p.numel() == 3)
    for extreme, bound in ((-100.0, low), (100.0, high)):
        with torch.no_grad():
            bias.fill_(extreme)
        close(actor(x), bound.expand(500, 3))
    with torch.no_grad():
        bias.zero_()
    middle = next(p for p in actor.parameters() if p.requires_grad and p.dim() == 2 and p.shape[0] == 3)
    with torch.no_grad():
        middle.zero_()
    close(actor(x[:2]), ((low + high) / 2).expand(2, 3))
    torch.manual_seed(1)
    actor = cls(spaces_of())
    assert nonlinear(lambda x: torch.atanh(((actor(x) - low) / (high - low) * 2 - 1).clamp(-0.999999, 0.999999)), x)


def q_network_oracle(cls):
    torch.manual_seed(0)
    q, x, a = cls(spaces_of()), torch.randn(500, 4), torch.randn(500, 3)
    assert q(x, a).shape == (500, 1)
    close(q(x, a)[7:8], q(x[7:8], a[7:8]))
    a.requires_grad_()
    assert torch.autograd.grad(q(x, a).sum(), a)[0].abs().sum() > 0
    a = a.detach()
    assert (q(x, a) - q(torch.randn(500, 4), a)).abs().max() > 1e-3
    assert len(depends(q(x, a).sum(), q)) >= 4
    assert nonlinear(q, x, a)
    last = next(p for p in q.parameters() if p.numel() == 1 and p.dim() == 1)
    for much in (-100.0, 100.0):
        with torch.no_grad():
            last.fill_(much)
        assert (q(x, a) - much).abs().max() < 50


def set_seeds_oracle(set_seeds):
    drawn, cudnn = [], torch.backends.cudnn
    before = cudnn.deterministic, cudnn.benchmark
    try:
        for seed in (3, 3, 4):
            cudnn.deterministic, cudnn.benchmark = False, True
            set_seeds(seed)
            drawn.append((random.random(), np.random.rand(), torch.rand(1).item()))
            assert cudnn.deterministic is True
            assert cudnn.benchmark is False
    finally:
        cudnn.deterministic, cudnn.benchmark = before
    assert drawn[0] == drawn[1]
    assert all(a != b for a, b in zip(drawn[0], drawn[2], strict=True))
    random.seed(3), np.random.seed(3), torch.manual_seed(3)
    assert drawn[0] == (random.random(), np.random.rand(), torch.rand(1).item())


def normalizer(env):
    while not isinstance(env, GymNormalizeObservation):
        env = env.env
    return env


def make_envs_oracle(make_envs):
    train, evaluation = make_envs(3, 2, train_device="cpu")
    assert (train.num_envs, evaluation.num_envs) == (3, 2)
    assert normalizer(train) is not normalizer(evaluation)
    assert normalizer(train).update_running_mean
    assert not normalizer(evaluation).update_running_mean
    assert normalizer(train).obs_rms is not normalizer(evaluation).obs_rms
    for envs in (train, evaluation):
        obs, _ = envs.reset(seed=0)
        assert isinstance(obs, torch.Tensor)
        assert obs.shape[0] == envs.num_envs
        envs.action_space.seed(0)
        before = normalizer(envs).obs_rms.mean.copy()
        for _ in range(3):
            obs, reward, *_ = envs.step(torch.as_tensor(envs.action_space.sample()))
        assert reward.shape == (envs.num_envs,)
        assert (before == normalizer(envs).obs_rms.mean).all() == (envs is evaluation)
        envs.close()
    assert make_envs(2, 2, train_device="cpu", env_name="Pendulum-v1")[0].single_action_space.shape == (1,)


def trained(seed):
    """An agent, an optimizer that has made a step, and environments that have statistics."""
    torch.manual_seed(seed)
    agent = torch.nn.Sequential(torch.nn.Linear(4, 5), torch.nn.Tanh(), torch.nn.Linear(5, 2))
    optimizer = torch.optim.AdamW(agent.parameters(), lr=0.01 * (seed + 1))
    agent(torch.randn(7, 4)).square().sum().backward()
    optimizer.step()
    envs = gym.wrappers.vector.RecordEpisodeStatistics(NormalizeObservation(lem.make_vec("CartPole-v1", 3)))
    envs.reset(seed=seed)
    envs.action_space.seed(seed)
    for _ in range(seed + 4):
        envs.step(envs.action_space.sample())
    return agent, optimizer, envs


def leaves(thing, path=""):
    """(path, array) of all in nested containers."""
    if isinstance(thing, dict):
        return [leaf for key, part in thing.items() for leaf in leaves(part, f"{path}/{key}")]
    if isinstance(thing, list | tuple) and not all(isinstance(x, int | float) for x in thing):
        return [leaf for key, part in enumerate(thing) for leaf in leaves(part, f"{path}/{key}")]
    if isinstance(thing, torch.Tensor | np.ndarray | list | float | int):
        return [(path, np.asarray(thing, dtype=float))]
    return []


def save_model_oracle(save_model):
    agent, optimizer, envs = trained(1)
    with tempfile.TemporaryDirectory() as folder:
        save_model(agent, optimizer, envs, Path(folder) / "x.pt")
        found = leaves(torch.load(Path(folder) / "x.pt", weights_only=False))
    rms = normalizer(envs).obs_rms
    wanted = [(n, p) for n, p in agent.state_dict().items()]
    wanted += [(k, v) for entry in optimizer.state_dict()["state"].values() for k, v in entry.items()]
    wanted += [("mean", rms.mean), ("var", rms.var), ("lr", optimizer.param_groups[0]["lr"])]
    for name, value in wanted:
        value = np.asarray(value, dtype=float)
        same = [path for path, other in found if other.shape == value.shape and np.allclose(other, value, rtol=1e-5)]
        assert any(path.endswith(name) for path in same), name


def load_model_oracle(load_model):
    agent, optimizer, envs = trained(1)
    rms = normalizer(envs).obs_rms
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "x.pt"
        parts = {"model_state_dict": agent.state_dict(), "optim_state_dict": optimizer.state_dict()}
        parts |= {f"obs_{name}": torch.as_tensor(getattr(rms, name)) for name in ("mean", "var")}
        torch.save(parts | {"obs_count": float(rms.count)}, file)
        mine, my_optimizer, my_envs = trained(2)
        load_model(mine, my_optimizer, my_envs, file)
    for a, b in zip(leaves(mine.state_dict()), leaves(agent.state_dict()), strict=True):
        close(a[1], b[1])
    for a, b in zip(leaves(my_optimizer.state_dict()), leaves(optimizer.state_dict()), strict=True):
        close(a[1], b[1])
    for name in ("mean", "var", "count"):
        close(getattr(normalizer(my_envs).obs_rms, name), getattr(rms, name))
    my_envs.step(my_envs.action_space.sample())


def sync_envs_oracle(sync_envs):
    (_, _, train), (_, _, evaluation) = trained(1), trained(2)
    rms = normalizer(train).obs_rms
    before = [np.array(x) for x in (rms.mean, rms.var, rms.count)]
    sync_envs(train, evaluation)
    for _ in range(2):
        theirs, mine = normalizer(train).obs_rms, normalizer(evaluation).obs_rms
        for old, name in zip(before, ("mean", "var", "count"), strict=True):
            close(getattr(theirs, name), old)
            if _ == 0:
                close(getattr(mine, name), old)
        normalizer(evaluation).update_running_mean = False
        evaluation.step(evaluation.action_space.sample())


def replay_oracle(cls, counts=(1, 3)):
    torch.manual_seed(0), np.random.seed(0), random.seed(0)
    for num_envs in counts:
        spaces = spaces_of(num_envs)
        buffer = cls(12, spaces.single_observation_space, spaces.single_action_space)
        array, number = np.zeros((num_envs, 4), np.float32), 0
        for _ in range(21 // num_envs):
            ids = np.arange(number, number + num_envs, dtype=np.float32) + 0.25
            array[:] = ids[:, None]
            next_obs, actions = array + 1000, np.repeat(ids[:, None] + 2000, 3, axis=1)
            buffer.add(array, next_obs, actions, ids * 3, (ids - 0.25) % 2 == 0, {})
            array[:] = next_obs[:] = actions[:] = -7
            number += num_envs
            sample = buffer.sample(600)
            rows = sample.observations[:, 0]
            assert sample.observations.shape == sample.next_observations.shape == (600, 4)
            assert sample.actions.shape == (600, 3)
            kept = [i + 0.25 for i in range(max(0, number - 12), number)]
            assert sorted(set(rows.tolist())) == kept
            close(sample.next_observations, (rows + 1000)[:, None].expand(600, 4))
            close(sample.actions, (rows + 2000)[:, None].expand(600, 3))
            close(sample.rewards.flatten(), rows * 3)
            close(sample.dones.flatten(), ((rows - 0.25) % 2 == 0).float())
        assert len(buffer.sample(5).rewards) == 5


def add_to_replay_oracle(add_to_replay):
    class Replay:
        def __init__(self):
            self.rows = []

        def add(self, obs, next_obs, action, reward, done, infos):
            self.rows.append((obs, next_obs, action, reward, done))

    generator = np.random.default_rng(0)
    for case in ("none", "two"):
        obs, next_obs, actions = (generator.normal(size=(5, n)).astype(np.float32) for n in (4, 4, 3))
        rewards, dead, late = generator.normal(size=5).astype(np.float32), np.zeros(5, bool), np.zeros(5, bool)
        infos, true = {}, next_obs.copy()
        if case == "two":
            dead[0] = late[2] = late[3] = True
            infos = {"final_obs": np.full(5, None, dtype=object), "_final_obs": dead | late}
            for i in (0, 2, 3):
                true[i] = infos["final_obs"][i] = generator.normal(size=4).astype(np.float32)
        inputs = [x.copy() for x in (obs, next_obs, actions, rewards)]
        rb = Replay()
        add_to_replay(rb, obs, actions, next_obs, rewards, dead, late, infos)
        ((a, b, c, d, e),) = rb.rows
        true[dead] = b[dead]  # of a death nothing is bootstrapped
        for mine, right in zip((a, b, c, d, e), (inputs[0], true, inputs[2], inputs[3], dead), strict=True):
            close(np.asarray(mine, dtype=np.float32), np.asarray(right, dtype=np.float32))
        close(next_obs, inputs[1])


ORACLES = {
    "Agent": agent_oracle,
    "Actor": actor_oracle,
    "QNetwork": q_network_oracle,
    "set_seeds": set_seeds_oracle,
    "make_envs": make_envs_oracle,
    "save_model": save_model_oracle,
    "load_model": load_model_oracle,
    "sync_envs": sync_envs_oracle,
    "ReplayBuffer": replay_oracle,
    "add_to_replay": add_to_replay_oracle,
}
BLOCKS = [
    (p.name.split(".")[0], *b) for p in sorted(ZOO.glob("*.py")) for b in load(p) if p.name.split(".")[0] in ORACLES
]


def oracle_of(exercise, code):
    if exercise == "ReplayBuffer" and "One environment" in code:
        return functools.partial(replay_oracle, counts=(1,))
    return ORACLES[exercise]


@pytest.mark.parametrize(
    ("exercise", "kind", "title", "regex", "code", "name"), BLOCKS, ids=lambda x: x if len(x) < 99 else ""
)
@pytest.mark.filterwarnings("ignore")
@pytest.mark.one_in(3)
def test_a_solution_is_what_its_title_says(exercise, kind, title, regex, code, name):
    judge = oracle_of(exercise, code)
    if kind == "right":
        judge(find(execute(Solution(kind, title, regex, code, name), "zoo_of_parts"), name))
    else:
        with pytest.raises(Exception):  # noqa: B017, PT011 - whatever it is that a mistake leads to
            judge(find(execute(Solution(kind, title, regex, code, name), "zoo_of_parts"), name))
