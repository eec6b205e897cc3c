# === right: ModuleDict, weights by self.apply, Independent, values [B]
import math

import torch
from torch import nn
from torch.distributions import Independent, Normal


class Agent(nn.Module):
    def __init__(self, envs, hidden=(64, 64), activation=nn.Tanh):
        super().__init__()
        n_in = math.prod(envs.single_observation_space.shape)
        n_out = math.prod(envs.single_action_space.shape)
        self.nets = nn.ModuleDict({name: self.mlp(n_in, hidden, out, activation) for name, out in (("pi", n_out), ("v", 1))})
        self.log_std = nn.Parameter(torch.zeros(n_out))
        self.apply(self.init_weights)
        nn.init.orthogonal_(self.nets["pi"][-1].weight, gain=0.01)
        nn.init.orthogonal_(self.nets["v"][-1].weight, gain=1.0)

    @staticmethod
    def mlp(n, hidden, out, activation):
        layers = []
        for h in hidden:
            layers += [nn.Linear(n, h), activation()]
            n = h
        return nn.Sequential(*layers, nn.Linear(n, out))

    @staticmethod
    def init_weights(module):
        if isinstance(module, nn.Linear):
            nn.init.orthogonal_(module.weight, gain=2**0.5)
            nn.init.zeros_(module.bias)

    @property
    def std(self):
        return self.log_std.exp()

    def distribution(self, x):
        return Independent(Normal(self.nets["pi"](x), self.std), 1)

    def value(self, x):
        return self.nets["v"](x).squeeze(-1)

    def action_and_value(self, x, action=None, deterministic=False):
        pi = self.distribution(x)
        if action is None:
            action = pi.mean if deterministic else pi.sample()
        return action, pi.log_prob(action), pi.entropy(), self.value(x)

# === wrong: self.apply comes last and undoes the gains of the last layers | gain|0\.01|last layer|√ ?2|1\.41|orthogonal|singular
# --- instead of
        self.apply(self.init_weights)
# --- here
# --- instead of
        nn.init.orthogonal_(self.nets["v"][-1].weight, gain=1.0)
# --- here
        nn.init.orthogonal_(self.nets["v"][-1].weight, gain=1.0)
        self.apply(self.init_weights)

# === wrong: Xavier's instead of orthogonal weights | orthogonal|xavier|weights|gain|singular|initial
# --- instead of
            nn.init.orthogonal_(module.weight, gain=2**0.5)
# --- here
            nn.init.xavier_uniform_(module.weight)

# === wrong: the networks stand in a plain dict: they have no parameters | parameter|regist|dict|critic|optimi
# --- instead of
        self.nets = nn.ModuleDict({name: self.mlp(n_in, hidden, out, activation) for name, out in (("pi", n_out), ("v", 1))})
# --- here
        self.nets = {name: self.mlp(n_in, hidden, out, activation) for name, out in (("pi", n_out), ("v", 1))}

# === wrong: the cases are exchanged: deterministic gives a random action, else the mean | deterministic|mean|sampl|invert|swap|exchang
# --- instead of
            action = pi.mean if deterministic else pi.sample()
# --- here
            action = pi.sample() if deterministic else pi.mean

# === wrong: value takes the actor's network | value|critic|actor|shape|network
# --- instead of
        return self.nets["v"](x).squeeze(-1)
# --- here
        return self.nets["pi"](x).squeeze(-1)

# === wrong: the critic's last layer has the actor's small gain | critic|value|gain|0\.01
# --- instead of
        nn.init.orthogonal_(self.nets["v"][-1].weight, gain=1.0)
# --- here
        nn.init.orthogonal_(self.nets["v"][-1].weight, gain=0.01)
