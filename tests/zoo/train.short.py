# === right: as short as it goes: a function that returns a function, batches of a quarter, no schedule
import gymnasium as gym
import torch
from torch.nn import Linear, Parameter, ParameterList, Sequential, Tanh
from torch.nn.utils import clip_grad_norm_


def train(envs, total_steps, seed):
    torch.manual_seed(seed)
    space, d = envs.single_action_space, envs.single_observation_space.shape[0]
    finite = isinstance(space, gym.spaces.Discrete)
    k = space.n if finite else space.shape[0]
    pi = Sequential(Linear(d, 64), Tanh(), Linear(64, 64), Tanh(), Linear(64, k))
    V = Sequential(Linear(d, 64), Tanh(), Linear(64, 64), Tanh(), Linear(64, 1))
    log_std = Parameter(torch.zeros(k))
    params = ParameterList([*pi.parameters(), *V.parameters(), log_std])
    opt = torch.optim.Adam(params, lr=7e-4)

    def dist(o):
        if finite:
            return torch.distributions.Categorical(logits=pi(o))
        return torch.distributions.MultivariateNormal(pi(o), torch.diag_embed(torch.exp(2 * log_std)))

    o = torch.tensor(envs.reset(seed=seed)[0])
    T, g, l = 64, 0.98, 0.95
    for _ in range(max(1, total_steps // T // envs.num_envs)):
        rows = []
        for _ in range(T):
            with torch.no_grad():
                a = dist(o).sample()
                new, r, term, trunc, info = envs.step(a.numpy())
                new = torch.tensor(new)
                true = new.clone()
                for i in range(len(r)):
                    if term[i] or trunc[i]:
                        true[i] = torch.tensor(info["final_obs"][i])
                term, trunc = torch.tensor(term), torch.tensor(trunc)
                delta = torch.tensor(r) + g * V(true).squeeze(1) * ~term - V(o).squeeze(1)
                rows.append([o, a, dist(o).log_prob(a), delta, V(o).squeeze(1), g * l * ~(term | trunc)])
            o = new
        A = 0
        for row in rows[::-1]:
            A = row[3] + row[5] * A
            row[3] = A
        obs, act, old, adv, val, _ = (torch.cat(x) for x in zip(*rows))
        goal, adv = adv + val, (adv - adv.mean()) / adv.std()
        for _ in range(12):
            for i in torch.randperm(len(adv)).chunk(4):
                ratio = (dist(obs[i]).log_prob(act[i]) - old[i]).exp()
                policy = torch.min(ratio * adv[i], ratio.clamp(0.8, 1.2) * adv[i]).mean()
                loss = (V(obs[i]).squeeze(1) - goal[i]).pow(2).mean() - policy
                opt.zero_grad()
                loss.backward()
                clip_grad_norm_(params, 1.0)
                opt.step()

    @torch.no_grad()
    def act(obs):
        out = pi(torch.as_tensor(obs))
        return (out.argmax(1) if finite else out).numpy()

    return act

# === wrong: the chain is added to the wrong row: A of the row before | align|row|advantage|shift|order
# --- instead of
            A = row[3] + row[5] * A
            row[3] = A
# --- here
            row[3], A = A + 0 * row[3], row[3] + row[5] * A

# === wrong: the old log-probabilities are joined env-major, the rest time-major | align|layout|order|row|flatten|major
# --- instead of
        obs, act, old, adv, val, _ = (torch.cat(x) for x in zip(*rows))
# --- here
        obs, act, old, adv, val, _ = (torch.cat(x) for x in zip(*rows))
        old = torch.stack([row[2] for row in rows], 1).flatten()

# === wrong: log σ is not among the optimizer's parameters | σ|sigma|std|optimi[sz]er|parameter
# --- instead of
    params = ParameterList([*pi.parameters(), *V.parameters(), log_std])
# --- here
    params = ParameterList([*pi.parameters(), *V.parameters()])

# === wrong: the upper bound of the clip is the lower one, a slip: 0.8 and 0.8 | clip|bound|upper|1 ?\+|side
# --- instead of
                policy = torch.min(ratio * adv[i], ratio.clamp(0.8, 1.2) * adv[i]).mean()
# --- here
                policy = torch.min(ratio * adv[i], ratio.clamp(0.8, 0.8) * adv[i]).mean()

# === wrong: the old log-probability is of the observation after the step | action|obs|align|row|log.?prob|state
# --- instead of
                rows.append([o, a, dist(o).log_prob(a), delta, V(o).squeeze(1), g * l * ~(term | trunc)])
# --- here
                rows.append([o, a, dist(new).log_prob(a), delta, V(o).squeeze(1), g * l * ~(term | trunc)])

# === wrong: a plain policy gradient: no ratio at all, log π · A for 12 epochs | ratio|log.?prob|importance|old|clip
# --- instead of
                policy = torch.min(ratio * adv[i], ratio.clamp(0.8, 1.2) * adv[i]).mean()
# --- here
                policy = (dist(obs[i]).log_prob(act[i]) * adv[i]).mean()

# === wrong: Box actions are unknown to it: it always makes a Categorical | Box|Categorical|continu|action|shape|error
# --- instead of
    finite = isinstance(space, gym.spaces.Discrete)
    k = space.n if finite else space.shape[0]
# --- here
    finite = True
    k = space.n
