# Backwards, forwards, recursively, in plain floats: the hand that writes loops.

# === right: backwards, with the names of the course
import torch


def gae(rewards, values, next_values, terminations, dones, gamma=0.99, lam=0.95):
    T = rewards.shape[0]
    advantages = torch.zeros_like(rewards)
    last = 0
    for t in reversed(range(T)):
        nonterminal = 1.0 - terminations[t].float()
        delta = rewards[t] + gamma * next_values[t] * nonterminal - values[t]
        last = delta + gamma * lam * (1.0 - dones[t].float()) * last
        advantages[t] = last
    returns = advantages + values
    return advantages, returns

# === right: two loops forwards, each row sums its own deltas up to the end of the episode
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    steps, envs = reward.shape
    deltas = torch.zeros(steps, envs)
    for t in range(steps):
        for n in range(envs):
            bootstrap = 0.0 if terminated[t, n] else next_value[t, n]
            deltas[t, n] = reward[t, n] + gamma * bootstrap - value[t, n]

    advantage = torch.zeros(steps, envs)
    for n in range(envs):
        for t in range(steps):
            weight = 1.0
            for k in range(t, steps):
                advantage[t, n] += weight * deltas[k, n]
                if done[k, n]:
                    break
                weight *= gamma * lam
    return advantage, advantage + value

# === right: a recursion, one call for each row
import torch


def gae(reward, value, next_value, terminated, done, gamma, lam):
    T = len(reward)
    alive = ~terminated
    delta = reward + gamma * next_value * alive - value

    def from_row(t):
        if t == T:
            return []
        rest = from_row(t + 1)
        if not rest:
            return [delta[t]]
        return [delta[t] + gamma * lam * torch.where(done[t], torch.zeros_like(rest[0]), rest[0])] + rest

    adv = torch.stack(from_row(0))
    return adv, adv + value

# === right: environment by environment in Python floats, a list that is reversed
import torch


def gae(reward, value, next_value, terminated, done, *, gamma: float = 0.99, lam: float = 0.95):
    columns = []
    for env in range(reward.shape[1]):
        advs = []
        acc = 0.0
        for step in range(reward.shape[0] - 1, -1, -1):
            r = reward[step, env].item()
            v = value[step, env].item()
            v_next = next_value[step, env].item()
            if terminated[step, env]:
                v_next = 0.0
            if done[step, env]:
                acc = 0.0
            acc = r + gamma * v_next - v + gamma * lam * acc
            advs.append(acc)
        advs.reverse()
        columns.append(advs)
    advantage = torch.tensor(columns, dtype=reward.dtype).T
    return advantage, advantage + value

# === right: a deque that grows to the left
from collections import deque

import torch


def gae(rewards, values, next_values, terminated, done, *, gamma, lam):
    out = deque()
    rows = zip(rewards.flip(0), values.flip(0), next_values.flip(0), terminated.flip(0), done.flip(0))
    running = torch.zeros(rewards.size(1), dtype=rewards.dtype)
    for r, v, vn, term, end in rows:
        running = running.masked_fill(end, 0.0)
        running = r + gamma * vn.masked_fill(term, 0.0) - v + gamma * lam * running
        out.appendleft(running)
    adv = torch.stack(tuple(out))
    return adv, adv + values

# === right: a generator gives the rows from the last to the first
import torch


def _backwards(delta, decay):
    carry = torch.zeros_like(delta[0])
    for d, c in zip(reversed(delta.unbind(0)), reversed(decay.unbind(0))):
        carry = d + c * carry
        yield carry


def gae(reward, value, next_value, terminated, done, *, gamma=0.99, lam=0.95):
    not_terminated = torch.logical_not(terminated).to(reward)
    not_done = torch.logical_not(done).to(reward)
    delta = reward + gamma * not_terminated * next_value - value
    rows = list(_backwards(delta, gamma * lam * not_done))
    advantage = torch.stack(rows[::-1])
    return advantage, value + advantage

# === right: in-place operations on tensors of its own
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    adv = next_value.clone()
    adv[terminated] = 0
    adv.mul_(gamma).add_(reward).sub_(value)
    keep = (~done).float().mul_(gamma * lam)
    for t in range(len(adv) - 2, -1, -1):
        adv[t].addcmul_(keep[t], adv[t + 1])
    target = adv.clone()
    target += value
    return adv, target

# === right: the lambda-return first, the advantage is what it has over V
import torch


def gae(reward, value, next_value, terminated, done, gamma=0.99, lam=0.95):
    T = reward.shape[0]
    target = torch.empty_like(reward)
    for t in range(T - 1, -1, -1):
        if t == T - 1:
            mixed = next_value[t]
        else:
            mixed = torch.where(done[t], next_value[t], (1 - lam) * next_value[t] + lam * target[t + 1])
        target[t] = reward[t] + gamma * torch.where(terminated[t], torch.zeros_like(mixed), mixed)
    return target - value, target

# === wrong: the chain is never cut where an episode ends, done is not used | chain|trace|carr|run(s|ning)? on|next episode|across.*end|\bdone\b
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    adv = torch.zeros_like(reward)
    last = torch.zeros_like(reward[0])
    for t in reversed(range(len(reward))):
        delta = reward[t] + gamma * next_value[t] * (~terminated[t]) - value[t]
        last = delta + gamma * lam * last
        adv[t] = last
    return adv, adv + value

# === wrong: the chain is cut at deaths only and runs on after a time-out | time-?out|truncat|chain|trace|\bdone\b
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    adv = torch.zeros_like(reward)
    last = 0.0
    for t in reversed(range(reward.shape[0])):
        mask = 1.0 - terminated[t].float()
        delta = reward[t] + gamma * next_value[t] * mask - value[t]
        adv[t] = last = delta + gamma * lam * mask * last
    return adv, adv + value

# === wrong: a time-out is taken for a death: done masks the bootstrap, too | time-?out|truncat|bootstrap|\bdone\b.*terminat|death
import torch


def gae(rewards, values, next_values, terminations, dones, gamma=0.99, lam=0.95):
    advantages = torch.zeros_like(rewards)
    lastgaelam = 0
    for t in reversed(range(len(rewards))):
        nextnonterminal = 1.0 - dones[t].float()
        delta = rewards[t] + gamma * next_values[t] * nextnonterminal - values[t]
        advantages[t] = lastgaelam = delta + gamma * lam * nextnonterminal * lastgaelam
    return advantages, advantages + values

# === wrong: V(s') is not masked after a termination | terminat|death|bootstrap|mask
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    out, acc = [], 0.0
    for t in reversed(range(len(reward))):
        delta = reward[t] + gamma * next_value[t] - value[t]
        acc = delta + gamma * lam * acc * (~done[t])
        out.append(acc)
    adv = torch.stack(out[::-1])
    return adv, adv + value

# === wrong: the flags are read a row late (t + 1, as for arrays in which dones[t] is of the step before) | (row|step|one) (too )?(late|early|off)|t ?\+ ?1|shift|off by one|flag|next row|wrong row
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    T = len(reward)
    adv = torch.zeros_like(reward)
    last = torch.zeros_like(reward[0])
    for t in reversed(range(T)):
        if t == T - 1:
            term, end = terminated[t], done[t]
        else:
            term, end = terminated[t + 1], done[t + 1]
        delta = reward[t] + gamma * next_value[t] * ~term - value[t]
        last = delta + gamma * lam * last * ~end
        adv[t] = last
    return adv, adv + value

# === wrong: the flags are read a row early: those of t - 1 | (row|step|one) (too )?(late|early|off)|t ?[-−] ?1|shift|off by one|flag|row before|wrong row|previous
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    adv = torch.zeros_like(reward)
    last = torch.zeros_like(reward[0])
    for t in range(len(reward) - 1, -1, -1):
        delta = reward[t] + gamma * next_value[t] * ~terminated[t - 1] - value[t]
        last = delta + gamma * lam * last * ~done[t - 1]
        adv[t] = last
    return adv, adv + value

# === wrong: lambda is missing in the chain | λ|lam(bda)?\b
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    adv = torch.zeros_like(reward)
    nxt = torch.zeros_like(reward[0])
    for t in reversed(range(len(reward))):
        delta = reward[t] + gamma * next_value[t] * ~terminated[t] - value[t]
        nxt = adv[t] = delta + gamma * nxt * ~done[t]
    return adv, adv + value

# === wrong: gamma is missing in the chain | γ|gamma|discount
# --- instead of
        nxt = adv[t] = delta + gamma * nxt * ~done[t]
# --- here
        nxt = delta + lam * nxt * ~done[t]
        adv[t] = nxt

# === wrong: gamma is missing before V(s') | γ|gamma|discount
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    delta = reward + next_value * (~terminated) - value
    adv = torch.zeros_like(delta)
    trace = 0
    for t in range(len(delta))[::-1]:
        trace = delta[t] + gamma * lam * trace * (~done[t])
        adv[t] = trace
    return adv, adv + value

# === wrong: row 0 is left out: the range ends at 1 | row 0|first (row|step)|range|left out|never (filled|written|computed)|stays? (0|zero)
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    adv = torch.zeros_like(reward)
    last = 0.0
    for t in range(len(reward) - 1, 0, -1):
        delta = reward[t] + gamma * next_value[t] * ~terminated[t] - value[t]
        last = delta + gamma * lam * last * ~done[t]
        adv[t] = last
    return adv, adv + value

# === wrong: the last row is left out: the range begins at T - 2 | last (row|step)|range|left out|never (filled|written|computed)|T ?[-−] ?1
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    adv = torch.zeros_like(reward)
    for t in range(len(reward) - 2, -1, -1):
        delta = reward[t] + gamma * next_value[t] * ~terminated[t] - value[t]
        adv[t] = delta + gamma * lam * adv[t + 1] * ~done[t]
    return adv, adv + value

# === wrong: the list is never reversed | revers|order|backward|flip
import torch


def gae(rewards, values, next_values, terminated, done, *, gamma, lam):
    advs = []
    g = torch.zeros(rewards.shape[1])
    for t in reversed(range(rewards.shape[0])):
        delta = rewards[t] + gamma * next_values[t] * (~terminated[t]) - values[t]
        g = delta + gamma * lam * (~done[t]) * g
        advs.append(g)
    advs = torch.stack(advs)
    return advs, advs + values

# === wrong: the loop runs forwards, so that each row adds up its past | forward|backward|past|direction|order\b|revers
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    adv = torch.zeros_like(reward)
    last = torch.zeros_like(reward[0])
    for t in range(len(reward)):
        delta = reward[t] + gamma * next_value[t] * ~terminated[t] - value[t]
        last = delta + gamma * lam * last
        adv[t] = last
        last = last * ~done[t]
    return adv, adv + value

# === wrong: t is never counted down, so that the loop never ends | never end|time limit|endless|seconds|too long|did not (end|finish|return)|no end|still running|took
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    adv = torch.zeros_like(reward)
    last = 0.0
    t = len(reward) - 1
    while t >= 0:
        delta = reward[t] + gamma * next_value[t] * ~terminated[t] - value[t]
        last = delta + gamma * lam * last * ~done[t]
        adv[t] = last
    return adv, adv + value

# === wrong: `1 - terminated` on a bool tensor | bool|subtract
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    adv = torch.zeros_like(reward)
    last = 0.0
    for t in reversed(range(len(reward))):
        delta = reward[t] + gamma * next_value[t] * (1 - terminated[t]) - value[t]
        last = delta + gamma * lam * last * (1 - done[t])
        adv[t] = last
    return adv, adv + value

# === wrong: `if done[t]` on a row of many environments is ambiguous | ambiguous|Boolean value
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    adv = torch.zeros_like(reward)
    last = torch.zeros(reward.shape[1])
    for t in reversed(range(len(reward))):
        if done[t]:
            last = torch.zeros(reward.shape[1])
        nv = 0.0 if terminated[t] else next_value[t]
        last = reward[t] + gamma * nv - value[t] + gamma * lam * last
        adv[t] = last
    return adv, adv + value

# === wrong: `done[t].any()`: one end cuts the chain of every environment | other environment|every environment|all (the )?environment|another environment|environments\b|each environment|\bany\b
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    adv = torch.zeros_like(reward)
    last = torch.zeros_like(reward[0])
    for t in reversed(range(len(reward))):
        delta = reward[t] + gamma * next_value[t] * ~terminated[t] - value[t]
        if done[t].any():
            last = torch.zeros_like(last)
        last = delta + gamma * lam * last
        adv[t] = last
    return adv, adv + value

# === wrong: where an episode ends the row keeps nothing, not even its own delta | \bends?\b|\bdone\b|delta|δ|last (row|step)|own reward
import torch


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    adv = torch.zeros_like(reward)
    last = torch.zeros_like(reward[0])
    for t in reversed(range(len(reward))):
        delta = reward[t] + gamma * next_value[t] * ~terminated[t] - value[t]
        last = (delta + gamma * lam * last) * ~done[t]
        adv[t] = last
    return adv, adv + value
