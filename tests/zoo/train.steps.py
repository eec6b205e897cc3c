# === right: namedtuples in a list, λ-returns instead of the sum of TD errors, no normalization, cases by the sign of A
from collections import namedtuple

import gymnasium as gym
import numpy as np
import torch

Transition = namedtuple("Transition", "state action log_p reward following terminal over")


class Policy(torch.nn.Module):
    def __init__(self, states, actions, finite):
        super().__init__()
        self.finite = finite
        self.body = torch.nn.Sequential(
            torch.nn.Linear(states, 64), torch.nn.Tanh(), torch.nn.Linear(64, 64), torch.nn.Tanh()
        )
        self.mu = torch.nn.Linear(64, actions)
        torch.nn.init.orthogonal_(self.mu.weight, 0.01)
        self.log_std = torch.nn.Parameter(torch.zeros(actions)) if not finite else None

    def __call__(self, s):
        out = self.mu(self.body(s))
        if self.finite:
            return torch.distributions.Categorical(logits=out)
        return torch.distributions.Independent(torch.distributions.Normal(out, self.log_std.exp()), 1)


class Value(torch.nn.Module):
    def __init__(self, states):
        super().__init__()
        self.a, self.b, self.c = torch.nn.Linear(states, 64), torch.nn.Linear(64, 64), torch.nn.Linear(64, 1)

    def forward(self, s):
        return self.c(torch.tanh(self.b(torch.tanh(self.a(s))))).flatten(-2)


def lambda_returns(rewards, values, next_values, terminal, over, gamma, lam):
    """G_t = r + γ((1 − λ) V(s') + λ G_{t+1}), at an end with V(s') for G."""
    goal = next_values[-1]
    goals = [None] * len(rewards)
    for t in reversed(range(len(rewards))):
        goal = torch.where(over[t], next_values[t], goal)
        mixed = (1 - lam) * next_values[t] + lam * goal
        goal = rewards[t] + gamma * torch.where(terminal[t], torch.zeros_like(mixed), mixed)
        goals[t] = goal
    return torch.stack(goals)


class PPO:
    gamma, lam, eps, horizon, epochs, size = 0.98, 0.9, 0.2, 32, 10, 64

    def __init__(self, envs, seed):
        torch.manual_seed(seed)
        self.envs = envs
        space = envs.single_action_space
        finite = isinstance(space, gym.spaces.Discrete)
        n = envs.single_observation_space.shape[0]
        self.policy, self.value = Policy(n, int(space.n) if finite else space.shape[0], finite), Value(n)
        self.opt = torch.optim.Adam([*self.policy.parameters(), *self.value.parameters()], lr=1e-3)
        self.state = torch.as_tensor(envs.reset(seed=seed)[0])
        self.memory = []

    def step(self):
        with torch.no_grad():
            pi = self.policy(self.state)
            action = pi.sample()
            log_p = pi.log_prob(action)
        state, reward, term, trunc, infos = self.envs.step(action.numpy())
        following = state.copy()
        for i in np.nonzero(term | trunc)[0]:
            following[i] = infos["final_obs"][i]
        fields = (following, term, term | trunc)
        following, term, over = (torch.as_tensor(x) for x in fields)
        self.memory.append(Transition(self.state, action, log_p, torch.as_tensor(reward), following, term, over))
        self.state = torch.as_tensor(state)

    def update(self):
        batch = Transition(*(torch.stack(column) for column in zip(*self.memory)))
        self.memory.clear()
        with torch.no_grad():
            v, v2 = self.value(batch.state), self.value(batch.following)
        goals = lambda_returns(batch.reward, v, v2, batch.terminal, batch.over, self.gamma, self.lam)
        adv = goals - v
        rows = [x.reshape(-1, *x.shape[2:]) for x in (batch.state, batch.action, batch.log_p, adv, goals)]
        for _ in range(self.epochs):
            for i in torch.randperm(len(rows[0])).split(self.size):
                s, a, old, A, G = (x[i] for x in rows)
                ratio = torch.exp(self.policy(s).log_prob(a) - old)
                up, down = torch.clamp(ratio, max=1 + self.eps), torch.clamp(ratio, min=1 - self.eps)
                objective = torch.where(A >= 0, up * A, down * A)
                loss = -objective.mean() + torch.nn.functional.smooth_l1_loss(self.value(s), G)
                self.opt.zero_grad()
                loss.backward()
                torch.nn.utils.clip_grad_norm_(self.policy.parameters(), 0.5)
                torch.nn.utils.clip_grad_norm_(self.value.parameters(), 0.5)
                self.opt.step()

    @torch.no_grad()
    def act(self, obs):
        pi = self.policy(torch.as_tensor(obs))
        return (pi.probs.argmax(-1) if self.policy.finite else pi.mean).numpy()


def train(envs, total_steps, seed):
    ppo = PPO(envs, seed)
    updates = total_steps // (ppo.horizon * envs.num_envs)
    for k in range(updates):
        for g in ppo.opt.param_groups:
            g["lr"] = 1e-3 * (1 - k / updates)
        for _ in range(ppo.horizon):
            ppo.step()
        ppo.update()
    return ppo

# === wrong: the cases of the clip are exchanged: A ≥ 0 is clipped below, A < 0 above | clip|sign|swap|exchang|case|min|max
# --- instead of
                objective = torch.where(A >= 0, up * A, down * A)
# --- here
                objective = torch.where(A >= 0, down * A, up * A)

# === wrong: the memory is never cleared: old steps stay in the batch | clear|old (steps|rows|data|rollouts?)|on-policy|memory|rows|grow|stale|again
# --- instead of
        self.memory.clear()
# --- here

# === wrong: the state of the memory is that after the step | obs|state|row|align|shift
from collections import namedtuple

import gymnasium as gym
import numpy as np
import torch

Transition = namedtuple("Transition", "state action log_p reward following terminal over")


class Policy(torch.nn.Module):
    def __init__(self, states, actions, finite):
        super().__init__()
        self.finite = finite
        self.body = torch.nn.Sequential(
            torch.nn.Linear(states, 64), torch.nn.Tanh(), torch.nn.Linear(64, 64), torch.nn.Tanh()
        )
        self.mu = torch.nn.Linear(64, actions)
        torch.nn.init.orthogonal_(self.mu.weight, 0.01)
        self.log_std = torch.nn.Parameter(torch.zeros(actions)) if not finite else None

    def __call__(self, s):
        out = self.mu(self.body(s))
        if self.finite:
            return torch.distributions.Categorical(logits=out)
        return torch.distributions.Independent(torch.distributions.Normal(out, self.log_std.exp()), 1)


class Value(torch.nn.Module):
    def __init__(self, states):
        super().__init__()
        self.a, self.b, self.c = torch.nn.Linear(states, 64), torch.nn.Linear(64, 64), torch.nn.Linear(64, 1)

    def forward(self, s):
        return self.c(torch.tanh(self.b(torch.tanh(self.a(s))))).flatten(-2)


def lambda_returns(rewards, values, next_values, terminal, over, gamma, lam):
    """G_t = r + γ((1 − λ) V(s') + λ G_{t+1}), at an end with V(s') for G."""
    goal = next_values[-1]
    goals = [None] * len(rewards)
    for t in reversed(range(len(rewards))):
        goal = torch.where(over[t], next_values[t], goal)
        mixed = (1 - lam) * next_values[t] + lam * goal
        goal = rewards[t] + gamma * torch.where(terminal[t], torch.zeros_like(mixed), mixed)
        goals[t] = goal
    return torch.stack(goals)


class PPO:
    gamma, lam, eps, horizon, epochs, size = 0.98, 0.9, 0.2, 32, 10, 64

    def __init__(self, envs, seed):
        torch.manual_seed(seed)
        self.envs = envs
        space = envs.single_action_space
        finite = isinstance(space, gym.spaces.Discrete)
        n = envs.single_observation_space.shape[0]
        self.policy, self.value = Policy(n, int(space.n) if finite else space.shape[0], finite), Value(n)
        self.opt = torch.optim.Adam([*self.policy.parameters(), *self.value.parameters()], lr=1e-3)
        self.state = torch.as_tensor(envs.reset(seed=seed)[0])
        self.memory = []

    def step(self):
        with torch.no_grad():
            pi = self.policy(self.state)
            action = pi.sample()
            log_p = pi.log_prob(action)
        state, reward, term, trunc, infos = self.envs.step(action.numpy())
        following = state.copy()
        for i in np.nonzero(term | trunc)[0]:
            following[i] = infos["final_obs"][i]
        fields = (following, term, term | trunc)
        following, term, over = (torch.as_tensor(x) for x in fields)
        self.state = torch.as_tensor(state)
        self.memory.append(Transition(self.state, action, log_p, torch.as_tensor(reward), following, term, over))

    def update(self):
        batch = Transition(*(torch.stack(column) for column in zip(*self.memory)))
        self.memory.clear()
        with torch.no_grad():
            v, v2 = self.value(batch.state), self.value(batch.following)
        goals = lambda_returns(batch.reward, v, v2, batch.terminal, batch.over, self.gamma, self.lam)
        adv = goals - v
        rows = [x.reshape(-1, *x.shape[2:]) for x in (batch.state, batch.action, batch.log_p, adv, goals)]
        for _ in range(self.epochs):
            for i in torch.randperm(len(rows[0])).split(self.size):
                s, a, old, A, G = (x[i] for x in rows)
                ratio = torch.exp(self.policy(s).log_prob(a) - old)
                up, down = torch.clamp(ratio, max=1 + self.eps), torch.clamp(ratio, min=1 - self.eps)
                objective = torch.where(A >= 0, up * A, down * A)
                loss = -objective.mean() + torch.nn.functional.smooth_l1_loss(self.value(s), G)
                self.opt.zero_grad()
                loss.backward()
                torch.nn.utils.clip_grad_norm_(self.policy.parameters(), 0.5)
                torch.nn.utils.clip_grad_norm_(self.value.parameters(), 0.5)
                self.opt.step()

    @torch.no_grad()
    def act(self, obs):
        pi = self.policy(torch.as_tensor(obs))
        return (pi.probs.argmax(-1) if self.policy.finite else pi.mean).numpy()


def train(envs, total_steps, seed):
    ppo = PPO(envs, seed)
    updates = total_steps // (ppo.horizon * envs.num_envs)
    for k in range(updates):
        for g in ppo.opt.param_groups:
            g["lr"] = 1e-3 * (1 - k / updates)
        for _ in range(ppo.horizon):
            ppo.step()
        ppo.update()
    return ppo

# === wrong: the returns start at zero behind the last row | last|bootstrap|cut|rollout|row
from collections import namedtuple

import gymnasium as gym
import numpy as np
import torch

Transition = namedtuple("Transition", "state action log_p reward following terminal over")


class Policy(torch.nn.Module):
    def __init__(self, states, actions, finite):
        super().__init__()
        self.finite = finite
        self.body = torch.nn.Sequential(
            torch.nn.Linear(states, 64), torch.nn.Tanh(), torch.nn.Linear(64, 64), torch.nn.Tanh()
        )
        self.mu = torch.nn.Linear(64, actions)
        torch.nn.init.orthogonal_(self.mu.weight, 0.01)
        self.log_std = torch.nn.Parameter(torch.zeros(actions)) if not finite else None

    def __call__(self, s):
        out = self.mu(self.body(s))
        if self.finite:
            return torch.distributions.Categorical(logits=out)
        return torch.distributions.Independent(torch.distributions.Normal(out, self.log_std.exp()), 1)


class Value(torch.nn.Module):
    def __init__(self, states):
        super().__init__()
        self.a, self.b, self.c = torch.nn.Linear(states, 64), torch.nn.Linear(64, 64), torch.nn.Linear(64, 1)

    def forward(self, s):
        return self.c(torch.tanh(self.b(torch.tanh(self.a(s))))).flatten(-2)


def lambda_returns(rewards, values, next_values, terminal, over, gamma, lam):
    """G_t = r + γ((1 − λ) V(s') + λ G_{t+1}), at an end with V(s') for G."""
    goal = torch.zeros_like(next_values[-1])
    goals = [None] * len(rewards)
    for t in reversed(range(len(rewards))):
        goal = torch.where(over[t], next_values[t], goal)
        mixed = (1 - lam) * next_values[t] + lam * goal
        goal = rewards[t] + gamma * torch.where(terminal[t], torch.zeros_like(mixed), mixed)
        goals[t] = goal
    return torch.stack(goals)


class PPO:
    gamma, lam, eps, horizon, epochs, size = 0.98, 0.9, 0.2, 32, 10, 64

    def __init__(self, envs, seed):
        torch.manual_seed(seed)
        self.envs = envs
        space = envs.single_action_space
        finite = isinstance(space, gym.spaces.Discrete)
        n = envs.single_observation_space.shape[0]
        self.policy, self.value = Policy(n, int(space.n) if finite else space.shape[0], finite), Value(n)
        self.opt = torch.optim.Adam([*self.policy.parameters(), *self.value.parameters()], lr=1e-3)
        self.state = torch.as_tensor(envs.reset(seed=seed)[0])
        self.memory = []

    def step(self):
        with torch.no_grad():
            pi = self.policy(self.state)
            action = pi.sample()
            log_p = pi.log_prob(action)
        state, reward, term, trunc, infos = self.envs.step(action.numpy())
        following = state.copy()
        for i in np.nonzero(term | trunc)[0]:
            following[i] = infos["final_obs"][i]
        fields = (following, term, term | trunc)
        following, term, over = (torch.as_tensor(x) for x in fields)
        self.memory.append(Transition(self.state, action, log_p, torch.as_tensor(reward), following, term, over))
        self.state = torch.as_tensor(state)

    def update(self):
        batch = Transition(*(torch.stack(column) for column in zip(*self.memory)))
        self.memory.clear()
        with torch.no_grad():
            v, v2 = self.value(batch.state), self.value(batch.following)
        goals = lambda_returns(batch.reward, v, v2, batch.terminal, batch.over, self.gamma, self.lam)
        adv = goals - v
        rows = [x.reshape(-1, *x.shape[2:]) for x in (batch.state, batch.action, batch.log_p, adv, goals)]
        for _ in range(self.epochs):
            for i in torch.randperm(len(rows[0])).split(self.size):
                s, a, old, A, G = (x[i] for x in rows)
                ratio = torch.exp(self.policy(s).log_prob(a) - old)
                up, down = torch.clamp(ratio, max=1 + self.eps), torch.clamp(ratio, min=1 - self.eps)
                objective = torch.where(A >= 0, up * A, down * A)
                loss = -objective.mean() + torch.nn.functional.smooth_l1_loss(self.value(s), G)
                self.opt.zero_grad()
                loss.backward()
                torch.nn.utils.clip_grad_norm_(self.policy.parameters(), 0.5)
                torch.nn.utils.clip_grad_norm_(self.value.parameters(), 0.5)
                self.opt.step()

    @torch.no_grad()
    def act(self, obs):
        pi = self.policy(torch.as_tensor(obs))
        return (pi.probs.argmax(-1) if self.policy.finite else pi.mean).numpy()


def train(envs, total_steps, seed):
    ppo = PPO(envs, seed)
    updates = total_steps // (ppo.horizon * envs.num_envs)
    for k in range(updates):
        for g in ppo.opt.param_groups:
            g["lr"] = 1e-3 * (1 - k / updates)
        for _ in range(ppo.horizon):
            ppo.step()
        ppo.update()
    return ppo

# === wrong: λ-returns run through time-outs into the next episode | chain|across|next episode|runs? (on|through)|time-?out|truncat
# --- instead of
    goal = torch.zeros_like(next_values[-1])
# --- here
    goal = next_values[-1]
# --- instead of
        goal = torch.where(over[t], next_values[t], goal)
# --- here
        goal = torch.where(terminal[t], next_values[t], goal)

# === wrong: the update is never called | update|(not|never|no).*(learn|chang|mov|train|step)|unchanged
# --- instead of
    goal = torch.zeros_like(next_values[-1])
# --- here
    goal = next_values[-1]
# --- instead of
        ppo.update()
# --- here
        ppo.memory.clear()
