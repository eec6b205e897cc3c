# Lists, deques, generators: the hand of REINFORCE tutorials.

# === right: a list that is reversed
import torch


def discounted_returns(rewards, gamma):
    returns = []
    G = 0.0
    for r in reversed(rewards):
        G = r + gamma * G
        returns.append(G)
    returns.reverse()
    return torch.tensor(returns)

# === right: insert(0, …), torch.stack
import torch


def discounted_returns(rewards, gamma=0.99):
    R = torch.zeros(())
    out = []
    for r in torch.flip(rewards, [0]):
        R = r + gamma * R
        out.insert(0, R)
    return torch.stack(out)

# === right: a list of Python floats comes back
from collections import deque


def discounted_returns(rewards, gamma):
    result = deque()
    running = 0.0
    for step in range(len(rewards) - 1, -1, -1):
        running = float(rewards[step]) + gamma * running
        result.appendleft(running)
    return list(result)

# === right: the definition: two sums, exponent k - t
import torch


def discounted_returns(rewards, gamma):
    T = len(rewards)
    return torch.tensor([sum(gamma ** (k - t) * float(rewards[k]) for k in range(t, T)) for t in range(T)])

# === right: a recursion on the tail
import torch


def discounted_returns(rewards, gamma):
    if len(rewards) == 0:
        return rewards
    tail = discounted_returns(rewards[1:], gamma)
    head = rewards[:1] + gamma * tail[:1] if len(tail) else rewards[:1]
    return torch.cat([head, tail])

# === right: itertools.accumulate
from itertools import accumulate

import torch


def discounted_returns(rewards, gamma: float = 0.99) -> torch.Tensor:
    backwards = accumulate(torch.as_tensor(rewards).tolist()[::-1], lambda later, reward: reward + gamma * later)
    return torch.tensor(list(backwards)[::-1])

# === right: a generator that the function collects
import torch


def _walk(rewards, gamma):
    following = 0.0
    for reward in rewards:
        following = reward + gamma * following
        yield following


def discounted_returns(rewards, *, gamma):
    backwards = list(_walk(rewards.flip(0), gamma))
    return torch.stack(backwards).flip(0)

# === wrong: the list is not reversed | revers|order\b|backward|flip
import torch


def discounted_returns(rewards, gamma):
    returns = []
    G = 0.0
    for r in reversed(rewards):
        G = r + gamma * G
        returns.append(G)
    return torch.tensor(returns)

# === wrong: forwards: the past is summed up | forward|backward|past|direction|order\b|before|revers
# --- instead of
    for r in reversed(rewards):
# --- here
    for r in rewards:

# === wrong: gamma is not used | γ|gamma|discount
import torch


def discounted_returns(rewards, gamma):
    returns, G = [], 0.0
    for r in reversed(rewards):
        G = r + G
        returns.insert(0, G)
    return torch.tensor(returns)

# === wrong: gamma on the reward in place of the rest: G = gamma r + G | γ|gamma|discount|reward
# --- instead of
        G = r + G
# --- here
        G = gamma * r + G

# === wrong: gamma multiplies both: G = gamma (r + G) | γ|gamma|discount|power|exponent|once too|own reward
# --- instead of
        G = r + G
# --- here
        G = gamma * (r + G)

# === wrong: the exponent as printed: t - k | exponent|power|k ?[-−] ?t|t ?[-−] ?k|γ|gamma|discount|ZeroDivision
import torch


def discounted_returns(rewards, gamma):
    T = len(rewards)
    return torch.tensor([sum(gamma ** (t - k) * float(rewards[k]) for k in range(t, T)) for t in range(T)])

# === wrong: the exponent is k, not k - t | exponent|power|k ?[-−] ?t|γ|gamma|discount
import torch


def discounted_returns(rewards, gamma):
    T = len(rewards)
    return torch.tensor([sum(gamma**k * float(rewards[k]) for k in range(t, T)) for t in range(T)])

# === wrong: the sum begins at t + 1: the row's own reward is missing | own|t ?\+ ?1|first term|immediate|reward (of|at|itself)|r_t|off by one|row'?s reward
import torch


def discounted_returns(rewards, gamma):
    T = len(rewards)
    return torch.tensor([sum(gamma ** (k - t - 1) * float(rewards[k]) for k in range(t + 1, T)) for t in range(T)])

# === wrong: the sum ends at T - 2: the last reward is missing | last|T ?[-−] ?1|range|off by one|missing
import torch


def discounted_returns(rewards, gamma):
    T = len(rewards)
    return torch.tensor([float(sum(gamma ** (k - t) * float(rewards[k]) for k in range(t, T - 1))) for t in range(T)])

# === wrong: only the return of the whole episode, a number | shape|scalar|number|each row|\[T\]|length|one value|single
import torch


def discounted_returns(rewards, gamma):
    G = 0.0
    for r in reversed(rewards):
        G = r + gamma * G
    return torch.as_tensor(G)

# === wrong: the same whole return for every row | whole|each row|every (row|step|action)|constant|same|from it on
# --- instead of
    return torch.as_tensor(G)
# --- here
    return torch.full((len(rewards),), float(G))

# === wrong: one row too many: the 0 after the end is in the list | shape|length|too many|T ?\+ ?1|one (row|more)|size
import torch


def discounted_returns(rewards, gamma):
    returns = [0.0]
    for r in reversed(rewards):
        returns.insert(0, float(r) + gamma * returns[0])
    return torch.tensor(returns)

# === wrong: prints the returns | None|return(s|ed)? nothing|nothing (is|was|came)|no return|without a? ?return
def discounted_returns(rewards, gamma):
    G = 0.0
    returns = []
    for r in reversed(rewards):
        G = r + gamma * G
        returns.insert(0, G)
    print("returns:", returns)

# === wrong: a typing error: return is spelt retuns | NameError|retuns|not defined
import torch


def discounted_returns(rewards, gamma):
    returns = []
    G = 0.0
    for r in reversed(rewards):
        G = r + gamma * G
        returns.append(G)
    return torch.tensor(retuns[::-1])

# === wrong: append on what `reversed` gives | AttributeError|reversed|no attribute
import torch


def discounted_returns(rewards, gamma):
    returns = reversed([])
    G = 0.0
    for r in rewards:
        G = r + gamma * G
        returns.append(G)
    return torch.tensor(list(returns))
