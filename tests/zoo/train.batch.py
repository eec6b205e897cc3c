# === right: a generator of rollouts, a dataclass of columns that is sliced as one, two optimizers in one minibatch
from __future__ import annotations

from dataclasses import dataclass, fields

import gymnasium as gym
import numpy as np
import torch
import torch.nn as nn


@dataclass
class Batch:
    obs: torch.Tensor
    act: torch.Tensor
    logp: torch.Tensor
    adv: torch.Tensor
    ret: torch.Tensor

    def __getitem__(self, index):
        return Batch(*(getattr(self, f.name)[index] for f in fields(self)))

    def __len__(self):
        return len(self.logp)

    def minibatches(self, size):
        index = torch.randperm(len(self))
        for i in range(0, len(self), size):
            yield self[index[i : i + size]]


class GaussianHead(nn.Module):
    def __init__(self, n):
        super().__init__()
        self.raw = nn.Parameter(torch.zeros(n))

    def forward(self, mean):
        return torch.distributions.Independent(torch.distributions.Normal(mean, self.raw.exp()), 1)


class CategoricalHead(nn.Module):
    def forward(self, logits):
        return torch.distributions.Categorical(logits=logits)


class Actor(nn.Module):
    def __init__(self, envs):
        super().__init__()
        space = envs.single_action_space
        n = space.n if hasattr(space, "n") else space.shape[0]
        self.net = nn.Sequential(nn.LazyLinear(64), nn.Tanh(), nn.LazyLinear(64), nn.Tanh(), nn.LazyLinear(n))
        self.head = CategoricalHead() if hasattr(space, "n") else GaussianHead(n)
        self.net(torch.zeros(1, *envs.single_observation_space.shape))
        nn.init.zeros_(self.net[-1].weight)
        nn.init.zeros_(self.net[-1].bias)

    def forward(self, obs):
        return self.head(self.net(obs))

    @torch.no_grad()
    def act(self, obs):
        return self(torch.as_tensor(obs, dtype=torch.float32)).mode.numpy()


def rollouts(envs, actor, critic, seed, count, T, gamma, lam):
    obs, _ = envs.reset(seed=seed)
    obs = torch.as_tensor(obs, dtype=torch.float32)
    for _ in range(count):
        keep = []
        for _ in range(T):
            with torch.no_grad():
                pi = actor(obs)
                act = pi.sample()
                nxt, rew, term, trunc, infos = envs.step(act.numpy())
                nxt = torch.as_tensor(nxt, dtype=torch.float32)
                value = critic(obs)
                bootstrap = critic(nxt)
                if trunc.any():
                    rows = np.flatnonzero(trunc)
                    finals = torch.as_tensor(np.stack([infos["final_obs"][i] for i in rows]), dtype=torch.float32)
                    bootstrap[rows] = critic(finals)
                bootstrap[torch.as_tensor(term)] = 0.0
                keep.append((obs, act, pi.log_prob(act), value, torch.as_tensor(rew), bootstrap, torch.as_tensor(term | trunc)))
            obs = nxt
        o, a, lp, v, r, v2, end = (torch.stack(x) for x in zip(*keep))
        adv = r + gamma * v2 - v
        weight = gamma * lam * (~end)
        for t in range(T - 1)[::-1]:
            adv[t] = adv[t] + weight[t] * adv[t + 1]
        yield Batch(*(x.flatten(0, 1) for x in (o, a, lp, adv, adv + v)))


def train(envs, total_steps, seed):
    torch.manual_seed(seed)
    T, eps = 32, 0.2
    actor = Actor(envs)
    critic = nn.Sequential(
        nn.Linear(envs.single_observation_space.shape[0], 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, 1), nn.Flatten(0)
    )
    opt_a, opt_c = torch.optim.Adam(actor.parameters(), 1e-3), torch.optim.Adam(critic.parameters(), 2e-3)
    count = max(1, total_steps // (T * envs.num_envs))
    decay = [torch.optim.lr_scheduler.PolynomialLR(o, total_iters=count) for o in (opt_a, opt_c)]
    for batch in rollouts(envs, actor, critic, seed, count, T, 0.98, 0.9):
        for _ in range(10):
            for mb in batch.minibatches(64):
                ratio = (actor(mb.obs).log_prob(mb.act) - mb.logp).exp()
                adv = mb.adv / (mb.adv.std() + 1e-8)
                capped = torch.clamp(ratio, 1 - eps, 1 + eps)
                loss_a = -torch.min(ratio * adv, capped * adv).mean()
                opt_a.zero_grad()
                loss_a.backward()
                nn.utils.clip_grad_norm_(actor.parameters(), 0.5)
                opt_a.step()
                loss_c = (critic(mb.obs) - mb.ret).pow(2).mean()
                opt_c.zero_grad()
                loss_c.backward()
                opt_c.step()
        for d in decay:
            d.step()
    return actor

# === wrong: the gradients of the critic are never set to zero, the actor's are | zero_grad|accumulat|add(s|ed)? up|gradient
# --- instead of
                opt_c.zero_grad()
# --- here

# === wrong: __getitem__ slices all columns but the advantages | align|index|row|shuffl|advantage|minibatch
# --- instead of
            for mb in batch.minibatches(64):
# --- here
            for mb in batch.minibatches(64):
                mb.adv = batch.adv[: len(mb)]

# === wrong: the bootstrap of a death is left in the TD error | terminat|death|bootstrap
# --- instead of
                bootstrap[torch.as_tensor(term)] = 0.0
# --- here

# === wrong: a time-out is taken for a death as well | time-?out|truncat|time limit
# --- instead of
                bootstrap[torch.as_tensor(term)] = 0.0
# --- here
                bootstrap[torch.as_tensor(term | trunc)] = 0.0

# === wrong: the clipped ratio is built from its logarithm: exp comes after the clamp | clip|exp|log.?ratio|clamp
# --- instead of
                capped = torch.clamp(ratio, 1 - eps, 1 + eps)
# --- here
                capped = torch.clamp(ratio.log(), 1 - eps, 1 + eps).exp()

# === wrong: the steps of the next rollout start from the first observation again | carr(y|ied)|reset|obs|first|stale|align|goes? on
# --- instead of
        keep = []
# --- here
        keep = []
        obs = torch.as_tensor(envs.reset(seed=seed)[0], dtype=torch.float32)

# === wrong: the observation is not moved on within the rollout: always the first one | obs|first|carr(y|ied)|same|row|stale|moved|update
# --- instead of
            obs = nxt
# --- here
        obs = nxt

# === wrong: weight of the chain is of the following step's end | one (step|row)|shift|end|align|row|following|next|off by one
# --- instead of
            adv[t] = adv[t] + weight[t] * adv[t + 1]
# --- here
            adv[t] = adv[t] + weight[t + 1] * adv[t + 1]
