# The whole class of the notebook: constructor, helpers, and the two TODOs.

# === right: the notebook's class, backwards over all rows, the chain restarts at each environment's last row
import torch
from torch import nn


def select_at_index(x, indices):
    return x.gather(-1, indices.unsqueeze(-1)).squeeze(-1)


def sample_categorical(probs):
    return torch.multinomial(probs, 1, replacement=True).squeeze(1)


class PPO(nn.Module):
    def __init__(self, state_dim, num_actions, gamma, lmbda, epsilon, num_steps):
        super().__init__()
        self.gamma = gamma
        self.lmbda = lmbda
        self.epsilon = epsilon
        self.num_steps = num_steps
        self.actor = nn.Sequential(
            nn.Linear(state_dim, 128), nn.ReLU(), nn.Linear(128, 128), nn.ReLU(), nn.Linear(128, num_actions)
        )
        self.critic = nn.Sequential(
            nn.Linear(state_dim, 128), nn.ReLU(), nn.Linear(128, 128), nn.ReLU(), nn.Linear(128, 1)
        )

    def select_actions(self, states):
        return sample_categorical(torch.softmax(self.actor(states), dim=1))

    def compute_log_probs(self, states, actions):
        scores = self.actor(states)
        return select_at_index(scores, actions) - torch.logsumexp(scores, dim=1)

    def compute_values(self, states):
        return self.critic(states).squeeze(-1)

    def compute_advantages(self, states, rewards, next_states, terminations):
        gamma = self.gamma
        lmbda = self.lmbda
        T = self.num_steps
        num_states = states.size()[0]

        values = self.compute_values(states)
        next_values = self.compute_values(next_states)
        not_done = 1.0 - terminations.float()
        deltas = rewards + gamma * next_values * not_done - values

        advantages = []
        advantage = 0.0
        for i in reversed(range(num_states)):
            if i % T == T - 1:
                advantage = 0.0
            advantage = deltas[i] + gamma * lmbda * not_done[i] * advantage
            advantages.append(advantage)
        advantages.reverse()
        advantages = torch.stack(advantages)
        critic_targets = advantages + values

        return advantages.detach(), critic_targets.detach()

    def compute_loss(self, states, actions, advantages, critic_targets, log_probs_old):
        ratios = torch.exp(self.compute_log_probs(states, actions) - log_probs_old)
        clipped = torch.clamp(ratios, 1 - self.epsilon, 1 + self.epsilon)
        actor_loss = -torch.min(ratios * advantages, clipped * advantages).mean()
        critic_loss = ((critic_targets - self.compute_values(states)) ** 2).mean()
        return actor_loss, critic_loss

# === right: one loop over environments, one over steps, slices i*T:(i+1)*T
import torch
from torch import nn


class PPO(nn.Module):
    def __init__(self, state_dim, num_actions, gamma, lmbda, epsilon, num_steps):
        super().__init__()
        self.gamma, self.lmbda, self.epsilon, self.num_steps = gamma, lmbda, epsilon, num_steps
        hidden = lambda out: nn.Sequential(nn.Linear(state_dim, 128), nn.ReLU(), nn.Linear(128, out))
        self.actor, self.critic = hidden(num_actions), hidden(1)

    def compute_values(self, states):
        return self.critic(states).squeeze(-1)

    def compute_advantages(self, states, rewards, next_states, terminations):
        T = self.num_steps
        N = states.size()[0] // T
        with torch.no_grad():
            v = self.compute_values(states)
            v_next = self.compute_values(next_states)
        all_advantages = []
        for i in range(N):
            env = slice(i * T, (i + 1) * T)
            env_advantages = []
            a = torch.tensor(0.0)
            for r, value, value_next, terminal in reversed(
                list(zip(rewards[env], v[env], v_next[env], terminations[env]))
            ):
                if terminal:
                    a = r - value
                else:
                    a = r + self.gamma * value_next - value + self.gamma * self.lmbda * a
                env_advantages.append(a)
            all_advantages += env_advantages[::-1]
        advantages = torch.stack(all_advantages)
        critic_targets = advantages + v
        return advantages.detach(), critic_targets.detach()

# === right: reshaped to [N, T], columns from right to left
import torch
from torch import nn


class PPO(nn.Module):
    def __init__(self, state_dim, num_actions, gamma, lmbda, epsilon, num_steps):
        super().__init__()
        self.gamma = gamma
        self.lmbda = lmbda
        self.epsilon = epsilon
        self.num_steps = num_steps
        self.critic = nn.Sequential(nn.Linear(state_dim, 64), nn.Tanh(), nn.Linear(64, 1))
        self.actor = nn.Sequential(nn.Linear(state_dim, 64), nn.Tanh(), nn.Linear(64, num_actions))

    def compute_values(self, states):
        values = self.critic(states).squeeze(-1)
        return values

    def compute_advantages(self, states, rewards, next_states, terminations):
        shape = (-1, self.num_steps)
        values = self.compute_values(states).view(shape)
        next_values = self.compute_values(next_states).view(shape)
        r, d = rewards.view(shape), terminations.view(shape)
        delta = r + self.gamma * next_values.masked_fill(d, 0.0) - values
        columns = [delta[:, -1]]
        for t in range(self.num_steps - 2, -1, -1):
            columns.insert(0, delta[:, t] + self.gamma * self.lmbda * (~d[:, t]) * columns[0])
        advantages = torch.stack(columns, dim=1)
        critic_targets = advantages + values
        return advantages.flatten().detach(), critic_targets.flatten().detach()

# === right: the maths is in a function outside of the class, detached values from the beginning
import numpy as np
import torch
from torch import nn, optim


def gae_of_one_environment(deltas, nonterminals, decay):
    result = torch.zeros_like(deltas)
    running = 0.0
    for t in range(len(deltas) - 1, -1, -1):
        running = deltas[t] + decay * nonterminals[t] * running
        result[t] = running
    return result


class PPO(nn.Module):
    def __init__(self, state_dim, num_actions, gamma, lmbda, epsilon, num_steps):
        super(PPO, self).__init__()
        self.gamma = gamma
        self.lmbda = lmbda
        self.epsilon = epsilon
        self.num_steps = num_steps
        self.critic = nn.Linear(state_dim, 1)
        self.actor = nn.Linear(state_dim, num_actions)
        self.optimizer = optim.Adam(self.parameters(), lr=1e-4)

    def compute_values(self, states):
        return self.critic(states)[:, 0]

    def compute_advantages(self, states, rewards, next_states, terminations):
        values, next_values = self.compute_values(states).detach(), self.compute_values(next_states).detach()
        nonterminals = torch.where(terminations, torch.tensor(0.0), torch.tensor(1.0))
        deltas = rewards + self.gamma * nonterminals * next_values - values
        pieces = zip(deltas.split(self.num_steps), nonterminals.split(self.num_steps))
        advantages = torch.cat([gae_of_one_environment(d, n, self.gamma * self.lmbda) for d, n in pieces])
        return advantages, advantages + values

# === wrong: the chain runs on from one environment into the next | environments\b|(next|another|other|each) environment|num_steps|\bT\b|across|restart
import torch
from torch import nn


class PPO(nn.Module):
    def __init__(self, state_dim, num_actions, gamma, lmbda, epsilon, num_steps):
        super().__init__()
        self.gamma = gamma
        self.lmbda = lmbda
        self.epsilon = epsilon
        self.num_steps = num_steps
        self.actor = nn.Sequential(nn.Linear(state_dim, 128), nn.ReLU(), nn.Linear(128, num_actions))
        self.critic = nn.Sequential(nn.Linear(state_dim, 128), nn.ReLU(), nn.Linear(128, 1))

    def compute_values(self, states):
        return self.critic(states).squeeze(-1)

    def compute_advantages(self, states, rewards, next_states, terminations):
        gamma, lmbda = self.gamma, self.lmbda
        num_states = states.size()[0]
        values = self.compute_values(states)
        next_values = self.compute_values(next_states)
        advantages = []
        advantage = 0.0
        for i in reversed(range(num_states)):
            mask = 1.0 - terminations[i].float()
            delta = rewards[i] + gamma * next_values[i] * mask - values[i]
            advantage = delta + gamma * lmbda * mask * advantage
            advantages.append(advantage)
        advantages = torch.stack(advantages[::-1])
        critic_targets = advantages + values
        return advantages.detach(), critic_targets.detach()

# === wrong: the list is not reversed in the end | revers|order\b|backward|flip
# --- instead of
        gamma, lmbda = self.gamma, self.lmbda
        num_states = states.size()[0]
# --- here
        gamma, lmbda, T = self.gamma, self.lmbda, self.num_steps
# --- instead of
        for i in reversed(range(num_states)):
# --- here
        for i in reversed(range(states.size()[0])):
            if (i + 1) % T == 0:
                advantage = 0.0
# --- instead of
        advantages = torch.stack(advantages[::-1])
# --- here
        advantages = torch.stack(advantages)

# === wrong: the chain restarts after each environment's first row, not before its last: i % T == 0 | (row|step|one) (too )?(late|early|off)|environments\b|(next|another|other|each) environment|first (row|step)|off by one|restart|last (row|step)
# --- instead of
        self.actor = nn.Sequential(nn.Linear(state_dim, 128), nn.ReLU(), nn.Linear(128, num_actions))
# --- here
# --- instead of
        gamma, lmbda = self.gamma, self.lmbda
        num_states = states.size()[0]
# --- here
        gamma, lmbda, T = self.gamma, self.lmbda, self.num_steps
# --- instead of
        for i in reversed(range(num_states)):
# --- here
        for i in reversed(range(states.size()[0])):
            if i % T == 0:
                advantage = 0.0

# === wrong: only the TD error, which passes the notebook's own test with T = 1: no chain | chain|λ|lam(bda)?\b|lmbda|trace|TD error|delta|δ|one step
import torch
from torch import nn


class PPO(nn.Module):
    def __init__(self, state_dim, num_actions, gamma, lmbda, epsilon, num_steps):
        super().__init__()
        self.gamma = gamma
        self.lmbda = lmbda
        self.epsilon = epsilon
        self.num_steps = num_steps
        self.critic = nn.Sequential(nn.Linear(state_dim, 128), nn.ReLU(), nn.Linear(128, 1))

    def compute_values(self, states):
        return self.critic(states).squeeze(-1)

    def compute_advantages(self, states, rewards, next_states, terminations):
        values = self.compute_values(states)
        next_values = self.compute_values(next_states)
        critic_targets = rewards + self.gamma * next_values * torch.logical_not(terminations)
        advantages = critic_targets - values
        return advantages.detach(), critic_targets.detach()

# === wrong: nothing is detached, gradients flow into the targets | detach|gradient|no_grad|requires_grad|stop
import torch
from torch import nn


class PPO(nn.Module):
    def __init__(self, state_dim, num_actions, gamma, lmbda, epsilon, num_steps):
        super().__init__()
        self.gamma = gamma
        self.lmbda = lmbda
        self.epsilon = epsilon
        self.num_steps = num_steps
        self.critic = nn.Sequential(nn.Linear(state_dim, 128), nn.ReLU(), nn.Linear(128, 1))

    def compute_values(self, states):
        return self.critic(states).squeeze(-1)

    def compute_advantages(self, states, rewards, next_states, terminations):
        shape = (-1, self.num_steps)
        values = self.compute_values(states).view(shape)
        next_values = self.compute_values(next_states).view(shape)
        r, d = rewards.view(shape), terminations.view(shape)
        delta = r + self.gamma * next_values * ~d - values
        columns = [delta[:, -1]]
        for t in range(self.num_steps - 2, -1, -1):
            columns.insert(0, delta[:, t] + self.gamma * self.lmbda * (~d[:, t]) * columns[0])
        advantages = torch.stack(columns, dim=1)
        critic_targets = advantages + values
        return advantages.flatten(), critic_targets.flatten()

# === wrong: the targets are not detached, the advantages are | detach|gradient|no_grad|requires_grad|stop
import torch
from torch import nn


class PPO(nn.Module):
    def __init__(self, state_dim, num_actions, gamma, lmbda, epsilon, num_steps):
        super().__init__()
        self.gamma = gamma
        self.lmbda = lmbda
        self.epsilon = epsilon
        self.num_steps = num_steps
        self.critic = nn.Sequential(nn.Linear(state_dim, 128), nn.ReLU(), nn.Linear(128, 1))

    def compute_values(self, states):
        return self.critic(states).squeeze(-1)

    def compute_advantages(self, states, rewards, next_states, terminations):
        values = self.compute_values(states)
        with torch.no_grad():
            next_values = self.compute_values(next_states)
            going = (~terminations).float()
            deltas = rewards + self.gamma * next_values * going - values
            advantages = torch.zeros_like(deltas)
            for n in range(len(states) // self.num_steps):
                a = 0.0
                for t in reversed(range(n * self.num_steps, (n + 1) * self.num_steps)):
                    a = deltas[t] + self.gamma * self.lmbda * going[t] * a
                    advantages[t] = a
        return advantages, advantages + values

# === wrong: the values are [N * T, 1], so that deltas broadcast to a square | shape|broadcast|squeeze|size|dimension
import torch
from torch import nn


class PPO(nn.Module):
    def __init__(self, state_dim, num_actions, gamma, lmbda, epsilon, num_steps):
        super().__init__()
        self.gamma = gamma
        self.lmbda = lmbda
        self.epsilon = epsilon
        self.num_steps = num_steps
        self.critic = nn.Sequential(nn.Linear(state_dim, 128), nn.ReLU(), nn.Linear(128, 1))

    def compute_values(self, states):
        return self.critic(states).squeeze(-1)

    def compute_advantages(self, states, rewards, next_states, terminations):
        values = self.critic(states)
        next_values = self.critic(next_states)
        going = 1 - terminations.int()
        deltas = rewards + self.gamma * next_values * going - values
        advantages, a = [], 0
        for i in reversed(range(len(deltas))):
            if (i + 1) % self.num_steps == 0:
                a = 0
            a = deltas[i] + self.gamma * self.lmbda * going[i] * a
            advantages.append(a)
        advantages = torch.stack(advantages[::-1])
        return advantages.detach(), (advantages + values).detach()
