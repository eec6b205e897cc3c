# === right: the bare method with the helpers of the notebook
import torch


class PPO:
    def compute_loss(self, states, actions, advantages, critic_targets, log_probs_old):
        epsilon = self.epsilon
        log_probs = self.compute_log_probs(states, actions)
        ratio = torch.exp(log_probs - log_probs_old)
        l1 = ratio * advantages
        l2 = torch.clamp(ratio, 1 - epsilon, 1 + epsilon) * advantages
        actor_loss = -torch.min(l1, l2).mean()
        values = self.compute_values(states)
        critic_loss = ((critic_targets.detach() - values) ** 2).mean()
        return actor_loss, critic_loss

# === right: the notebook's whole class, functions and all
import numpy as np
import torch
from torch import nn


def select_at_index(x, indices):
    return x.gather(-1, indices.unsqueeze(-1)).squeeze(-1)


def sample_categorical(probs):
    return torch.multinomial(probs, 1, replacement=True).squeeze(1)


class PPO(nn.Module):

    def __init__(self, state_dim, num_actions, gamma, lmbda, epsilon, num_steps):
        super().__init__()
        self.gamma = gamma  # discount factor
        self.lmbda = lmbda
        self.epsilon = epsilon
        self.num_steps = num_steps

        # actor network
        self.actor = nn.Sequential(
            nn.Linear(state_dim, 128),
            nn.ReLU(),
            nn.Linear(128, 128),
            nn.ReLU(),
            nn.Linear(128, num_actions)
        )

        # critic network
        self.critic = nn.Sequential(
            nn.Linear(state_dim, 128),
            nn.ReLU(),
            nn.Linear(128, 128),
            nn.ReLU(),
            nn.Linear(128, 1)
        )

    def select_actions(self, states):
        scores = self.actor(states)
        probs = torch.softmax(scores, dim=1)
        actions = sample_categorical(probs)
        return actions

    def compute_log_probs(self, states, actions):
        scores = self.actor(states)
        logit_at_action = select_at_index(scores, actions)
        log_sum_exp = torch.logsumexp(scores, dim=1)
        log_probs = logit_at_action - log_sum_exp
        return log_probs

    def compute_values(self, states):
        values = self.critic(states).squeeze(-1)
        return values

    def compute_advantages(self, states, rewards, next_states, terminations):
        values = self.compute_values(states)
        next_values = self.compute_values(next_states)
        deltas = rewards + self.gamma * next_values * (~terminations) - values
        return deltas.detach(), (deltas + values).detach()

    def compute_loss(self, states, actions, advantages, critic_targets, log_probs_old):
        epsilon = self.epsilon

        r = torch.exp(self.compute_log_probs(states, actions) - log_probs_old)
        L1 = r * advantages
        L2 = torch.clamp(r, 1 - epsilon, 1 + epsilon) * advantages
        actor_loss = -torch.mean(torch.minimum(L1, L2))

        v = self.compute_values(states)
        critic_loss = torch.mean((critic_targets - v) ** 2)

        # return both losses
        return actor_loss, critic_loss

# === right: the networks themselves, Categorical, F.mse_loss
import torch
import torch.nn.functional as F
from torch.distributions import Categorical


class PPO:
    def compute_loss(self, states, actions, advantages, critic_targets, log_probs_old):
        dist = Categorical(logits=self.actor(states))
        ratio = (dist.log_prob(actions) - log_probs_old).exp()
        surr = torch.stack([ratio, ratio.clamp(1 - self.epsilon, 1 + self.epsilon)]) * advantages
        actor_loss = surr.amin(0).mean().neg()
        critic_loss = F.mse_loss(self.critic(states).squeeze(-1), critic_targets)
        return actor_loss, critic_loss

# === right: two helper methods of the own class, returned as a list
import torch
from torch import nn


class PPO(nn.Module):
    def __init__(self, state_dim, num_actions, gamma, lmbda, epsilon, num_steps):
        super().__init__()
        self.gamma, self.lmbda, self.epsilon, self.num_steps = gamma, lmbda, epsilon, num_steps
        self.actor = self._mlp(state_dim, num_actions)
        self.critic = self._mlp(state_dim, 1)

    @staticmethod
    def _mlp(n_in, n_out):
        return nn.Sequential(nn.Linear(n_in, 128), nn.ReLU(), nn.Linear(128, 128), nn.ReLU(), nn.Linear(128, n_out))

    def compute_log_probs(self, states, actions):
        return torch.log_softmax(self.actor(states), dim=-1)[torch.arange(len(actions)), actions]

    def compute_values(self, states):
        return self.critic(states)[:, 0]

    def _actor_loss(self, ratio, advantages):
        limit = torch.where(advantages > 0, 1 + self.epsilon, 1 - self.epsilon)
        return -torch.min(ratio * advantages, limit * advantages).mean()

    def _critic_loss(self, values, targets):
        error = values - targets
        return error.dot(error) / error.shape[0]

    def compute_loss(self, states, actions, advantages, critic_targets, log_probs_old):
        ratio = (self.compute_log_probs(states, actions) - log_probs_old).exp()
        return [self._actor_loss(ratio, advantages), self._critic_loss(self.compute_values(states), critic_targets)]

# === wrong: no exponential: the difference of the logarithms is taken for the ratio | exp|log.?ratio|logarithm
import torch


class PPO:
    def compute_loss(self, states, actions, advantages, critic_targets, log_probs_old):
        ratio = self.compute_log_probs(states, actions) - log_probs_old
        clipped = torch.clamp(ratio, 1 - self.epsilon, 1 + self.epsilon)
        actor_loss = -torch.min(ratio * advantages, clipped * advantages).mean()
        critic_loss = ((critic_targets - self.compute_values(states)) ** 2).mean()
        return actor_loss, critic_loss

# === wrong: the quotient of the log-probabilities | exp|quotient|divi|log.?ratio|logarithm|ratio
# --- instead of
        ratio = self.compute_log_probs(states, actions) - log_probs_old
# --- here
        ratio = self.compute_log_probs(states, actions) / log_probs_old

# === wrong: old minus new: the ratio is upside down | upside|invers|exchang|swap|old|other way|1 ?/ ?r|reciproc
# --- instead of
        ratio = self.compute_log_probs(states, actions) - log_probs_old
# --- here
        ratio = torch.exp(log_probs_old - self.compute_log_probs(states, actions))

# === wrong: the minus of the actor's loss is missing | sign|negat|minus|ascen|descen|maximi|opposite
import torch


class PPO:
    def compute_loss(self, states, actions, advantages, critic_targets, log_probs_old):
        ratio = torch.exp(self.compute_log_probs(states, actions) - log_probs_old)
        clipped = torch.clamp(ratio, 1 - self.epsilon, 1 + self.epsilon)
        actor_loss = torch.min(ratio * advantages, clipped * advantages).mean()
        critic_loss = ((critic_targets - self.compute_values(states)) ** 2).mean()
        return actor_loss, critic_loss

# === wrong: max in place of min | max|min|larger|smaller|pessimis
# --- instead of
        actor_loss = torch.min(ratio * advantages, clipped * advantages).mean()
# --- here
        actor_loss = -torch.max(ratio * advantages, clipped * advantages).mean()

# === wrong: a half in the critic's loss, which the course does not have | half|halve|½|factor|twice|times (too|as|what)|0\.5 ?[·*×]|[·*×/] ?(2|0\.5)\b|\b2 ?[·*×]
import torch


class PPO:
    def compute_loss(self, states, actions, advantages, critic_targets, log_probs_old):
        ratio = torch.exp(self.compute_log_probs(states, actions) - log_probs_old)
        clipped = torch.clamp(ratio, 1 - self.epsilon, 1 + self.epsilon)
        actor_loss = -torch.min(ratio * advantages, clipped * advantages).mean()
        critic_loss = 0.5 * ((critic_targets - self.compute_values(states)) ** 2).mean()
        return actor_loss, critic_loss

# === wrong: nothing is clipped | clip
import torch


class PPO:
    def compute_loss(self, states, actions, advantages, critic_targets, log_probs_old):
        ratio = torch.exp(self.compute_log_probs(states, actions) - log_probs_old)
        actor_loss = -(ratio * advantages).mean()
        critic_loss = ((critic_targets - self.compute_values(states)) ** 2).mean()
        return actor_loss, critic_loss

# === wrong: the clipped term alone, no minimum | min|only|unclipped|gradient
import torch


class PPO:
    def compute_loss(self, states, actions, advantages, critic_targets, log_probs_old):
        ratio = torch.exp(self.compute_log_probs(states, actions) - log_probs_old)
        actor_loss = -(torch.clamp(ratio, 1 - self.epsilon, 1 + self.epsilon) * advantages).mean()
        critic_loss = torch.nn.functional.mse_loss(self.compute_values(states), critic_targets)
        return actor_loss, critic_loss

# === wrong: the losses are returned in the other order | order|swap|exchang|other way|first
import torch


class PPO:
    def compute_loss(self, states, actions, advantages, critic_targets, log_probs_old):
        ratio = torch.exp(self.compute_log_probs(states, actions) - log_probs_old)
        clipped = torch.clamp(ratio, 1 - self.epsilon, 1 + self.epsilon)
        actor_loss = -torch.min(ratio * advantages, clipped * advantages).mean()
        critic_loss = ((critic_targets - self.compute_values(states)) ** 2).mean()
        return critic_loss, actor_loss

# === wrong: one sum of both losses is returned | two|both|tuple|pair|sum|iterate|unpack|return
# --- instead of
        return critic_loss, actor_loss
# --- here
        return actor_loss + critic_loss
