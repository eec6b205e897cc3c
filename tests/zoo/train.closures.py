# === right: functions and closures only, a ModuleDict, state-dependent σ, an object made of a function
import types

import gymnasium as gym
import numpy as np
import torch
from torch import nn
from torch.distributions import Categorical, Normal, kl_divergence


def make_nets(obs_space, act_space):
    discrete = isinstance(act_space, gym.spaces.Discrete)
    d, k = int(np.prod(obs_space.shape)), act_space.n if discrete else 2 * act_space.shape[0]
    stack = lambda out: nn.Sequential(nn.Flatten(), nn.Linear(d, 64), nn.SiLU(), nn.Linear(64, 64), nn.SiLU(), nn.Linear(64, out))
    nets = nn.ModuleDict(dict(actor=stack(k), critic=stack(1)))
    with torch.no_grad():
        nets["actor"][-1].weight.mul_(0.05)
        nets["actor"][-1].bias.zero_()

    def policy(o):
        out = nets["actor"](o)
        if discrete:
            return Categorical(logits=out)
        mean, log_std = out.chunk(2, dim=-1)
        return Normal(mean, log_std.clamp(-3, 1).exp())

    def log_prob(pi, a):
        lp = pi.log_prob(a)
        return lp if discrete else lp.sum(-1)

    def act(obs):
        with torch.no_grad():
            pi = policy(torch.as_tensor(obs, dtype=torch.float32))
        return (pi.logits.argmax(-1) if discrete else pi.loc).numpy()

    return nets, policy, log_prob, act


def gather(envs, obs, policy, log_prob, n):
    out = []
    for _ in range(n):
        o = torch.as_tensor(obs, dtype=torch.float32)
        with torch.no_grad():
            pi = policy(o)
            a = pi.sample()
            lp = log_prob(pi, a)
        obs, r, term, trunc, info = envs.step(a.numpy())
        nxt = torch.as_tensor(obs, dtype=torch.float32).clone()
        mask = info.get("_final_obs", np.zeros(envs.num_envs, dtype=bool))
        for i in mask.nonzero()[0]:
            nxt[i] = torch.as_tensor(info["final_obs"][i])
        out.append((o, a, lp, torch.as_tensor(r), nxt, torch.as_tensor(term), torch.as_tensor(trunc)))
    return [torch.stack(c) for c in zip(*out)], obs


def advantage_of(r, v, v2, term, trunc, gamma, lam):
    """All at once: A = M δ with M[t, k] = Π of γλ over the steps from t to k that do not end."""
    T = len(r)
    delta = r + gamma * v2 * ~term - v
    step = gamma * lam * (~(term | trunc)).float()
    M = torch.zeros(T, T, r.shape[1])
    for t in range(T):
        M[t, t] = 1
        M[t, t + 1 :] = step[t : T - 1].cumprod(0)
    return torch.einsum("tkn,kn->tn", M, delta)


def train(envs, total_steps, seed):
    rng = np.random.RandomState(seed)
    torch.manual_seed(seed)
    nets, policy, log_prob, act = make_nets(envs.single_observation_space, envs.single_action_space)
    value = lambda o: nets["critic"](o.flatten(0, -2)).reshape(o.shape[:-1])
    opt = torch.optim.Adam(nets.parameters(), lr=1e-3)
    obs, _ = envs.reset(seed=seed)
    T, gamma, lam, eps = 32, 0.98, 0.92, 0.2
    n_updates = max(1, total_steps // (T * envs.num_envs))
    for u in range(n_updates):
        opt.param_groups[0]["lr"] = 1e-3 * max(0.05, 1 - u / n_updates)
        (o, a, lp, r, nxt, term, trunc), obs = gather(envs, obs, policy, log_prob, T)
        with torch.no_grad():
            v, v2 = value(o), value(nxt)
        adv = advantage_of(r, v, v2, term, trunc, gamma, lam)
        B = r.numel()
        o, a, lp, adv, ret = o.view(B, -1), a.view(B, *a.shape[2:]), lp.view(B), adv.reshape(B), (adv + v).reshape(B)
        with torch.no_grad():
            before = policy(o)
        for epoch in range(10):
            perm = rng.permutation(B)
            for k in range(0, B, 128):
                i = perm[k : k + 128]
                g = (adv[i] - adv[i].mean()) / (adv[i].std() + 1e-8)
                ratio = (log_prob(policy(o[i]), a[i]) - lp[i]).exp()
                surr = torch.stack([ratio * g, ratio.clamp(1 - eps, 1 + eps) * g]).amin(0)
                loss = (nets["critic"](o[i]).view(-1) - ret[i]).square().mean() - surr.mean()
                opt.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(nets.parameters(), 0.5)
                opt.step()
            with torch.no_grad():
                if kl_divergence(before, policy(o)).mean() > 0.05:
                    break
    return types.SimpleNamespace(act=act, nets=nets)

# === wrong: the epochs' loop is left before its first step: nothing is learned | epoch|step|break|KL|(not|never|no).*(learn|chang|mov|updat)|unchanged
# --- instead of
            perm = rng.permutation(B)
# --- here
            perm = rng.permutation(B)
            if u >= 0:
                break

# === wrong: of a Box action the log-probability of the first dimension only | sum|dimension|log.?prob|joint
# --- instead of
        return lp if discrete else lp.sum(-1)
# --- here
        return lp if discrete else lp[..., 0]

# === wrong: the advantages are divided by their standard deviation, and their mean is added | normali[sz]|mean|subtract|advantage
# --- instead of
                g = (adv[i] - adv[i].mean()) / (adv[i].std() + 1e-8)
# --- here
                g = (adv[i] + adv[i].mean()) / (adv[i].std() + 1e-8)

# === wrong: the minibatch's actions are taken by position, not by the shuffled index | index|action|row|align|shuffl
# --- instead of
                ratio = (log_prob(policy(o[i]), a[i]) - lp[i]).exp()
# --- here
                ratio = (log_prob(policy(o[i]), a[k : k + 128]) - lp[i]).exp()

# === wrong: the reward is missing in the TD error | reward|TD error|advantage
# --- instead of
    delta = r + gamma * v2 * ~term - v
# --- here
    delta = gamma * v2 * ~term - v

# === wrong: an exception: final_observation is the name in Gymnasium 0.29 | final_obs|KeyError|name
# --- instead of
        mask = info.get("_final_obs", np.zeros(envs.num_envs, dtype=bool))
        for i in mask.nonzero()[0]:
            nxt[i] = torch.as_tensor(info["final_obs"][i])
# --- here
        for i in (term | trunc).nonzero()[0]:
            nxt[i] = torch.as_tensor(info["final_observation"][i])

# === wrong: it returns nothing | None|return|nothing|\bact\b
# --- instead of
    return types.SimpleNamespace(act=act, nets=nets)
# --- here
    print("done", n_updates)
