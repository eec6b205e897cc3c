# === right: a callable object, an nn.Module without parameters
import torch
from torch import nn


class Reinforce(nn.Module):
    def forward(self, log_prob, weight):
        return torch.mean(torch.neg(log_prob) * weight)


policy_gradient = Reinforce()

# === right: a static method of a class of losses
# solution: Losses.policy_gradient
class Losses:
    @staticmethod
    def policy_gradient(log_prob, weight):
        return (-log_prob).mul(weight).mean()

# === right: advantages first, an extra argument for the reduction
# call: f(weight, log_prob)
import torch


def policy_gradient(advantages, log_probs, reduction="mean"):
    loss = -log_probs * advantages
    if reduction == "none":
        return loss
    return torch.mean(loss) if reduction == "mean" else torch.sum(loss)

# === right: einsum, and a decorator with wraps
import functools

import torch


def shapes_checked(function):
    @functools.wraps(function)
    def inner(log_prob, weight):
        assert log_prob.shape == weight.shape, "shapes differ"
        return function(log_prob, weight)

    return inner


@shapes_checked
def policy_gradient(log_prob, weight):
    return -torch.einsum("b,b->", log_prob, weight) / log_prob.size(0)

# === right: a lambda
policy_gradient = lambda log_prob, weight: (log_prob * weight).mean().neg()

# === right: in place on a copy of its own, with a print left in
import torch


def policy_gradient(log_prob, weight):
    loss = log_prob.clone()
    loss.mul_(weight)
    loss.neg_()
    print("policy gradient loss", loss.mean().item())
    return loss.mean()

# === right: another value with the right gradient, the value means nothing
def policy_gradient(log_prob, weight):
    ratio = (log_prob - log_prob.detach()).exp()
    return -(ratio * weight).mean()

# === wrong: the weights are normalised, which the function was not asked to | normali|standard|mean|std|deviation
def policy_gradient(log_prob, weight):
    weight = (weight - weight.mean()) / (weight.std() + 1e-8)
    return -(log_prob * weight).mean()

# === wrong: a baseline, the mean, is taken off without being asked for | mean|baseline|normali|subtract|centre|center
def policy_gradient(log_prob, weight):
    advantage = weight - weight.mean()
    return -(log_prob * advantage).mean()

# === wrong: it returns nothing | None|return|nothing
import torch


def policy_gradient(log_prob, weight):
    loss = -torch.mean(log_prob * weight)
    print(loss)

# === wrong: a float, on which backward cannot be called | no gradient|without.{0,12}gradient|gradients? .{0,40}(miss|lost|cut|stop|disabled|\bno\b|noth|detach)|detach|no_grad|requires_grad|backward|grad_fn|differentia|float|tensor|\bitem
def policy_gradient(log_prob, weight):
    return -(log_prob * weight).mean().item()

# === wrong: NumPy, which takes the gradient away | no gradient|without.{0,12}gradient|gradients? .{0,40}(miss|lost|cut|stop|disabled|\bno\b|noth|detach)|detach|no_grad|requires_grad|backward|grad_fn|differentia|numpy|ndarray|float64
import numpy as np
import torch


def policy_gradient(log_prob, weight):
    lp, w = log_prob.detach().numpy(), weight.detach().numpy()
    return torch.tensor(-np.mean(lp * w))

# === wrong: only positive weights count | positiv|negativ|clamp|relu|clip|sign of
import torch


def policy_gradient(log_prob, weight):
    return -(log_prob * torch.relu(weight)).mean()

# === wrong: the absolute value of the weights | abs|negativ|sign
def policy_gradient(log_prob, weight):
    return -(log_prob * weight.abs()).mean()

# === wrong: the mean over B - 1, the last row is left out | last|row|leav|left|B.?-.?1|off|missing|first
def policy_gradient(log_prob, weight):
    loss = 0.0
    for i in range(len(log_prob) - 1):
        loss -= log_prob[i] * weight[i]
    return loss / len(log_prob)

# === wrong: a column times a row, all with all | broadcast|shape|outer|each|pair|B, ?1|\bcolumn|rows
def policy_gradient(log_prob, weight):
    return -(log_prob.unsqueeze(1) * weight).mean()

# === wrong: an entropy bonus was mixed in | entropy|bonus|extra|add
def policy_gradient(log_prob, weight):
    pg = -(log_prob * weight).mean()
    entropy = -(log_prob.exp() * log_prob).mean()
    return pg - 0.01 * entropy

# === wrong: a misspelt name | NameError|not defined|log_probs
def policy_gradient(log_prob, weight):
    loss = -(log_probs * weight)
    return loss.mean()
