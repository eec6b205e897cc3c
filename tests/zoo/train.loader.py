# === right: TensorDataset and DataLoader, advantages normalized per batch, clipped value loss
import numpy as np
import torch
import torch.nn.functional as F
from gymnasium.spaces import Discrete
from torch.utils.data import DataLoader, TensorDataset


class Brain(torch.nn.Module):
    def __init__(self, in_features, action_space, hidden=(64, 64)):
        super().__init__()
        self.is_discrete = isinstance(action_space, Discrete)
        self.n = int(action_space.n) if self.is_discrete else int(np.prod(action_space.shape))
        self.pi, self.vf = self.build(in_features, hidden, self.n, 0.01), self.build(in_features, hidden, 1, 1.0)
        self.register_parameter("std", None if self.is_discrete else torch.nn.Parameter(torch.zeros(self.n)))

    def build(self, size, hidden, out, gain):
        layers = []
        for h in hidden:
            lin = torch.nn.Linear(size, h)
            torch.nn.init.orthogonal_(lin.weight, gain=torch.nn.init.calculate_gain("tanh"))
            torch.nn.init.zeros_(lin.bias)
            layers.extend([lin, torch.nn.Tanh()])
            size = h
        last = torch.nn.Linear(size, out)
        torch.nn.init.orthogonal_(last.weight, gain=gain)
        torch.nn.init.zeros_(last.bias)
        return torch.nn.Sequential(*layers, last)

    def dist(self, x):
        if self.is_discrete:
            return torch.distributions.Categorical(F.softmax(self.pi(x), dim=-1))
        return torch.distributions.Normal(self.pi(x), self.std.exp())

    def logp(self, dist, a):
        lp = dist.log_prob(a)
        return lp if self.is_discrete else lp.sum(dim=-1)

    def act(self, obs):
        with torch.inference_mode():
            dist = self.dist(torch.as_tensor(np.asarray(obs, dtype=np.float32)))
            return (dist.probs.argmax(-1) if self.is_discrete else dist.mean).numpy()


def train(env, steps, seed=0, *, horizon=64, epochs=10, batch=128, lr=1.5e-3, gamma=0.98, lam=0.95, eps=0.2, vclip=1.0):
    torch.manual_seed(seed)
    brain = Brain(env.single_observation_space.shape[0], env.single_action_space)
    optim = torch.optim.Adam(brain.parameters(), lr=lr)
    total = max(1, steps // (horizon * env.num_envs))
    sched = torch.optim.lr_scheduler.LinearLR(optim, 1.0, 0.05, total)
    obs = env.reset(seed=seed)[0]
    for _ in range(total):
        O, A, LP, R, V, V2, D, E = [], [], [], [], [], [], [], []
        for _ in range(horizon):
            o = torch.from_numpy(obs).float()
            with torch.no_grad():
                dist = brain.dist(o)
                a = dist.sample()
                lp, v = brain.logp(dist, a), brain.vf(o).squeeze(1)
            obs, r, te, tr, info = env.step(a.numpy())
            nxt = torch.from_numpy(obs).float()
            over = te | tr
            if over.any():
                nxt = nxt.clone()
                nxt[torch.from_numpy(over)] = torch.from_numpy(np.stack(info["final_obs"][over])).float()
            with torch.no_grad():
                v2 = brain.vf(nxt).squeeze(1)
            for store, x in zip((O, A, LP, R, V, V2, D, E), (o, a, lp, torch.as_tensor(r), v, v2, torch.as_tensor(te), torch.as_tensor(over))):
                store.append(x)
        O, A, LP, R, V, V2, D, E = map(torch.stack, (O, A, LP, R, V, V2, D, E))
        adv, run = torch.empty_like(V), 0
        for t in range(horizon)[::-1]:
            run = R[t] + gamma * V2[t].masked_fill(D[t], 0.0) - V[t] + (gamma * lam * run * E[t].logical_not())
            adv[t] = run
        target = adv + V
        adv = (adv - adv.mean()) / adv.std().clamp(min=1e-6)
        data = TensorDataset(*(x.flatten(0, 1) for x in (O, A, LP, adv, target, V)))
        loader = DataLoader(data, batch_size=batch, shuffle=True, drop_last=False)
        for _ in range(epochs):
            for o, a, old_lp, g, tgt, old_v in loader:
                dist, v = brain.dist(o), brain.vf(o).squeeze(1)
                ratio = (brain.logp(dist, a) - old_lp).exp()
                pi_loss = torch.max(-g * ratio, -g * ratio.clamp(1 - eps, 1 + eps)).mean()
                v_clip = old_v + (v - old_v).clamp(-vclip, vclip)
                v_loss = torch.max((v - tgt) ** 2, (v_clip - tgt) ** 2).mean() / 2
                optim.zero_grad(set_to_none=True)
                (pi_loss + 0.5 * v_loss).backward()
                torch.nn.utils.clip_grad_norm_(brain.parameters(), 0.5)
                optim.step()
        sched.step()
    return brain

# === wrong: the probabilities are given as logits: softmax of a softmax | probab|logits?|softmax|Categorical
# --- instead of
            return torch.distributions.Categorical(F.softmax(self.pi(x), dim=-1))
# --- here
            return torch.distributions.Categorical(logits=F.softmax(self.pi(x), dim=-1))

# === wrong: DataLoader's columns in another order than the dataset's: advantage and target exchanged | swap|exchang|advantage|target|order|align
# --- instead of
        data = TensorDataset(*(x.flatten(0, 1) for x in (O, A, LP, adv, target, V)))
# --- here
        data = TensorDataset(*(x.flatten(0, 1) for x in (O, A, LP, target, adv, V)))

# === wrong: only the policy is trained: backward() of the value's loss is forgotten | value|critic
# --- instead of
                (pi_loss + 0.5 * v_loss).backward()
# --- here
                pi_loss.backward()

# === wrong: the value's clip takes min for max | value.*(clip|max|min)|max|min
# --- instead of
                v_loss = torch.max((v - tgt) ** 2, (v_clip - tgt) ** 2).mean() / 2
# --- here
                v_loss = torch.min((v - tgt) ** 2, (v_clip - tgt) ** 2).mean() / 2

# === wrong: the optimizer holds the parameters of another network: the brain that acts never learns | copy|unchanged|optimi[sz]er|(not|never|no).*(learn|chang|mov|updat)|same
# --- instead of
    optim = torch.optim.Adam(brain.parameters(), lr=lr)
# --- here
    optim = torch.optim.Adam(Brain(env.single_observation_space.shape[0], env.single_action_space).parameters(), lr=lr)

# === wrong: the learning rate is 0 all the time: the schedule is upside down | learning rate|\blr\b|schedule|zero|0|(not|never|no).*(learn|chang|mov|updat)
# --- instead of
    sched = torch.optim.lr_scheduler.LinearLR(optim, 1.0, 0.05, total)
# --- here
    sched = torch.optim.lr_scheduler.LambdaLR(optim, lambda i: float(i >= total))

# === wrong: clipped only from above: a ratio below 1 − ε goes on | clip|lower|below|1 ?[-−] ?|side
# --- instead of
                pi_loss = torch.max(-g * ratio, -g * ratio.clamp(1 - eps, 1 + eps)).mean()
# --- here
                pi_loss = torch.max(-g * ratio, -g * ratio.clamp(max=1 + eps)).mean()

# === wrong: the advantage is not detached and without no_grad: the policy's loss trains the critic | detach|no_grad|graph|gradient|critic|value|backward
# --- instead of
            with torch.no_grad():
                dist = brain.dist(o)
                a = dist.sample()
                lp, v = brain.logp(dist, a), brain.vf(o).squeeze(1)
# --- here
            dist = brain.dist(o)
            a = dist.sample()
            lp, v = brain.logp(dist, a).detach(), brain.vf(o).squeeze(1)
# --- instead of
        loader = DataLoader(data, batch_size=batch, shuffle=True, drop_last=False)
# --- here
        loader = [data[:]]
# --- instead of
                (pi_loss + 0.5 * v_loss).backward()
# --- here
                (pi_loss + 0.5 * v_loss).backward(retain_graph=True)
