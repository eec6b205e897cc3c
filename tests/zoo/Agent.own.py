# === right: layers as separate attributes, the Gaussian by its formula, act as an extra
import math

import torch
import torch.nn.functional as F
from torch import nn


def ortho(rows, columns, gain=math.sqrt(2)):
    layer = nn.Linear(columns, rows)
    with torch.no_grad():
        nn.init.orthogonal_(layer.weight).mul_(gain)
        layer.bias.fill_(0)
    return layer


class Agent(nn.Module):
    def __init__(self, env):
        super().__init__()
        (o,), (a,) = env.single_observation_space.shape, env.single_action_space.shape
        self.a1, self.a2, self.a3 = ortho(128, o), ortho(128, 128), ortho(a, 128, 0.01)
        self.c1, self.c2, self.c3 = ortho(128, o), ortho(128, 128), ortho(1, 128, 1)
        self.log_sigma = nn.Parameter(torch.zeros(a))

    def mean(self, s):
        return self.a3(torch.tanh(self.a2(torch.tanh(self.a1(s)))))

    def value(self, s):
        return self.c3(torch.tanh(self.c2(torch.tanh(self.c1(s)))))

    def action_and_value(self, s, action=None, deterministic=False, **_):
        mu, sigma = self.mean(s), self.log_sigma.exp()
        if action is None:
            action = mu.detach() if deterministic else (mu + sigma * torch.randn_like(mu)).detach()
        z = (action - mu) / sigma
        log_prob = -0.5 * (z.square() + math.log(2 * math.pi)).sum(-1) - self.log_sigma.sum()
        entropy = (self.log_sigma + 0.5 * math.log(2 * math.pi * math.e)).sum() * torch.ones(len(mu))
        return action, log_prob, entropy, self.value(s)

# === wrong: σ is missing in the Gaussian's normalization | σ|sigma|std|log.?prob|normali
# --- instead of
        log_prob = -0.5 * (z.square() + math.log(2 * math.pi)).sum(-1) - self.log_sigma.sum()
# --- here
        log_prob = -0.5 * (z.square() + math.log(2 * math.pi)).sum(-1)

# === wrong: the entropy lacks the e: log 2π in place of log 2πe | entropy
# --- instead of
        entropy = (self.log_sigma + 0.5 * math.log(2 * math.pi * math.e)).sum() * torch.ones(len(mu))
# --- here
        entropy = (self.log_sigma + 0.5 * math.log(2 * math.pi)).sum() * torch.ones(len(mu))

# === wrong: torch.rand for torch.randn: the noise is uniform on [0, 1) | noise|normal|gauss|sampl|mean|σ|distribut
# --- instead of
            action = mu.detach() if deterministic else (mu + sigma * torch.randn_like(mu)).detach()
# --- here
            action = mu.detach() if deterministic else (mu + sigma * torch.rand_like(mu)).detach()

# === wrong: the critic shares the actor's first two layers | shar|separate|trunk|critic
# --- instead of
        return self.c3(torch.tanh(self.c2(torch.tanh(self.c1(s)))))
# --- here
        return self.c3(torch.tanh(self.a2(torch.tanh(self.a1(s)))))

# === right: a class for both networks, deep layers in a ModuleList, MultivariateNormal
import numpy as np
import torch
from torch import nn


class MLP(nn.Module):
    def __init__(self, sizes, gain):
        super().__init__()
        self.layers = nn.ModuleList(nn.Linear(i, o) for i, o in zip(sizes[:-1], sizes[1:]))
        for k, layer in enumerate(self.layers):
            last = k == len(self.layers) - 1
            nn.init.orthogonal_(layer.weight, gain if last else nn.init.calculate_gain("relu"))
            nn.init.zeros_(layer.bias)

    def forward(self, x):
        *hidden, last = self.layers
        for layer in hidden:
            x = nn.functional.tanh(layer(x))
        return last(x)


class Agent(nn.Module):
    def __init__(self, envs, width=64, depth=3):
        super().__init__()
        o, a = int(np.prod(envs.single_observation_space.shape)), int(np.prod(envs.single_action_space.shape))
        self.actor = MLP([o] + [width] * depth + [a], 0.01)
        self.critic = MLP([o] + [width] * depth + [1], 1.0)
        self.logstd = nn.Parameter(torch.zeros(a))

    def value(self, x):
        return self.critic(x)

    def action_and_value(self, x, action=None, deterministic=False):
        dist = torch.distributions.MultivariateNormal(self.actor(x), covariance_matrix=torch.diag(self.logstd.exp() ** 2))
        if action is None and deterministic:
            action = dist.mode
        elif action is None:
            action = dist.rsample().detach()
        return action, dist.log_prob(action), dist.entropy(), self.critic(x)

# === wrong: the covariance gets σ where σ² belongs, with log σ learned | σ|sigma|std|varian|covarian|log.?prob
# --- instead of
        dist = torch.distributions.MultivariateNormal(self.actor(x), covariance_matrix=torch.diag(self.logstd.exp() ** 2))
# --- here
        dist = torch.distributions.MultivariateNormal(self.actor(x), covariance_matrix=torch.diag(self.logstd.exp()))

# === wrong: the layers are a plain list: no parameters, nothing can be trained | parameter|list|regist|optimi
# --- instead of
        self.layers = nn.ModuleList(nn.Linear(i, o) for i, o in zip(sizes[:-1], sizes[1:]))
# --- here
        self.layers = [nn.Linear(i, o) for i, o in zip(sizes[:-1], sizes[1:])]

# === wrong: torch.no_grad around the method: the log-probability has no gradient | grad|detach|graph|no_grad|parameter|depend
# --- instead of

    def action_and_value(self, x, action=None, deterministic=False):
# --- here

    @torch.no_grad()
    def action_and_value(self, x, action=None, deterministic=False):

# === right: ReLU and LayerNorm, both networks made in one loop and registered by name
import gymnasium as gym
import torch
from torch import nn
from torch.distributions import Normal


class Agent(nn.Module):
    def __init__(self, envs):
        super().__init__()
        o = gym.spaces.utils.flatdim(envs.single_observation_space)
        a = gym.spaces.utils.flatdim(envs.single_action_space)
        for name, out, gain in (("actor", a, 0.01), ("critic", 1, 1.0)):
            net = nn.Sequential(
                nn.Linear(o, 64), nn.LayerNorm(64), nn.ReLU(), nn.Linear(64, 64), nn.LayerNorm(64), nn.ReLU(), nn.Linear(64, out)
            )
            linears = [m for m in net.modules() if isinstance(m, nn.Linear)]
            for m in linears:
                nn.init.orthogonal_(m.weight, gain if m is linears[-1] else 2**0.5)
                nn.init.constant_(m.bias, 0.0)
            self.add_module(name, net)
        self.register_parameter("log_std", nn.Parameter(torch.zeros(1, a)))

    def value(self, x):
        return self.get_submodule("critic")(x)

    def action_and_value(self, x, action=None, deterministic=False):
        mean = self.actor(x)
        normal = Normal(mean, self.log_std.exp())
        if action is None:
            if deterministic:
                action = mean
            else:
                with torch.no_grad():
                    action = normal.sample()
        return action, normal.log_prob(action).sum(dim=-1), normal.entropy().sum(dim=-1).expand(mean.shape[0]), self.value(x)

# === wrong: one network for both: the loop overwrites the first | shar|separate|actor|critic|attribute|network
# --- instead of
        for name, out, gain in (("actor", a, 0.01), ("critic", 1, 1.0)):
# --- here
        for name, out, gain in (("actor", a, 0.01), ("actor", 1, 1.0)):
# --- instead of
        return self.get_submodule("critic")(x)
# --- here
        return self.actor(x)

# === right: the Gaussian head is a module of its own, weights set by the names of the parameters
import torch
import torch.nn as nn


class Head(nn.Module):
    """A diagonal Gaussian around what it is given."""

    def __init__(self, size):
        super().__init__()
        self.log_scale = nn.Parameter(torch.zeros(size))

    def forward(self, mean):
        return torch.distributions.Normal(mean, torch.ones_like(mean) * self.log_scale.exp())


class Agent(nn.Module):
    def __init__(self, envs):
        super(Agent, self).__init__()
        in_dim, out_dim = envs.single_observation_space.shape[0], envs.single_action_space.shape[0]
        self.policy = nn.Sequential(nn.Linear(in_dim, 256), nn.Tanh(), nn.Linear(256, 128), nn.Tanh(), nn.Linear(128, out_dim))
        self.valuefn = nn.Sequential(nn.Linear(in_dim, 256), nn.Tanh(), nn.Linear(256, 128), nn.Tanh(), nn.Linear(128, 1))
        self.head = Head(out_dim)
        for network, final in ((self.policy, 0.01), (self.valuefn, 1.0)):
            for name, parameter in network.named_parameters():
                if name.endswith("bias"):
                    parameter.data.zero_()
                else:
                    nn.init.orthogonal_(parameter, final if name.startswith("4") else 2**0.5)

    def value(self, obs):
        return self.valuefn(obs)[:, 0]

    def sample(self, dist, deterministic):
        return dist.mean if deterministic else dist.sample()

    def action_and_value(self, obs, action=None, deterministic=False):
        dist = self.head(self.policy(obs))
        action = self.sample(dist, deterministic) if action is None else action
        return action, dist.log_prob(action).sum(-1), dist.entropy().sum(-1), self.value(obs)

# === wrong: the sum over the batch, not over the dimensions | sum|axis|dim|shape|batch
# --- instead of
        return action, dist.log_prob(action).sum(-1), dist.entropy().sum(-1), self.value(obs)
# --- here
        return action, dist.log_prob(action).sum(0), dist.entropy().sum(0), self.value(obs)

# === wrong: a final Tanh on the value | value|tanh|bound|critic|limit
# --- instead of
        self.valuefn = nn.Sequential(nn.Linear(in_dim, 256), nn.Tanh(), nn.Linear(256, 128), nn.Tanh(), nn.Linear(128, 1))
# --- here
        self.valuefn = nn.Sequential(nn.Linear(in_dim, 256), nn.Tanh(), nn.Linear(256, 128), nn.Tanh(), nn.Linear(128, 1), nn.Tanh())

# === wrong: the log-probability is of the mean, not of the action | log.?prob|mean|action
# --- instead of
        return action, dist.log_prob(action).sum(-1), dist.entropy().sum(-1), self.value(obs)
# --- here
        return action, dist.log_prob(dist.mean).sum(-1), dist.entropy().sum(-1), self.value(obs)

# === wrong: the method is called get_action_and_value, as elsewhere | action_and_value|method|attribute|name
# --- instead of
    def action_and_value(self, obs, action=None, deterministic=False):
# --- here
    def get_action_and_value(self, obs, action=None, deterministic=False):
