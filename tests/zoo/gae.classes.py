# Classes, decorators and types: the hand of an engineer.

# === right: a static method beside its helper
import torch


class Advantages:
    @staticmethod
    def _delta(reward, value, next_value, terminated, gamma):
        return reward + gamma * next_value * (~terminated).float() - value

    @staticmethod
    def gae(reward, value, next_value, terminated, done, *, gamma=0.99, lam=0.95):
        delta = Advantages._delta(reward, value, next_value, terminated, gamma)
        advantage = delta.clone()
        for t in range(delta.size(0) - 2, -1, -1):
            advantage[t] += gamma * lam * (~done[t]) * advantage[t + 1]
        return advantage, advantage + value

# === right: a class method with a constant of the class
import torch


class Estimator:
    START = 0.0

    @classmethod
    def gae(cls, reward, value, next_value, terminated, done, gamma: float, lam: float):
        trace, rows = cls.START, []
        for r, v, w, dead, end in list(zip(reward, value, next_value, terminated, done))[::-1]:
            trace = r + gamma * w * ~dead - v + gamma * lam * trace * ~end
            rows.insert(0, trace)
        advantage = torch.stack(rows)
        return advantage, advantage + value

# === right: a method of an object with a buffer of results and helpers
import torch


class RolloutBuffer:
    def __init__(self):
        self.advantages = None
        self.returns = None

    def _mask(self, flag, like):
        return torch.ones_like(like).masked_fill_(flag, 0.0)

    def _step(self, t, deltas, decay, following):
        return deltas[t] + decay[t] * following

    def gae(self, rewards, values, next_values, terminated, done, gamma=0.99, lam=0.95):
        deltas = rewards + gamma * self._mask(terminated, next_values) * next_values - values
        decay = self._mask(done, rewards) * (gamma * lam)
        self.advantages = torch.zeros_like(rewards)
        following = torch.zeros_like(rewards[0])
        for t in reversed(range(rewards.shape[0])):
            following = self._step(t, deltas, decay, following)
            self.advantages[t] = following
        self.returns = self.advantages + values
        return self.advantages, self.returns

# === right: torch.no_grad, an optional argument more, a docstring, types
from __future__ import annotations

import torch
from torch import Tensor


@torch.no_grad()
def gae(
    reward: Tensor,
    value: Tensor,
    next_value: Tensor,
    terminated: Tensor,
    done: Tensor,
    *,
    gamma: float = 0.99,
    lam: float = 0.95,
    normalize: bool = False,
) -> tuple[Tensor, Tensor]:
    """Advantages and lambda returns, [T, N] each."""
    horizon = reward.shape[0]
    advantage: Tensor = torch.empty_like(reward)
    carry: Tensor = reward.new_zeros(reward.shape[1:])
    for t in range(horizon - 1, -1, -1):
        continues = (~done[t]).type_as(reward)
        bootstraps = (~terminated[t]).type_as(reward)
        td_error = reward[t] + gamma * bootstraps * next_value[t] - value[t]
        carry = td_error + gamma * lam * continues * carry
        advantage[t] = carry
    target = advantage + value
    if normalize:
        advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
    return advantage, target

# === right: functools.wraps and a decorator that turns the rows round and back
import functools

import torch


def backwards(function):
    @functools.wraps(function)
    def turned(*rows, **options):
        results = function(*(row.flip(0) for row in rows), **options)
        return tuple(result.flip(0) for result in results)

    return turned


@backwards
def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    advantage = torch.zeros_like(reward)
    before = torch.zeros_like(reward[0])
    for i in range(len(reward)):
        delta = reward[i] + gamma * next_value[i] * ~terminated[i] - value[i]
        before = delta + gamma * lam * before * ~done[i]
        advantage[i] = before
    return advantage, advantage + value

# === right: a lambda that is assigned to the name, functools.reduce
from functools import reduce

import torch

_rows = lambda delta, decay: reduce(
    lambda rows, t: [delta[t] + decay[t] * rows[0], *rows] if rows else [delta[t]], range(len(delta) - 1, -1, -1), []
)
_with = lambda advantage, value: (advantage, advantage + value)
gae = lambda reward, value, next_value, terminated, done, gamma=0.99, lam=0.95: _with(
    torch.stack(_rows(reward + gamma * next_value * ~terminated - value, gamma * lam * (~done).float())), value
)

# === right: a method of an nn.Module with the order of its own arguments
import torch
from torch import nn


class ActorCritic(nn.Module):
    def __init__(self, obs_dim=4, act_dim=2):
        super().__init__()
        self.actor = nn.Linear(obs_dim, act_dim)
        self.critic = nn.Linear(obs_dim, 1)

    def gae(self, rewards, values, next_values, terminated, done, gamma, lam):
        with torch.no_grad():
            not_dead, not_over = 1 - terminated.float(), 1 - done.float()
            adv = torch.zeros_like(rewards)
            gae_t = 0
            for t in reversed(range(rewards.shape[0])):
                delta = rewards[t] + gamma * next_values[t] * not_dead[t] - values[t]
                gae_t = delta + gamma * lam * not_over[t] * gae_t
                adv[t] = gae_t
        return adv, adv + values

# === right: other names, another order: values before rewards, dones before terminations
import torch


def gae(values, next_values, rewards, dones, terminations, gamma, gae_lambda):
    advantages = torch.zeros_like(rewards)
    last = torch.zeros_like(rewards[-1])
    for step in range(len(rewards) - 1, -1, -1):
        td = rewards[step] + gamma * next_values[step].masked_fill(terminations[step], 0.0) - values[step]
        last = td + gamma * gae_lambda * last.masked_fill(dones[step], 0.0)
        advantages[step] = last
    return advantages, advantages + values

# === right: a closure for each step, a NamedTuple comes back
from typing import NamedTuple

import torch


class Estimates(NamedTuple):
    advantage: torch.Tensor
    target: torch.Tensor


def make_step(gamma, lam):
    def step(carry, row):
        r, v, nxt, dead, over = row
        return r - v + gamma * torch.where(dead, 0, nxt) + gamma * lam * torch.where(over, 0, carry)

    return step


def gae(reward, value, next_value, terminated, done, *, gamma=0.99, lam=0.95):
    step = make_step(gamma, lam)
    carry, rows = torch.zeros_like(reward[0]), []
    for row in reversed(list(zip(reward, value, next_value, terminated, done))):
        carry = step(carry, row)
        rows.append(carry)
    rows.reverse()
    advantage = torch.stack(rows)
    return Estimates(advantage, advantage + value)

# === right: an inherited method, constants in a frozen dataclass that arguments override
# solution: PPO.gae
from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class Discounts:
    gamma: float = 0.99
    lam: float = 0.95


class OnPolicy:
    defaults = Discounts()

    def delta(self, reward, value, next_value, terminated, gamma):
        raise NotImplementedError

    def gae(self, reward, value, next_value, terminated, done, *, gamma=None, lam=None):
        gamma = self.defaults.gamma if gamma is None else gamma
        lam = self.defaults.lam if lam is None else lam
        delta = self.delta(reward, value, next_value, terminated, gamma)
        advantage = torch.zeros_like(delta)
        for t in reversed(range(len(delta))):
            rest = advantage[t + 1] if t + 1 < len(delta) else 0.0
            advantage[t] = delta[t] + gamma * lam * rest * ~done[t]
        return advantage, advantage + value


class PPO(OnPolicy):
    def delta(self, reward, value, next_value, terminated, gamma):
        return reward + gamma * next_value * ~terminated - value

# === wrong: delta has no - V(s) | V\(s\)|value|baseline|minus|subtract
import torch


class Advantages:
    @staticmethod
    def gae(reward, value, next_value, terminated, done, *, gamma=0.99, lam=0.95):
        delta = reward + gamma * next_value * (~terminated).float()
        advantage = delta.clone()
        for t in range(delta.size(0) - 2, -1, -1):
            advantage[t] += gamma * lam * (~done[t]) * advantage[t + 1]
        return advantage, advantage + value

# === wrong: the target is the advantage alone, without V | advantages? (alone|without)|\+ ?V|V\(s|plus (the )?values?|without (the )?(V|value)|add(s|ed)? .*(V\b|value)|target = advantages?
import torch


class Estimator:
    @classmethod
    def gae(cls, reward, value, next_value, terminated, done, gamma: float, lam: float):
        trace, rows = 0.0, []
        for r, v, w, dead, end in list(zip(reward, value, next_value, terminated, done))[::-1]:
            trace = r + gamma * w * ~dead - v + gamma * lam * trace * ~end
            rows.insert(0, trace)
        advantage = torch.stack(rows)
        return advantage, advantage.clone()

# === wrong: returns and advantages are exchanged | exchang|swap|order\b|\(advantages?, ?targets?\)|other way
import torch


@torch.no_grad()
def gae(reward, value, next_value, terminated, done, *, gamma=0.99, lam=0.95):
    advantage = torch.zeros_like(reward)
    carry = 0.0
    for t in reversed(range(len(reward))):
        carry = reward[t] + gamma * next_value[t] * ~terminated[t] - value[t] + gamma * lam * carry * ~done[t]
        advantage[t] = carry
    returns = advantage + value
    return returns, advantage

# === wrong: gamma and lambda are exchanged | λ|lam(bda)?\b|exchang|swap|γ|gamma
import torch


class RolloutBuffer:
    def _decay(self, first, second, done):
        return first * second * (~done).float()

    def gae(self, rewards, values, next_values, terminated, done, gamma=0.99, lam=0.95):
        gamma, lam = lam, gamma
        deltas = rewards + gamma * next_values * ~terminated - values
        decay = self._decay(gamma, lam, done)
        advantages = torch.zeros_like(rewards)
        following = torch.zeros_like(rewards[0])
        for t in reversed(range(rewards.shape[0])):
            following = deltas[t] + decay[t] * following
            advantages[t] = following
        return advantages, advantages + values

# === wrong: lambda stands in delta as well | λ|lam(bda)?\b
import torch
from torch import nn


class ActorCritic(nn.Module):
    def gae(self, rewards, values, next_values, terminated, done, gamma, lam):
        adv = torch.zeros_like(rewards)
        gae_t = 0
        for t in reversed(range(rewards.shape[0])):
            delta = rewards[t] + gamma * lam * next_values[t] * (1 - terminated[t].float()) - values[t]
            gae_t = delta + gamma * lam * (1 - done[t].float()) * gae_t
            adv[t] = gae_t
        return adv, adv + values

# === wrong: gamma squared in the chain | γ|gamma|squar|twice|discount
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    decay = gamma * lam
    delta = reward + gamma * next_value * ~terminated - value
    advantage = torch.zeros_like(delta)
    carry = torch.zeros_like(delta[0])
    for t in reversed(range(len(delta))):
        carry = delta[t] + gamma * decay * carry * ~done[t]
        advantage[t] = carry
    return advantage, advantage + value

# === wrong: 0.99 and 0.95 are written into the code; the arguments are not used | argument|γ|gamma|0\.99|constant|hard|fixed
import torch

GAMMA = 0.99
LAMBDA = 0.95


def gae(reward, value, next_value, terminated, done, *, gamma=GAMMA, lam=LAMBDA):
    delta = reward + GAMMA * next_value * ~terminated - value
    advantage = torch.zeros_like(delta)
    carry = torch.zeros_like(delta[0])
    for t in reversed(range(len(delta))):
        carry = delta[t] + GAMMA * LAMBDA * carry * ~done[t]
        advantage[t] = carry
    return advantage, advantage + value

# === wrong: the reward counts twice in the target | twice|double|reward
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    delta = reward + gamma * next_value * ~terminated - value
    advantage = torch.zeros_like(delta)
    carry = torch.zeros_like(delta[0])
    for t in reversed(range(len(delta))):
        carry = delta[t] + gamma * lam * carry * ~done[t]
        advantage[t] = carry
    return advantage, reward + advantage + value

# === wrong: the target adds V(s') in place of V(s) | V\(s|next_value|next value|advantages? ?(\+|plus)
# --- instead of
    return advantage, reward + advantage + value
# --- here
    return advantage, advantage + next_value

# === wrong: advantage and target are one tensor, the sum is made in place | same tensor|one tensor|in place|alias|shar|advantages? (is|are|equals?|looks?) .*(target|return)|\+ ?V|V\(s
# --- instead of
    return advantage, reward + advantage + value
# --- here
    target = advantage
    target += value
    return advantage, target

# === wrong: only the advantages come back, not the pair | pair|two|tuple|unpack|both|only one
# --- instead of
    return advantage, reward + advantage + value
# --- here
    return advantage

# === wrong: prints the result and returns nothing | None|return(s|ed)? nothing|nothing (is|was|came)|no return|without a? ?return
# --- instead of
    return advantage, reward + advantage + value
# --- here
    print(advantage, advantage + value)

# === wrong: a name that is not defined: lambd | NameError|lambd|not defined
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    delta = reward + gamma * next_value * ~terminated - value
    advantage = torch.zeros_like(delta)
    carry = torch.zeros_like(delta[0])
    for t in reversed(range(len(delta))):
        carry = delta[t] + gamma * lambd * carry * ~done[t]
        advantage[t] = carry
    return advantage, advantage + value

# === wrong: an attribute that a class never sets: self.gae_lambda | AttributeError|gae_lambda|no attribute
import torch


class Agent:
    def gae(self, reward, value, next_value, terminated, done, *, gamma, lam):
        delta = reward + gamma * next_value * ~terminated - value
        advantage = torch.zeros_like(delta)
        carry = torch.zeros_like(delta[0])
        for t in reversed(range(len(delta))):
            carry = delta[t] + gamma * self.gae_lambda * carry * ~done[t]
            advantage[t] = carry
        return advantage, advantage + value

# === wrong: next_values of the caller is changed in place by *= and += | in place|changes|caller|overw|modif|(written|changed)
import torch


def gae(rewards, values, next_values, terminated, done, gamma=0.99, lam=0.95):
    delta = next_values
    delta *= gamma * ~terminated
    delta += rewards - values
    advantage = torch.zeros_like(rewards)
    carry = torch.zeros_like(rewards[0])
    for t in reversed(range(len(rewards))):
        carry = delta[t] + gamma * lam * carry * ~done[t]
        advantage[t] = carry
    return advantage, advantage + values

# === wrong: truncated and terminated are mixed up: the bootstrap is masked where only a time-out was | time-?out|truncat|terminat|bootstrap|mask
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    truncated = done & ~terminated
    delta = reward + gamma * next_value * ~truncated - value
    advantage = torch.zeros_like(delta)
    carry = torch.zeros_like(delta[0])
    for t in reversed(range(len(delta))):
        carry = delta[t] + gamma * lam * carry * ~done[t]
        advantage[t] = carry
    return advantage, advantage + value
