# Loops of all kinds.

# === right: backwards; what follows is next_value at the last row and at time-outs
import torch


def reward_to_go(rewards, next_values, terminations, dones, gamma=0.99):
    T, N = rewards.shape
    out = torch.zeros_like(rewards)
    follows = next_values[-1]
    for t in reversed(range(T)):
        follows = torch.where(dones[t], next_values[t], follows)
        follows = torch.where(terminations[t], torch.zeros_like(follows), follows)
        follows = rewards[t] + gamma * follows
        out[t] = follows
    return out

# === right: two loops forwards in Python floats
import torch


def reward_to_go(reward, next_value, terminated, done, *, gamma):
    T, N = reward.shape
    r, v = reward.tolist(), next_value.tolist()
    result = [[0.0] * N for _ in range(T)]
    for n in range(N):
        for t in range(T):
            g, k = 1.0, t
            while True:
                result[t][n] += g * r[k][n]
                if done[k, n] or k == T - 1:
                    if not terminated[k, n]:
                        result[t][n] += g * gamma * v[k][n]
                    break
                g *= gamma
                k += 1
    return torch.tensor(result)

# === right: a recursion that gives the list of rows from t on
import torch


def _from(t, reward, next_value, terminated, done, gamma):
    if t == len(reward):
        return []
    rest = _from(t + 1, reward, next_value, terminated, done, gamma)
    later = torch.where(done[t], next_value[t], rest[0]) if rest else next_value[t]
    return [reward[t] + gamma * later * ~terminated[t], *rest]


def reward_to_go(reward, next_value, terminated, done, *, gamma=0.99):
    return torch.stack(_from(0, reward, next_value, terminated, done, gamma))

# === right: environment by environment, episodes as lists, reversed
import torch


def discount(rewards, last, gamma):
    out, g = [], last
    for r in reversed(rewards):
        g = r + gamma * g
        out.append(g)
    return out[::-1]


def reward_to_go(reward, next_value, terminated, done, gamma):
    columns = []
    for n in range(reward.size(1)):
        column, episode = [], []
        for t in range(reward.size(0)):
            episode.append(reward[t, n].item())
            if done[t, n] or t == reward.size(0) - 1:
                last = 0.0 if terminated[t, n] else next_value[t, n].item()
                column += discount(episode, last, gamma)
                episode = []
        columns.append(column)
    return torch.tensor(columns).T

# === right: the rows are changed in place in a clone, from the end
import torch


def reward_to_go(reward, next_value, terminated, done, *, gamma):
    cut = done.clone()
    cut[-1] = True
    go = reward.clone()
    go += gamma * next_value * (cut & ~terminated)
    for t in range(go.shape[0] - 1, 0, -1):
        go[t - 1].add_(torch.where(cut[t - 1], 0.0, gamma * go[t]))
    return go

# === right: a deque and zip of reversed rows
from collections import deque

import torch


def reward_to_go(reward, next_value, terminated, done, *, gamma=0.99):
    rows = deque()
    for r, v, dead, over in zip(*(x.flip(0) for x in (reward, next_value, terminated, done))):
        rest = torch.where(over, v, rows[0]) if rows else v
        rows.appendleft(r + gamma * rest.masked_fill(dead, 0.0))
    return torch.stack(list(rows))

# === wrong: the sum runs on into the next episode | chain|run(s|ning)? on|next episode|across|carr|trace|\bdone\b|\bends?\b
import torch


def reward_to_go(reward, next_value, terminated, done, *, gamma):
    out = torch.zeros_like(reward)
    g = next_value[-1] * ~terminated[-1]
    for t in reversed(range(len(reward))):
        g = reward[t] + gamma * g
        out[t] = g
    return out

# === wrong: the last row has no bootstrap, although the episode goes on | last (row|step)|bootstrap|next_value|rows run out|rest\b
import torch


def reward_to_go(reward, next_value, terminated, done, *, gamma):
    out = torch.zeros_like(reward)
    g = torch.zeros_like(reward[0])
    for t in reversed(range(len(reward))):
        g = torch.where(done[t] & ~terminated[t], next_value[t], g)
        g = reward[t] + gamma * g * ~terminated[t]
        out[t] = g
    return out

# === wrong: a time-out is taken for a death: nothing stands for the rest | time-?out|truncat|death|bootstrap|next_value|rest\b
import torch


def reward_to_go(reward, next_value, terminated, done, *, gamma):
    out = torch.zeros_like(reward)
    g = next_value[-1]
    for t in reversed(range(len(reward))):
        g = reward[t] + gamma * g * ~done[t]
        out[t] = g
    return out

# === wrong: a death bootstraps like a time-out: terminated is not used | terminat|death|bootstrap|next_value|mask
# --- instead of
        g = reward[t] + gamma * g * ~done[t]
# --- here
        g = reward[t] + gamma * torch.where(done[t], next_value[t], g)

# === wrong: gamma is left out | γ|gamma|discount
# --- instead of
        g = reward[t] + gamma * g * ~done[t]
# --- here
        g = torch.where(done[t], next_value[t], g)
        g = reward[t] + g * ~terminated[t]

# === wrong: gamma is left out before next_value at a time-out | γ|gamma|discount|bootstrap|next_value
import torch


def reward_to_go(reward, next_value, terminated, done, *, gamma):
    T = len(reward)
    out = torch.zeros_like(reward)
    g = torch.zeros_like(reward[0])
    for t in reversed(range(T)):
        end = done[t] if t < T - 1 else torch.ones_like(done[t])
        g = torch.where(end, reward[t] + next_value[t] * ~terminated[t], reward[t] + gamma * g)
        out[t] = g
    return out

# === wrong: the reward itself is discounted, too: gamma (r + G) | γ|gamma|discount|power|exponent|own reward|once too
import torch


def reward_to_go(reward, next_value, terminated, done, *, gamma):
    out = torch.zeros_like(reward)
    g = next_value[-1]
    for t in reversed(range(len(reward))):
        g = torch.where(done[t], next_value[t], g)
        g = gamma * (reward[t] + g * ~terminated[t])
        out[t] = g
    return out

# === wrong: the list of rows is not turned round | revers|order\b|backward|flip
import torch


def reward_to_go(reward, next_value, terminated, done, *, gamma):
    out = []
    g = next_value[-1]
    for t in reversed(range(len(reward))):
        g = torch.where(done[t], next_value[t], g)
        g = reward[t] + gamma * g * ~terminated[t]
        out.append(g)
    return torch.stack(out)

# === wrong: forwards: the rewards up to an action in place of those from it on | forward|backward|past|direction|order\b|before|revers|up to
import torch


def reward_to_go(reward, next_value, terminated, done, *, gamma):
    out = torch.zeros_like(reward)
    g = torch.zeros_like(reward[0])
    for t in range(len(reward)):
        g = reward[t] + gamma * g
        out[t] = g
        g = g * ~done[t]
    return out

# === wrong: the flags of the next row end the episode | (row|step|one) (too )?(late|early|off)|t ?\+ ?1|shift|flag|next row
import torch


def reward_to_go(reward, next_value, terminated, done, *, gamma):
    T = len(reward)
    out = torch.zeros_like(reward)
    g = next_value[-1]
    for t in reversed(range(T)):
        k = min(t + 1, T - 1)
        g = torch.where(done[k], next_value[k], g)
        g = reward[t] + gamma * g * ~terminated[k]
        out[t] = g
    return out

# === wrong: the row after an end begins with zero, its own reward is lost | own reward|reward|\bends?\b|lost|mask|reset|zero
import torch


def reward_to_go(reward, next_value, terminated, done, *, gamma):
    out = torch.zeros_like(reward)
    g = next_value[-1]
    for t in reversed(range(len(reward))):
        g = torch.where(done[t], next_value[t], g)
        g = (reward[t] + gamma * g) * ~terminated[t]
        out[t] = g
    return out

# === wrong: the first row is forgotten | row 0|first (row|step)|range|left out|never (filled|written|computed)|stays? (0|zero)
import torch


def reward_to_go(reward, next_value, terminated, done, *, gamma):
    out = torch.zeros_like(reward)
    g = next_value[-1]
    for t in range(len(reward) - 1, 0, -1):
        g = torch.where(done[t], next_value[t], g)
        g = reward[t] + gamma * g * ~terminated[t]
        out[t] = g
    return out

# === wrong: `while t:` never ends, for t is taken modulo T | never end|time limit|endless|seconds|too long|did not (end|finish|return)|no end|still running|took
import torch


def reward_to_go(reward, next_value, terminated, done, *, gamma):
    out = torch.zeros_like(reward)
    g = next_value[-1]
    t = len(reward) - 1
    while t >= 0:
        g = torch.where(done[t], next_value[t], g)
        g = reward[t] + gamma * g * ~terminated[t]
        out[t] = g
        t = (t - 1) % len(reward)
    return out

# === wrong: an index that runs out: reward[t + 1] at the last row | IndexError|out of (bounds|range)|index|last (row|step)
import torch


def reward_to_go(reward, next_value, terminated, done, *, gamma):
    out = reward.clone()
    for t in reversed(range(len(reward))):
        out[t] = reward[t] + gamma * out[t + 1] * ~done[t]
    return out
