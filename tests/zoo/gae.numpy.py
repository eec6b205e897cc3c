# NumPy, as in Spinning Up: float64 arrays, deltas first.

# === right: float64 arrays inside, float32 tensors out
import numpy as np
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    r, v, nv = (np.asarray(x, dtype=np.float64) for x in (reward, value, next_value))
    term, end = np.asarray(terminated, dtype=bool), np.asarray(done, dtype=bool)
    delta = r + gamma * np.where(term, 0.0, nv) - v
    adv = np.zeros_like(delta)
    running = np.zeros(delta.shape[1])
    for t in range(delta.shape[0] - 1, -1, -1):
        running = delta[t] + gamma * lam * (1 - end[t]) * running
        adv[t] = running
    return torch.as_tensor(adv, dtype=torch.float32), torch.as_tensor(adv + v, dtype=torch.float32)

# === right: NumPy arrays come back, float64, whatever went in
import numpy as np


def gae(rewards, values, next_values, terminations, dones, gamma=0.99, lam=0.95):
    rewards = np.array(rewards, dtype=float)
    values = np.array(values, dtype=float)
    next_values = np.array(next_values, dtype=float)
    terminations = np.array(terminations).astype(float)
    dones = np.array(dones).astype(float)

    deltas = rewards + gamma * next_values * (1.0 - terminations) - values
    advantages = np.zeros_like(rewards)
    advantages[-1] = deltas[-1]
    for t in reversed(range(len(rewards) - 1)):
        advantages[t] = deltas[t] + gamma * lam * (1.0 - dones[t]) * advantages[t + 1]
    return advantages, advantages + values

# === right: np.ndenumerate over rows turned round, element by element
import numpy as np
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    adv = np.zeros(tuple(reward.shape), dtype=np.float32)
    carry = [0.0] * reward.shape[1]
    reward_, value_, next_, term_, done_ = [np.asarray(x) for x in (reward, value, next_value, terminated, done)]
    for (i, n), r in np.ndenumerate(reward_[::-1]):
        t = len(reward_) - 1 - i
        if done_[t, n]:
            carry[n] = 0.0
        boot = 0.0 if term_[t, n] else float(next_[t, n])
        carry[n] = float(r) + gamma * boot - float(value_[t, n]) + gamma * lam * carry[n]
        adv[t, n] = carry[n]
    adv = torch.from_numpy(adv)
    return adv, adv + torch.as_tensor(value_)

# === right: itertools.accumulate over each environment's pairs (delta, decay)
from itertools import accumulate

import numpy as np
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    def column(deltas, decays):
        pairs = list(zip(deltas, decays))[::-1]
        sums = accumulate(pairs, lambda acc, pair: (pair[0] + pair[1] * acc[0], pair[1]))
        return [s for s, _ in sums][::-1]

    delta = (reward + gamma * next_value * ~terminated - value).tolist()
    decay = (gamma * lam * (~done).float()).tolist()
    cols = [column(d, c) for d, c in zip(zip(*delta), zip(*decay))]
    adv = torch.tensor(np.array(cols).T.copy(), dtype=reward.dtype)
    return adv, adv + value

# === right: np.split where episodes end, one discounted sum for each piece
import numpy as np
import torch


def discount_cumsum(x, discount):
    out = np.empty_like(x)
    total = 0.0
    for i in range(len(x) - 1, -1, -1):
        total = x[i] + discount * total
        out[i] = total
    return out


def gae(rew, val, next_val, terminated, done, gamma=0.99, lam=0.95):
    T, N = rew.shape
    adv = np.empty((T, N))
    for n in range(N):
        deltas = (rew[:, n] + gamma * next_val[:, n] * (~terminated[:, n]) - val[:, n]).numpy().astype(np.float64)
        cuts = np.flatnonzero(done[:, n].numpy()) + 1
        adv[:, n] = np.concatenate([discount_cumsum(piece, gamma * lam) for piece in np.split(deltas, cuts)])
    adv = torch.tensor(adv, dtype=torch.float32)
    return adv, adv + val

# === wrong: the arrays are of whole numbers, so that everything is rounded down | integer|whole number|round|dtype|int\d*\b|float
import numpy as np
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    r, v, nv, term, end = (np.asarray(x) for x in (reward, value, next_value, terminated, done))
    adv = np.zeros(r.shape, dtype=int)
    last = 0.0
    for t in reversed(range(len(r))):
        delta = r[t] + gamma * nv[t] * (1 - term[t]) - v[t]
        last = delta + gamma * lam * (1 - end[t]) * last
        adv[t] = last
    adv = torch.from_numpy(adv)
    return adv, adv + value

# === wrong: the result is rounded to two digits | round|digits|decimal|precis
import numpy as np
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    r, v, nv, term, end = (np.asarray(x) for x in (reward, value, next_value, terminated, done))
    adv = np.zeros(r.shape)
    last = 0.0
    for t in reversed(range(len(r))):
        delta = r[t] + gamma * nv[t] * (1 - term[t]) - v[t]
        last = delta + gamma * lam * (1 - end[t]) * last
        adv[t] = last
    adv = adv.round(2)
    return torch.as_tensor(adv), torch.as_tensor((adv + v).round(2))

# === wrong: the rewards array is written into: np.asarray shares the tensor's memory | in place|changes|caller|overw|modif|reward.*(written|changed)
import numpy as np
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    adv = np.asarray(reward)
    v, nv, term, end = (np.asarray(x) for x in (value, next_value, terminated, done))
    adv += gamma * nv * (1 - term) - v
    for t in reversed(range(len(adv) - 1)):
        adv[t] += gamma * lam * (1 - end[t]) * adv[t + 1]
    return torch.from_numpy(adv), torch.from_numpy(adv + v)

# === wrong: the target is the reward-to-go of the rewards alone, not advantage + V | advantages? ?(\+|plus) ?(V|(the )?value)|\+ ?V|V\(s|plus
import numpy as np
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    r, v, nv, term, end = (np.asarray(x, dtype=np.float64) for x in (reward, value, next_value, terminated, done))
    adv, ret = np.zeros_like(r), np.zeros_like(r)
    a = g = np.zeros(r.shape[1])
    for t in reversed(range(len(r))):
        a = r[t] + gamma * nv[t] * (1 - term[t]) - v[t] + gamma * lam * (1 - end[t]) * a
        g = r[t] + gamma * (1 - end[t]) * g
        adv[t], ret[t] = a, g
    return torch.as_tensor(adv, dtype=torch.float32), torch.as_tensor(ret, dtype=torch.float32)

# === wrong: `1 - done` on np.bool arrays by `-`: bool minus bool | bool|subtract
import numpy as np
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    r, v, nv, term, end = (np.asarray(x) for x in (reward, value, next_value, terminated, done))
    ones = np.ones_like(term)
    adv = np.zeros_like(r)
    last = 0.0
    for t in reversed(range(len(r))):
        delta = r[t] + gamma * nv[t] * (ones[t] - term[t]) - v[t]
        last = delta + gamma * lam * (ones[t] - end[t]) * last
        adv[t] = last
    return torch.as_tensor(adv), torch.as_tensor(adv + v)

# === wrong: np.cumsum of weighted deltas without dividing the weight out again | weight|divid|(γλ|gamma|factor|power|exponent)|chain|trace
import numpy as np
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    r, v, nv, term = (np.asarray(x, dtype=np.float64) for x in (reward, value, next_value, terminated))
    delta = r + gamma * nv * (1 - term) - v
    w = (gamma * lam) ** np.arange(len(delta))[:, None]
    adv = np.cumsum((delta * w)[::-1], axis=0)[::-1]
    adv = torch.as_tensor(adv.copy(), dtype=torch.float32)
    return adv, adv + value
