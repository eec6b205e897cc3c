# The λ-return of Q-learning: backwards, by recursion, in floats; and what goes wrong at its ends.

# === right: backwards, as in the notebook
import torch


def q_lambda(reward, next_value, terminated, done, *, gamma, lam):
    target = torch.zeros_like(reward)
    follows = next_value[-1]
    for t in reversed(range(len(reward))):
        mixed = lam * follows + (1 - lam) * next_value[t]
        ahead = torch.where(done[t], next_value[t], mixed)
        follows = reward[t] + gamma * ahead * ~terminated[t]
        target[t] = follows
    return target

# === right: by the paper's code: the chain is added to the target of one step
import torch


def q_lambda(rewards, next_q, terminations, dones, gamma, lam):
    one_step = rewards + gamma * next_q * (1 - terminations.float())
    out = [one_step[-1]]
    for t in range(len(rewards) - 2, -1, -1):
        delta = out[-1] - next_q[t]
        chain = one_step[t] + gamma * lam * delta
        out.append(torch.where(dones[t], one_step[t], chain))
    return torch.stack(out[::-1])

# === right: in plain floats, an environment at a time
import torch


def q_lambda(reward, next_value, terminated, done, *, gamma, lam):
    T, N = reward.shape
    out = torch.zeros(T, N)
    for n in range(N):
        for t in range(T - 1, -1, -1):
            if terminated[t, n]:
                out[t, n] = reward[t, n]
            elif done[t, n] or t == T - 1:
                out[t, n] = reward[t, n] + gamma * next_value[t, n]
            else:
                out[t, n] = reward[t, n] + gamma * (lam * out[t + 1, n] + (1 - lam) * next_value[t, n])
    return out

# === right: by a recursion
import torch


def q_lambda(reward, next_value, terminated, done, *, gamma, lam):
    def g(t):
        last = next_value[t] if t + 1 == len(reward) else torch.where(done[t], next_value[t], lam * rows[t + 1] + (1 - lam) * next_value[t])
        return reward[t] + gamma * last * (~terminated[t])
    rows = {}
    for t in range(len(reward) - 1, -1, -1):
        rows[t] = g(t)
    return torch.stack([rows[t] for t in range(len(reward))])

# === right: NumPy
import numpy as np
import torch


def q_lambda(reward, next_value, terminated, done, *, gamma, lam):
    r, v, d, e = (x.numpy() for x in (reward, next_value, terminated, done))
    out = np.empty_like(r)
    g = v[-1]
    for t in range(len(r))[::-1]:
        g = r[t] + gamma * (1 - d[t]) * np.where(e[t], v[t], lam * g + (1 - lam) * v[t])
        out[t] = g
    return torch.from_numpy(out)

# === wrong: λ and 1 − λ exchanged | λ|lam
import torch


def q_lambda(reward, next_value, terminated, done, *, gamma, lam):
    target = torch.zeros_like(reward)
    follows = next_value[-1]
    for t in reversed(range(len(reward))):
        mixed = (1 - lam) * follows + lam * next_value[t]
        ahead = torch.where(done[t], next_value[t], mixed)
        follows = reward[t] + gamma * ahead * ~terminated[t]
        target[t] = follows
    return target

# === wrong: a death bootstraps | death|terminat
import torch


def q_lambda(reward, next_value, terminated, done, *, gamma, lam):
    target = torch.zeros_like(reward)
    follows = next_value[-1]
    for t in reversed(range(len(reward))):
        mixed = lam * follows + (1 - lam) * next_value[t]
        ahead = torch.where(done[t], next_value[t], mixed)
        follows = reward[t] + gamma * ahead
        target[t] = follows
    return target

# === wrong: a time-out is taken for a death | time-out|death|truncat
import torch


def q_lambda(reward, next_value, terminated, done, *, gamma, lam):
    target = torch.zeros_like(reward)
    follows = next_value[-1]
    for t in reversed(range(len(reward))):
        mixed = lam * follows + (1 - lam) * next_value[t]
        ahead = torch.where(done[t], next_value[t], mixed)
        follows = reward[t] + gamma * ahead * ~done[t]
        target[t] = follows
    return target

# === wrong: the chain runs on over time-outs | chain|time-out
import torch


def q_lambda(reward, next_value, terminated, done, *, gamma, lam):
    target = torch.zeros_like(reward)
    follows = next_value[-1]
    for t in reversed(range(len(reward))):
        mixed = lam * follows + (1 - lam) * next_value[t]
        ahead = mixed
        follows = reward[t] + gamma * ahead * ~terminated[t]
        target[t] = follows
    return target

# === wrong: gamma is missing | γ|gamma
import torch


def q_lambda(reward, next_value, terminated, done, *, gamma, lam):
    target = torch.zeros_like(reward)
    follows = next_value[-1]
    for t in reversed(range(len(reward))):
        mixed = lam * follows + (1 - lam) * next_value[t]
        ahead = torch.where(done[t], next_value[t], mixed)
        follows = reward[t] + ahead * ~terminated[t]
        target[t] = follows
    return target

# === wrong: gamma at the maximum alone | γ|gamma
import torch


def q_lambda(reward, next_value, terminated, done, *, gamma, lam):
    target = torch.zeros_like(reward)
    follows = next_value[-1]
    for t in reversed(range(len(reward))):
        mixed = lam * follows + (1 - lam) * gamma * next_value[t]
        ahead = torch.where(done[t], next_value[t], mixed)
        follows = reward[t] + ahead * ~terminated[t]
        target[t] = follows
    return target

# === wrong: the chain begins with zeros | last row|begins|0
import torch


def q_lambda(reward, next_value, terminated, done, *, gamma, lam):
    target = torch.zeros_like(reward)
    follows = torch.zeros_like(next_value[-1])
    for t in reversed(range(len(reward))):
        mixed = lam * follows + (1 - lam) * next_value[t]
        ahead = torch.where(done[t], next_value[t], mixed)
        follows = reward[t] + gamma * ahead * ~terminated[t]
        target[t] = follows
    return target

# === wrong: forwards | forward|backward|past
import torch


def q_lambda(reward, next_value, terminated, done, *, gamma, lam):
    target = torch.zeros_like(reward)
    follows = next_value[-1]
    for t in range(len(reward)):
        mixed = lam * follows + (1 - lam) * next_value[t]
        ahead = torch.where(done[t], next_value[t], mixed)
        follows = reward[t] + gamma * ahead * ~terminated[t]
        target[t] = follows
    return target

# === wrong: no chain: one step | λ|chain|one step
import torch


def q_lambda(reward, next_value, terminated, done, *, gamma, lam):
    target = torch.zeros_like(reward)
    follows = next_value[-1]
    for t in reversed(range(len(reward))):
        mixed = next_value[t]
        ahead = torch.where(done[t], next_value[t], mixed)
        follows = reward[t] + gamma * ahead * ~terminated[t]
        target[t] = follows
    return target

# === wrong: Monte Carlo: λ is not looked at | λ|whole return|maximum
import torch


def q_lambda(reward, next_value, terminated, done, *, gamma, lam):
    target = torch.zeros_like(reward)
    follows = next_value[-1]
    for t in reversed(range(len(reward))):
        mixed = follows
        ahead = torch.where(done[t], next_value[t], mixed)
        follows = reward[t] + gamma * ahead * ~terminated[t]
        target[t] = follows
    return target

# === wrong: the reward of a death is lost | reward|death
import torch


def q_lambda(reward, next_value, terminated, done, *, gamma, lam):
    target = torch.zeros_like(reward)
    follows = next_value[-1]
    for t in reversed(range(len(reward))):
        mixed = lam * follows + (1 - lam) * next_value[t]
        ahead = torch.where(done[t], next_value[t], mixed)
        follows = (reward[t] + gamma * ahead) * ~terminated[t]
        target[t] = follows
    return target

# === wrong: the mask turned round | mask|turned|invert
import torch


def q_lambda(reward, next_value, terminated, done, *, gamma, lam):
    target = torch.zeros_like(reward)
    follows = next_value[-1]
    for t in reversed(range(len(reward))):
        mixed = lam * follows + (1 - lam) * next_value[t]
        ahead = torch.where(done[t], next_value[t], mixed)
        follows = reward[t] + gamma * ahead * terminated[t]
        target[t] = follows
    return target

# === wrong: the reward is forgotten | reward
import torch


def q_lambda(reward, next_value, terminated, done, *, gamma, lam):
    target = torch.zeros_like(reward)
    follows = next_value[-1]
    for t in reversed(range(len(reward))):
        mixed = lam * follows + (1 - lam) * next_value[t]
        ahead = torch.where(done[t], next_value[t], mixed)
        follows = gamma * ahead * ~terminated[t]
        target[t] = follows
    return target

# === wrong: the maximum of the next row | next row|row
import torch


def q_lambda(reward, next_value, terminated, done, *, gamma, lam):
    target = torch.zeros_like(reward)
    follows = next_value[-1]
    for t in reversed(range(len(reward))):
        mixed = lam * follows + (1 - lam) * next_value[min(t + 1, len(reward) - 1)]
        ahead = torch.where(done[t], next_value[min(t + 1, len(reward) - 1)], mixed)
        follows = reward[t] + gamma * ahead * ~terminated[t]
        target[t] = follows
    return target

# === wrong: an advantage is returned | advantage|subtract
import torch


def q_lambda(reward, next_value, terminated, done, *, gamma, lam):
    target = torch.zeros_like(reward)
    follows = next_value[-1]
    for t in reversed(range(len(reward))):
        mixed = lam * follows + (1 - lam) * next_value[t]
        ahead = torch.where(done[t], next_value[t], mixed)
        follows = reward[t] + gamma * ahead * ~terminated[t]
        target[t] = follows
    return target - next_value

# === wrong: gamma twice in the chain | γ|gamma
import torch


def q_lambda(reward, next_value, terminated, done, *, gamma, lam):
    target = torch.zeros_like(reward)
    follows = next_value[-1]
    for t in reversed(range(len(reward))):
        mixed = gamma * lam * follows + (1 - lam) * next_value[t]
        ahead = torch.where(done[t], next_value[t], mixed)
        follows = reward[t] + gamma * ahead * ~terminated[t]
        target[t] = follows
    return target
