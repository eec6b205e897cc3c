"""Proximal Policy Optimization in one file: Schulman et al. 2017, arXiv:1707.06347, with PyTorch and Gymnasium alone.

`python ppo_in_one_file.py` trains on CartPole-v1 in half a minute. Nothing is imported from lemniscate, whose PPO with
these settings ends in the same bits. A rollout is T steps of N environments; row t is everything that action t caused.
"""

import sys
from dataclasses import dataclass

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor, nn


@dataclass
class Config:
    """The settings, named as in `lemniscate train ppo --help`."""

    env: str = "CartPole-v1"
    seed: int = 1
    total_steps: int = 100_000
    num_envs: int = 8  # N
    num_steps: int = 128  # T
    epochs: int = 4  # passes over each rollout
    minibatch_size: int = 256  # M
    learning_rate: float = 1e-3  # at the start; it falls to zero
    gamma: float = 0.98  # discount γ
    gae_lambda: float = 0.9  # trace decay λ
    clip: float = 0.2  # ε
    value_coef: float = 0.5  # c₁
    entropy_coef: float = 0.01  # c₂
    max_grad_norm: float = 0.5


def mlp(inputs: int, outputs: int, last_gain: float) -> nn.Sequential:
    """Two hidden layers; orthogonal weights, zero biases (Andrychowicz et al. 2021, arXiv:2006.05990, section 3.2)."""
    layers: list[nn.Module] = []
    for before, after, gain in ((inputs, 64, 2**0.5), (64, 64, 2**0.5), (64, outputs, last_gain)):
        layers += [nn.Linear(before, after), nn.ReLU()]
        nn.init.orthogonal_(layers[-2].weight, gain)
        nn.init.zeros_(layers[-2].bias)
    return nn.Sequential(*layers[:-1])


class Adam:
    """Kingma & Ba 2015, arXiv:1412.6980, algorithm 1, on all parameters as one vector, with a clipped gradient."""

    def __init__(self, networks: nn.Module, max_grad_norm: float) -> None:
        self.parameters, self.max_grad_norm, self.t = list(networks.parameters()), max_grad_norm, 0
        self.vector = nn.utils.parameters_to_vector(self.parameters).detach()
        nn.utils.vector_to_parameters(self.vector, self.parameters)  # from here on they are views of the vector
        self.mean, self.square = torch.zeros_like(self.vector), torch.zeros_like(self.vector)

    def step(self, loss: Tensor, learning_rate: float) -> None:
        """One step down the loss, a scalar."""
        gradient = torch.cat([part.flatten() for part in torch.autograd.grad(loss, self.parameters)])
        gradient = gradient * (self.max_grad_norm / (gradient.square().sum().sqrt() + 1e-6)).clamp(max=1)
        self.t += 1
        self.mean.lerp_(gradient, 1 - 0.9)
        self.square.lerp_(gradient.square(), 1 - 0.999)
        step_size = learning_rate / (1 - 0.9**self.t)  # both moments began at zero, which the powers correct
        self.vector.sub_(step_size * self.mean / (self.square.sqrt() * (1 - 0.999**self.t) ** -0.5 + 1e-5))


class Environments:
    """N environments side by side. What ended is reset after its true final observation has been stored."""

    def __init__(self, env: str, num_envs: int, seed: int) -> None:
        self.envs = gym.vector.SyncVectorEnv([lambda: gym.make(env)] * num_envs, autoreset_mode="Disabled")
        # The first episodes are cut at random steps, or all would reach the time limit together.
        self.cut_in = np.random.default_rng(seed).integers(1, gym.spec(env).max_episode_steps + 1, num_envs)
        self.running, self.returns = np.zeros(num_envs), []  # of the running episodes, and of those that ended
        self.obs = torch.from_numpy(self.envs.reset(seed=seed)[0])

    @torch.no_grad()
    def collect(self, policy: nn.Module, noise: Tensor) -> list[Tensor]:
        """A rollout of obs, action, next obs, reward, terminated, done, [T, N, …], from uniform noise [T, N]."""
        rows = []
        for uniform in noise:
            cumulative = policy(self.obs).softmax(-1).cumsum(-1)
            action = (cumulative <= uniform.unsqueeze(-1) * cumulative[:, -1:]).sum(-1)  # the first with Σ π > noise
            obs, reward, terminated, truncated, _ = self.envs.step(action.numpy())
            self.cut_in -= 1
            done = terminated | truncated | (self.cut_in == 0)  # truncated or cut: the value goes on
            self.running += reward
            self.returns += self.running[done].tolist()
            self.running[done], self.cut_in[done] = 0, -1
            rows.append([self.obs, action, *map(torch.from_numpy, (obs, reward.astype(np.float32), terminated, done))])
            if done.any():
                obs, _ = self.envs.reset(options={"reset_mask": done})
            self.obs = torch.from_numpy(obs)
        return [torch.stack(column) for column in zip(*rows, strict=True)]


@torch.no_grad()
def estimate(c: Config, networks: nn.ModuleDict, rollout: list[Tensor]) -> list[Tensor]:
    """The rows [B, …] of a rollout: obs, action, log π_old(a|s), advantage and value target."""
    obs, action, next_obs, reward, terminated, done = rollout
    value = networks["value"](obs).squeeze(-1)
    other = torch.cat([done[:-1], torch.ones_like(done[-1:])])  # elsewhere the next row begins with this next obs
    next_value = value.roll(-1, 0).masked_scatter(other, networks["value"](next_obs[other]).squeeze(-1))
    delta = reward + c.gamma * next_value * ~terminated - value  # eq. 12; no value follows a termination
    advantage, trace = torch.empty_like(delta), torch.zeros_like(delta[0])
    for t in reversed(range(len(delta))):  # A_t = δ_t + γλ A_{t+1}, up to the end of the episode; eq. 11
        advantage[t] = trace = delta[t] + c.gamma * c.gae_lambda * (~done[t]).float() * trace
    log_prob = networks["policy"](obs).log_softmax(-1).gather(-1, action.unsqueeze(-1)).squeeze(-1)
    return [rows.flatten(0, 1) for rows in (obs, action, log_prob, advantage, advantage + value)]


def loss(c: Config, networks: nn.ModuleDict, rows: list[Tensor]) -> Tensor:
    """The negative of eq. 9 on a minibatch [M, …]."""
    obs, action, old_log_prob, advantage, target = rows
    std = (advantage.var(correction=0) * (len(obs) / (len(obs) - 1))).sqrt()
    weight = (advantage - advantage.mean()) / (std + 1e-8)
    logits = networks["policy"](obs)
    log_prob = logits.log_softmax(-1).gather(-1, action.unsqueeze(-1)).squeeze(-1)
    ratio = (log_prob - old_log_prob).exp()  # r_t(θ), above eq. 6
    surrogate = torch.min(ratio * weight, ratio.clamp(1 - c.clip, 1 + c.clip) * weight).mean()  # L^CLIP, eq. 7
    value_loss = 0.5 * (networks["value"](obs).squeeze(-1) - target).square().mean()  # L^VF
    log_p = logits.log_softmax(-1)
    entropy = -(log_p.exp() * log_p).sum(-1).mean()  # S
    return -surrogate + c.value_coef * value_loss - c.entropy_coef * entropy


def train(c: Config) -> nn.ModuleDict:
    """Algorithm 1: collect with π_old, take some epochs of clipped minibatch steps, repeat."""
    torch.set_num_threads(1)  # small networks gain nothing from more, and the rounding depends on their number
    torch.manual_seed(c.seed)
    keys = (0, 0), (2,), (3,)  # starts, actions and minibatches each have random numbers of their own
    start, *seeds = (int(np.random.SeedSequence(c.seed, spawn_key=key).generate_state(1)[0] >> 1) for key in keys)
    action_rng, order_rng = (torch.Generator().manual_seed(seed) for seed in seeds)
    envs = Environments(c.env, c.num_envs, start)
    inputs, num_actions = envs.obs.shape[1], int(envs.envs.single_action_space.n)
    # A small gain in the last layer: at first all actions are about equally probable.
    networks = nn.ModuleDict({"policy": mlp(inputs, num_actions, last_gain=0.01), "value": mlp(inputs, 1, last_gain=1)})
    optimizer = Adam(networks, c.max_grad_norm)
    for step in range(0, c.total_steps, c.num_envs * c.num_steps):
        rollout = envs.collect(networks["policy"], torch.rand(c.num_steps, c.num_envs, generator=action_rng))
        batch = estimate(c, networks, rollout)
        for _ in range(c.epochs):
            for rows in torch.randperm(len(batch[0]), generator=order_rng).split(c.minibatch_size):
                minibatch_loss = loss(c, networks, [column[rows] for column in batch])
                optimizer.step(minibatch_loss, c.learning_rate * (1 - step / c.total_steps))
        print(f"after {step:>7,} steps: mean return {np.mean(envs.returns[-20:] or [np.nan]):.1f} of the last episodes")
    return networks


if __name__ == "__main__":
    train(Config(total_steps=int(sys.argv[1])) if len(sys.argv) > 1 else Config())
