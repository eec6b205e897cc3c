# === right: the course's: two Sequentials, layer_init, Normal summed over the dimensions
import numpy as np
import torch
import torch.nn as nn
from torch.distributions.normal import Normal


def layer_init(layer, std=np.sqrt(2), bias_const=0.0):
    torch.nn.init.orthogonal_(layer.weight, std)
    torch.nn.init.constant_(layer.bias, bias_const)
    return layer


class Agent(nn.Module):
    def __init__(self, envs):
        super().__init__()
        obs_dim = np.array(envs.single_observation_space.shape).prod()
        act_dim = np.prod(envs.single_action_space.shape)
        self.critic = nn.Sequential(
            layer_init(nn.Linear(obs_dim, 64)),
            nn.Tanh(),
            layer_init(nn.Linear(64, 64)),
            nn.Tanh(),
            layer_init(nn.Linear(64, 1), std=1.0),
        )
        self.actor_mean = nn.Sequential(
            layer_init(nn.Linear(obs_dim, 64)),
            nn.Tanh(),
            layer_init(nn.Linear(64, 64)),
            nn.Tanh(),
            layer_init(nn.Linear(64, act_dim), std=0.01),
        )
        self.actor_logstd = nn.Parameter(torch.zeros(1, act_dim))

    def value(self, x):
        return self.critic(x)

    def action_and_value(self, x, action=None, deterministic=False):
        action_mean = self.actor_mean(x)
        action_std = torch.exp(self.actor_logstd.expand_as(action_mean))
        probs = Normal(action_mean, action_std)
        if action is None:
            action = action_mean if deterministic else probs.sample()
        return action, probs.log_prob(action).sum(1), probs.entropy().sum(1), self.critic(x)

# === wrong: the log-probability is not summed over the dimensions | sum|shape|log.?prob|\[B|dimension
# --- instead of
        return action, probs.log_prob(action).sum(1), probs.entropy().sum(1), self.critic(x)
# --- here
        return action, probs.log_prob(action), probs.entropy().sum(1), self.critic(x)

# === wrong: the entropy of the first dimension only | entropy
# --- instead of
        return action, probs.log_prob(action).sum(1), probs.entropy().sum(1), self.critic(x)
# --- here
        return action, probs.log_prob(action).sum(1), probs.entropy()[:, 0], self.critic(x)

# === wrong: averaged over the dimensions, not summed | sum|mean|averag|log.?prob
# --- instead of
        return action, probs.log_prob(action).sum(1), probs.entropy().sum(1), self.critic(x)
# --- here
        return action, probs.log_prob(action).mean(1), probs.entropy().mean(1), self.critic(x)

# === wrong: deterministic is ignored: it always samples | deterministic|mean|sampl|greedy|\bmode\b
# --- instead of
            action = action_mean if deterministic else probs.sample()
# --- here
            action = probs.sample()

# === wrong: the given action is ignored, another one is drawn | given|action|drawn|sampl|ignor
# --- instead of
        if action is None:
            action = action_mean if deterministic else probs.sample()
# --- here
        action = action_mean if deterministic else probs.sample()

# === wrong: √2 is missing: the hidden layers have gain 1 | gain|√ ?2|sqrt|1\.41|orthogonal|singular
# --- instead of
def layer_init(layer, std=np.sqrt(2), bias_const=0.0):
# --- here
def layer_init(layer, std=1.0, bias_const=0.0):

# === wrong: the actor's last layer has gain 1 instead of 0.01 | 0\.01|gain|last layer|actor
# --- instead of
            layer_init(nn.Linear(64, act_dim), std=0.01),
# --- here
            layer_init(nn.Linear(64, act_dim), std=1.0),

# === wrong: log σ is a constant tensor, no parameter | parameter|σ|sigma|std
# --- instead of
        self.actor_logstd = nn.Parameter(torch.zeros(1, act_dim))
# --- here
        self.actor_logstd = torch.zeros(1, act_dim)

# === wrong: σ is taken for log σ: no exponential, and it begins at 1 | exp|σ|sigma|std
# --- instead of
        self.actor_logstd = nn.Parameter(torch.zeros(1, act_dim))
# --- here
        self.actor_logstd = nn.Parameter(torch.ones(1, act_dim))
# --- instead of
        action_std = torch.exp(self.actor_logstd.expand_as(action_mean))
# --- here
        action_std = self.actor_logstd.expand_as(action_mean)

# === wrong: log σ begins at 1 | σ|sigma|std|log|zero|begin|initial
# --- instead of
        self.actor_logstd = nn.Parameter(torch.zeros(1, act_dim))
# --- here
        self.actor_logstd = nn.Parameter(torch.ones(1, act_dim))

# === wrong: the biases are not set to zero | bias
# --- instead of
    torch.nn.init.constant_(layer.bias, bias_const)
# --- here

# === wrong: the parameter's name is misspelt in the method | attribute|error|actor_log_std|name
# --- instead of
        action_std = torch.exp(self.actor_logstd.expand_as(action_mean))
# --- here
        action_std = torch.exp(self.actor_log_std.expand_as(action_mean))

# === wrong: the order of what is returned: entropy before log-probability | order|log.?prob|entropy|exchang|swap
# --- instead of
        return action, probs.log_prob(action).sum(1), probs.entropy().sum(1), self.critic(x)
# --- here
        return action, probs.entropy().sum(1), probs.log_prob(action).sum(1), self.critic(x)

# === wrong: the value is left out of what is returned | four|value|return|critic|3|tuple
# --- instead of
        return action, probs.log_prob(action).sum(1), probs.entropy().sum(1), self.critic(x)
# --- here
        return action, probs.log_prob(action).sum(1), probs.entropy().sum(1)

# === wrong: no nonlinearity between the hidden layers of the actor | linear|tanh|activation|nonlinear
import numpy as np
import torch
import torch.nn as nn
from torch.distributions.normal import Normal


def layer_init(layer, std=np.sqrt(2), bias_const=0.0):
    torch.nn.init.orthogonal_(layer.weight, std)
    torch.nn.init.constant_(layer.bias, bias_const)
    return layer


class Agent(nn.Module):
    def __init__(self, envs):
        super().__init__()
        obs_dim = np.array(envs.single_observation_space.shape).prod()
        act_dim = np.prod(envs.single_action_space.shape)
        self.critic = nn.Sequential(
            layer_init(nn.Linear(obs_dim, 64)),
            nn.Tanh(),
            layer_init(nn.Linear(64, 64)),
            nn.Tanh(),
            layer_init(nn.Linear(64, 1), std=1.0),
        )
        self.actor_mean = nn.Sequential(
            layer_init(nn.Linear(obs_dim, 64)),
            layer_init(nn.Linear(64, 64)),
            layer_init(nn.Linear(64, act_dim), std=0.01),
        )
        self.actor_logstd = nn.Parameter(torch.zeros(1, act_dim))

    def value(self, x):
        return self.critic(x)

    def action_and_value(self, x, action=None, deterministic=False):
        action_mean = self.actor_mean(x)
        action_std = torch.exp(self.actor_logstd.expand_as(action_mean))
        probs = Normal(action_mean, action_std)
        if action is None:
            action = action_mean if deterministic else probs.sample()
        return action, probs.log_prob(action).sum(1), probs.entropy().sum(1), self.critic(x)

# === wrong: the critic has as many outputs as there are actions | critic|value|output|shape|one
import numpy as np
import torch
import torch.nn as nn
from torch.distributions.normal import Normal


def layer_init(layer, std=np.sqrt(2), bias_const=0.0):
    torch.nn.init.orthogonal_(layer.weight, std)
    torch.nn.init.constant_(layer.bias, bias_const)
    return layer


class Agent(nn.Module):
    def __init__(self, envs):
        super().__init__()
        obs_dim = np.array(envs.single_observation_space.shape).prod()
        act_dim = np.prod(envs.single_action_space.shape)
        self.critic = nn.Sequential(
            layer_init(nn.Linear(obs_dim, 64)),
            nn.Tanh(),
            layer_init(nn.Linear(64, 64)),
            nn.Tanh(),
            layer_init(nn.Linear(64, act_dim), std=1.0),
        )
        self.actor_mean = nn.Sequential(
            layer_init(nn.Linear(obs_dim, 64)),
            nn.Tanh(),
            layer_init(nn.Linear(64, 64)),
            nn.Tanh(),
            layer_init(nn.Linear(64, act_dim), std=0.01),
        )
        self.actor_logstd = nn.Parameter(torch.zeros(1, act_dim))

    def value(self, x):
        return self.critic(x)

    def action_and_value(self, x, action=None, deterministic=False):
        action_mean = self.actor_mean(x)
        action_std = torch.exp(self.actor_logstd.expand_as(action_mean))
        probs = Normal(action_mean, action_std)
        if action is None:
            action = action_mean if deterministic else probs.sample()
        return action, probs.log_prob(action).sum(1), probs.entropy().sum(1), self.critic(x)

# === wrong: super().__init__() is missing | super|__init__|Module\.|error
# --- instead of
        super().__init__()
# --- here
# --- instead of
            layer_init(nn.Linear(64, act_dim), std=1.0),
# --- here
            layer_init(nn.Linear(64, 1), std=1.0),

# === wrong: the batch's observation space, so that the network is of N · O inputs | single_observation_space|shape|inputs|batch|mat
# --- instead of
        obs_dim = np.array(envs.single_observation_space.shape).prod()
# --- here
        obs_dim = np.array(envs.observation_space.shape).prod()
# --- instead of
            layer_init(nn.Linear(64, act_dim), std=1.0),
# --- here
            layer_init(nn.Linear(64, 1), std=1.0),
