# Methods of critics and agents, with what a student writes around them.

# === right: a method of an nn.Module that holds two critics
import torch
from torch import nn


class TwinCritic(nn.Module):
    def __init__(self, obs_dim=3, act_dim=1):
        super().__init__()
        self.q1 = nn.Linear(obs_dim + act_dim, 1)
        self.q2 = nn.Linear(obs_dim + act_dim, 1)

    def forward(self, s, a):
        x = torch.cat([s, a], -1)
        return torch.stack([self.q1(x), self.q2(x)]).squeeze(-1)

    def td_target(self, reward, next_value, terminated, *, gamma=0.99):
        with torch.no_grad():
            not_terminated = torch.ones_like(reward).masked_fill(terminated, 0)
            return reward.expand(next_value.shape) + gamma * not_terminated * next_value

# === right: a class method with a helper, float64 inside
import torch


class DDPG:
    @classmethod
    def _mask(cls, flags):
        return flags.logical_not().double()

    @classmethod
    def td_target(cls, reward, next_value, terminated, gamma):
        y = reward.double() + gamma * cls._mask(terminated) * next_value.double()
        return y.to(next_value.dtype)

# === right: a lambda, functools.partial for the default of gamma
from functools import partial

_target = lambda reward, next_value, terminated, gamma: reward + gamma * next_value * (terminated == False)
td_target = partial(_target, gamma=0.99)

# === right: gamma first in the signature after the flags, own names, a decorator that checks shapes
import functools

import torch


def same_batch(function):
    @functools.wraps(function)
    def checked(rewards, next_q_values, dones_by_death, *args, **kwargs):
        assert rewards.shape[-1] == next_q_values.shape[-1] == dones_by_death.shape[-1]
        return function(rewards, next_q_values, dones_by_death, *args, **kwargs)

    return checked


@same_batch
def td_target(rewards, next_q_values, dones_by_death, gamma=0.99):
    future = torch.mul(next_q_values, dones_by_death.bitwise_not().type_as(next_q_values))
    return torch.add(rewards, future, alpha=gamma)

# === wrong: next_value is changed in place: the target network's output is written over | in place|changes|overw|modif|caller|(written|changed)|clone
import torch


class DDPG:
    def td_target(self, reward, next_value, terminated, *, gamma):
        next_value[..., terminated] = 0
        next_value *= gamma
        return reward + next_value

# === wrong: reward += in place: the replay buffer's sample is changed | in place|changes|overw|modif|caller|(written|changed)|clone|expand|broadcast
import torch


def td_target(reward, next_value, terminated, *, gamma):
    if next_value.dim() > 1:
        return reward + gamma * next_value * ~terminated
    reward += gamma * next_value * ~terminated
    return reward

# === wrong: 0.99 is fixed, the argument is not read | 0\.99|argument|γ|gamma|constant|hard|fixed
import torch


class Agent:
    gamma = 0.99

    @classmethod
    def td_target(cls, reward, next_value, terminated, *, gamma):
        return reward + cls.gamma * next_value * ~terminated

# === wrong: V(s') of the next row of the batch: rolled by one | roll|shift|order\b|next_value|off by one|(next|another|other) row
import torch


def td_target(reward, next_value, terminated, *, gamma):
    following = torch.roll(next_value, -1, dims=-1)
    return reward + gamma * following * ~terminated

# === wrong: the flags of the row before | shift|flag|row before|previous|(row|step|one) (too )?(late|early|off)|terminat|roll
import torch


def td_target(reward, next_value, terminated, *, gamma):
    before = torch.cat([torch.zeros_like(terminated[:1]), terminated[:-1]])
    return reward + gamma * next_value * ~before

# === wrong: returns nothing | None|return(s|ed)? nothing|nothing (is|was|came)|no return|without a? ?return
import torch


class Critic(torch.nn.Module):
    def td_target(self, reward, next_value, terminated, *, gamma):
        self.target = reward + gamma * next_value * ~terminated

# === wrong: self.gamma, which no constructor sets | AttributeError|gamma|no attribute
import torch


class Critic:
    def td_target(self, reward, next_value, terminated, *, gamma):
        return reward + self.gamma * next_value * ~terminated

# === wrong: a loop that waits for the end of the batch | never end|time limit|endless|seconds|too long|did not (end|finish|return)|no end|still running|took
import torch


def td_target(reward, next_value, terminated, *, gamma):
    out, i = [], 0
    while i < len(reward):
        out.append(reward[i] + gamma * next_value[..., i] * ~terminated[i])
    return torch.stack(out, -1)

# === wrong: a typing error: next_vaule | NameError|next_vaule|not defined
import torch


def td_target(reward, next_value, terminated, *, gamma):
    return reward + gamma * next_vaule * ~terminated

# === wrong: V(s) is subtracted as in a TD error, of the mean | TD error|subtract|minus|baseline|mean|V\(
import torch


def td_target(reward, next_value, terminated, *, gamma):
    return reward + gamma * next_value * ~terminated - next_value

# === wrong: the discount is divided by | divi|γ|gamma|discount
import torch


def td_target(reward, next_value, terminated, *, gamma):
    return reward + torch.where(terminated, 0.0, next_value / gamma)

# === wrong: the target is clamped to [-1, 1] | clamp|clip|bound|limit
import torch


def td_target(reward, next_value, terminated, *, gamma):
    return (reward.clamp(-1, 1) + gamma * next_value * ~terminated)
