# === right: shared trunk with two heads, log-softmax by hand, entropy bonus, AdamW, a dictionary as rollout
import gymnasium as gym
import numpy as np
import torch
from torch import nn


class Net(nn.Module):
    def __init__(self, n_in, n_out, discrete):
        super().__init__()
        self.discrete = discrete
        self.trunk = nn.ModuleList([nn.Linear(n_in, 128), nn.Linear(128, 128)])
        self.heads = nn.ModuleDict({"policy": nn.Linear(128, n_out), "value": nn.Linear(128, 1)})
        nn.init.normal_(self.heads["policy"].weight, std=0.01)
        nn.init.zeros_(self.heads["policy"].bias)
        self.rho = nn.Parameter(torch.zeros(n_out))

    def forward(self, x):
        for layer in self.trunk:
            x = torch.tanh(layer(x))
        return self.heads["policy"](x), self.heads["value"](x).squeeze(-1)

    def log_prob_entropy(self, out, a):
        if self.discrete:
            log_p = out - torch.logsumexp(out, dim=-1, keepdim=True)
            entropy = -(log_p.exp() * log_p).sum(dim=-1)
            return log_p.gather(-1, a.long().unsqueeze(-1)).squeeze(-1), entropy
        var = torch.exp(2 * self.rho)
        log_p = -((a - out) ** 2) / (2 * var) - self.rho - 0.5 * np.log(2 * np.pi)
        entropy = (self.rho + 0.5 * np.log(2 * np.pi * np.e)).sum().expand(len(out))
        return log_p.sum(-1), entropy

    def draw(self, out):
        if self.discrete:
            gumbel = -torch.log(-torch.log(torch.rand_like(out).clamp(1e-10, 1 - 1e-7)))
            return (out + gumbel).argmax(-1)
        return torch.normal(out, torch.exp(self.rho).expand_as(out))

    def act(self, obs):
        with torch.no_grad():
            out, _ = self(torch.as_tensor(obs).float())
        return (out.argmax(-1) if self.discrete else out).cpu().numpy()


def play(env, net, obs, length):
    keys = ("obs", "act", "logp", "rew", "nextobs", "term", "trunc")
    data = {k: [] for k in keys}
    for _ in range(length):
        x = torch.as_tensor(obs).float()
        with torch.no_grad():
            out, _ = net(x)
            a = net.draw(out)
            logp, _ = net.log_prob_entropy(out, a)
        new, rew, term, trunc, info = env.step(a.numpy())
        real = torch.as_tensor(new).float().clone()
        if "final_obs" in info:
            for i, last in enumerate(info["final_obs"]):
                if last is not None:
                    real[i] = torch.as_tensor(last).float()
        for k, v in zip(keys, (x, a, logp, torch.as_tensor(rew).float(), real, torch.as_tensor(term), torch.as_tensor(trunc))):
            data[k].append(v)
        obs = new
    return {k: torch.stack(v) for k, v in data.items()}, obs


@torch.no_grad()
def gae(net, d, g, l):
    _, v = net(d["obs"])
    _, v2 = net(d["nextobs"])
    td = d["rew"] + g * v2 * (~d["term"]).float() - v
    keep = (~(d["term"] | d["trunc"])).float()
    out, last = [], torch.zeros_like(td[0])
    for e, k in zip(td.flip(0), keep.flip(0)):
        last = e + g * l * k * last
        out.append(last)
    d["adv"] = torch.stack(out).flip(0)
    d["ret"] = d["adv"] + v


def train(envs, total_steps, seed):
    torch.manual_seed(seed)
    gen = torch.Generator().manual_seed(seed)
    discrete = isinstance(envs.single_action_space, gym.spaces.Discrete)
    n_out = envs.single_action_space.n if discrete else envs.single_action_space.shape[0]
    net = Net(envs.single_observation_space.shape[0], n_out, discrete)
    opt = torch.optim.AdamW(net.parameters(), lr=1e-3, weight_decay=1e-4)
    obs, _ = envs.reset(seed=seed)
    length, eps, g, l = 32, 0.2, 0.98, 0.9
    n_iter = max(1, total_steps // (length * envs.num_envs))
    for it in range(n_iter):
        d, obs = play(envs, net, obs, length)
        gae(net, d, g, l)
        flat = {k: v.flatten(0, 1) for k, v in d.items()}
        total = len(flat["rew"])
        opt.param_groups[0]["lr"] = 1e-3 * (n_iter - it) / n_iter
        for _ in range(8):
            order = torch.randperm(total, generator=gen)
            for chunk in order.split(64):
                b = {k: v[chunk] for k, v in flat.items()}
                A = (b["adv"] - b["adv"].mean()) / (b["adv"].std() + 1e-8)
                out, v = net(b["obs"])
                logp, ent = net.log_prob_entropy(out, b["act"])
                rho = (logp - b["logp"]).exp()
                obj = torch.minimum(rho * A, rho.clamp(1 - eps, 1 + eps) * A).mean()
                loss = -obj + 0.05 * (v - b["ret"]).pow(2).mean() - 0.005 * ent.mean()
                for p in net.parameters():
                    p.grad = None
                loss.backward()
                nn.utils.clip_grad_norm_(net.parameters(), 0.5)
                opt.step()
    return net

# === wrong: the entropy has the wrong sign: the bonus is a penalty | entropy
# --- instead of
                loss = -obj + 0.05 * (v - b["ret"]).pow(2).mean() - 0.005 * ent.mean()
# --- here
                loss = -obj + 0.05 * (v - b["ret"]).pow(2).mean() + 0.05 * ent.mean()

# === wrong: the objective is minimised instead of maximised | sign|minus|negat|maximi|ascent|descent|opposite
# --- instead of
                loss = -obj + 0.05 * (v - b["ret"]).pow(2).mean() - 0.005 * ent.mean()
# --- here
                loss = obj + 0.05 * (v - b["ret"]).pow(2).mean() - 0.005 * ent.mean()

# === wrong: the value's loss is forgotten in the sum | value|critic
# --- instead of
                loss = -obj + 0.05 * (v - b["ret"]).pow(2).mean() - 0.005 * ent.mean()
# --- here
                loss = -obj - 0.005 * ent.mean()

# === wrong: minibatch indices are applied to all columns but the old log-probability | old|log.?prob|row|index|align|minibatch|ratio
# --- instead of
                rho = (logp - b["logp"]).exp()
# --- here
                rho = (logp - flat["logp"][: len(chunk)]).exp()

# === wrong: one chunk of an epoch only is learned from | minibatch|chunk|first|rows?|all
# --- instead of
            for chunk in order.split(64):
# --- here
            for chunk in order.split(64)[:1]:

# === wrong: the chain runs backwards in time: flip is missing at the end | order|revers|align|row|backward|flip
# --- instead of
    d["adv"] = torch.stack(out).flip(0)
# --- here
    d["adv"] = torch.stack(out)

# === wrong: λ-chain forwards: no reversal at all | revers|backward|forward|order|chain|past
# --- instead of
    for e, k in zip(td.flip(0), keep.flip(0)):
# --- here
    for e, k in zip(td, keep):
# --- instead of
    d["adv"] = torch.stack(out).flip(0)
# --- here
    d["adv"] = torch.stack(out)

# === wrong: terminated | truncated cuts the bootstrap | time-?out|truncat|time limit|bootstrap
# --- instead of
    td = d["rew"] + g * v2 * (~d["term"]).float() - v
# --- here
    td = d["rew"] + g * v2 * (~(d["term"] | d["trunc"])).float() - v

# === wrong: log-softmax over the batch instead of the actions | softmax|dim|axis|batch|log.?prob|normali[sz]
# --- instead of
            log_p = out - torch.logsumexp(out, dim=-1, keepdim=True)
# --- here
            log_p = out - torch.logsumexp(out, dim=0, keepdim=True)

# === wrong: always the greedy action while collecting: no exploration | greedy|argmax|explor|sampl|drawn|log.?prob|same action|deterministic
# --- instead of
            gumbel = -torch.log(-torch.log(torch.rand_like(out).clamp(1e-10, 1 - 1e-7)))
            return (out + gumbel).argmax(-1)
# --- here
            return out.argmax(-1)
