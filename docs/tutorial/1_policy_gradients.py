# %% [markdown]
# # 1 · From the policy gradient to PPO
#
# Four algorithms, one road: REINFORCE, A2C, TRPO, PPO. You write the three functions on which they differ, have each
# checked, put yours in the place of the library's, and watch what it does. The equations are in
# [`docs/notes`](../notes/reinforce.md); this is where they run.

# %%
import torch

import lemniscate as lem
from lemniscate import course
from lemniscate.algos import ppo, reinforce
from lemniscate.maths import Categorical

STEPS = 60_000

# %% [markdown]
# ## The theorem, on three levers
#
# A bandit pays 10, 11 or 12.5. The gradient of the expected pay is known exactly, so the estimate
# $\nabla \log \pi(a)\,\Psi$ can be held against it: with the pay itself for $\Psi$, and with the pay minus a baseline.

# %%
logits, pay = torch.tensor([0.3, -0.5, 1.1]), torch.tensor([10.0, 11.0, 12.5])
policy = logits.softmax(0)
exact = policy * (pay - policy @ pay)

action = Categorical(logits.expand(10_000, 3)).sample(torch.rand(10_000, generator=torch.Generator().manual_seed(0)))
score = torch.nn.functional.one_hot(action, 3) - policy  # ∇ log π(a) of a softmax
for name, baseline in {"none": 0.0, "its mean": policy @ pay}.items():
    samples = score * (pay[action] - baseline)[:, None]
    print(f"baseline {name:8}  mean {samples.mean(0).numpy().round(2)}  variance {samples.var(0).sum():.1f}")
print(f"exact              {exact.numpy().round(2)}")


# %% [markdown]
# Both means are the gradient to within their noise, and the second has a hundredth of the variance. That is all a baseline
# does, and it is a great deal.
#
# ## The reward-to-go
#
# An action can be blamed only for what came after it. Write the reward-to-go, for rows `[T, N]` of N environments:
# $G_t = r_t + \gamma G_{t+1}$ up to the end of the episode. Where rows run out, and where a time-out cut the episode,
# `next_value` stands for the rest; a death (`terminated`) has no rest.


# %%
def reward_to_go(reward, next_value, terminated, done, *, gamma):
    """The return from each action on, [T, N]."""
    go = torch.zeros_like(reward)
    follows = next_value[-1]  # of the row after the last
    for t in reversed(range(len(reward))):
        follows = torch.where(done[t], next_value[t], follows)
        follows = reward[t] + gamma * follows * ~terminated[t]
        go[t] = follows
    return go


course.check(reward_to_go)

# %% [markdown]
# Now break it: drop `~terminated[t]`, or the line with `torch.where`, and see what `course.check` says. When it is right,
# put it in the place of REINFORCE's own, and train.

# %%
reinforce.reward_to_go = reward_to_go
first = lem.train("reinforce", env="CartPole-v1", seed=1, total_steps=STEPS)
print(lem.evaluate(first.policy, episodes=20, seed=0).mean_return)


# %% [markdown]
# ## Looking one step ahead, or many
#
# A critic can stand for the rest after one step, or after two, or never. Generalized advantage estimation mixes them:
# $A_t = \delta_t + \gamma\lambda A_{t+1}$ with $\delta_t = r_t + \gamma V(s_{t+1}) - V(s_t)$. There are two flags, because
# there are two ends: a death ends the *value*, any end cuts the *chain*.


# %%
def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    """(advantage, target), each [T, N]."""
    advantage = torch.zeros_like(reward)
    trace = torch.zeros_like(reward[0])
    for t in reversed(range(len(reward))):
        delta = reward[t] + gamma * next_value[t] * ~terminated[t] - value[t]
        trace = delta + gamma * lam * trace * ~done[t]
        advantage[t] = trace
    return advantage, advantage + value


course.check(gae)


# %% [markdown]
# ## A step that is not too large
#
# PPO takes many steps on one rollout; its objective is flat where the ratio $r = \pi/\pi_{old}$ has left $[1-\epsilon,
# 1+\epsilon]$: $L = E[\min(rA, \mathrm{clip}(r, 1-\epsilon, 1+\epsilon)A)]$. It is a loss, so its sign is turned.


# %%
def clipped_surrogate(log_ratio, advantage, clip):
    """−L^CLIP, a scalar."""
    ratio = log_ratio.exp()
    return -torch.min(ratio * advantage, ratio.clamp(1 - clip, 1 + clip) * advantage).mean()


course.check(clipped_surrogate)

# %%
ppo.gae, ppo.clipped_surrogate = gae, clipped_surrogate
runs = [first] + [lem.train(name, env="CartPole-v1", seed=1, total_steps=STEPS) for name in ("a2c", "trpo", "ppo")]
pictures = lem.plot(*[run.path for run in runs])

# %% [markdown]
# One seed ranks nothing: which curve is higher here is chance as much as merit. `lemniscate train reinforce,a2c,trpo,ppo
# --env CartPole-v1 --seeds 1-5 --total-steps 100_000` says more.
#
# **Try.** REINFORCE with `learning_rate=0.1, final_learning_rate=1.0` and several seeds: how does it look, and how large is
# `approx_kl`? What becomes of PPO with `clip=10.0`? With a `gae` whose chain is not cut?
