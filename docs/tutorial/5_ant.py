# %% [markdown]
# # 5 · PPO on Ant
#
# Four legs, eight torques, 105 numbers to see. You have derived the clipped surrogate. Here you write it, draw it, see how
# far it lets a policy go, put it in the place of the library's, and train an ant to walk.

# %%
import os
from functools import partial
from pathlib import Path
from time import perf_counter

import envpool
import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np
import torch

import lemniscate as lem
from lemniscate import course
from lemniscate.algos import ppo
from lemniscate.data.rollout import collect
from lemniscate.maths import clip_fraction, kl_k3
from lemniscate.report.live import LiveCurve
from lemniscate.report.playback import save_frames, show_pictures
from lemniscate.run.loggers import read_metrics

STEPS = 150_000
torch.set_num_threads(1)  # networks this small are quickest so

# %% [markdown]
# ## Sixteen ants
#
# PPO forgets its data after each update, so it needs much of it, quickly: N environments are stepped together. An ant
# that falls is reset by the vector. Gymnasium's does it in the step *after* the fall, and ignores that step's action:
# such a row is no experience, and no loss may see it.

# %%
envs = gym.make_vec("Ant-v5", num_envs=16)
obs, _ = envs.reset(seed=0)
obs, reward, terminated, truncated, _ = envs.step(envs.action_space.sample())
print("observation", obs.shape, " action", envs.action_space.shape, " reward", reward.shape, " end", terminated.shape)

# %% [markdown]
# By default `make_vec` steps them one after the other; `async` gives each a process, which pays where a step costs more
# than a message. EnvPool steps them with threads of C++. Nothing is learned here: no on-policy algorithm can be faster.


# %%
def steps_per_second(envs):
    envs.reset()
    actions = np.random.default_rng(0).uniform(-1, 1, (STEPS // 500, 16, 8))
    began = perf_counter()
    for action in actions:
        envs.step(action)
    seconds = perf_counter() - began
    envs.close()
    return f"{16 * len(actions) / seconds:,.0f} steps/s"


print("sync   ", steps_per_second(envs))
print("async  ", steps_per_second(gym.make_vec("Ant-v5", num_envs=16, vectorization_mode="async")))
print("EnvPool", steps_per_second(envpool.make_gymnasium("Ant-v5", num_envs=16, num_threads=os.cpu_count())))


# %% [markdown]
# ## The clipped surrogate, case by case
#
# $L = E[\min(rA, \mathrm{clip}(r, 1-\epsilon, 1+\epsilon)A)]$ with $r = \pi(a|s)/\pi_{old}(a|s)$. As a loss, its sign is
# turned.


# %%
def clipped_surrogate(log_ratio, advantage, clip):
    """−L^CLIP, a scalar."""
    ratio = log_ratio.exp()
    return -torch.min(ratio * advantage, ratio.clamp(1 - clip, 1 + clip) * advantage).mean()


course.check(clipped_surrogate)

# %%
ratio = torch.linspace(0.4, 1.6, 241)
figure, panels = plt.subplots(1, 2, figsize=(9, 3), layout="constrained")
for axes, advantage in zip(panels, (1.0, -1.0), strict=True):
    axes.plot(ratio, ratio * advantage, color="silver", label="r A")
    axes.plot(ratio, [-clipped_surrogate(r.log(), torch.tensor(advantage), 0.2) for r in ratio], label="L")
    axes.set(title=f"A = {advantage:+.0f}", xlabel="ratio r", xticks=[0.4, 0.8, 1, 1.2, 1.6])
    axes.legend(frameon=False)
    for r in (0.5, 1.0, 1.5):
        log_ratio = torch.tensor(r).log().requires_grad_()
        objective = -clipped_surrogate(log_ratio, torch.tensor(advantage), 0.2)
        (slope,) = torch.autograd.grad(objective, log_ratio)
        print(f"A {advantage:+.0f}  r {r}  L {objective.item():+.1f}  gradient in r {slope / r + 0:+.0f}")

# %% [markdown]
# Two of the six gradients are zero: the good action that has become more likely by more than ε, and the bad one that has
# become less likely. The other two outside the range went the *wrong* way, and are pulled back. That is what the minimum
# is for.
#
# ## How far one rollout carries
#
# Clipping takes the incentive away; it forbids nothing. So collect one rollout, take many epochs on it, and measure how far
# π is from π_old: the KL, and the share of ratios outside $1 \pm 0.2$.

# %%
ppo.clipped_surrogate = clipped_surrogate
config = lem.config_for("ppo", "Ant-v5", num_envs=16, num_steps=128)
env, for_evaluation = lem.make_envs(config)


def epochs_on_one_rollout(config, epochs=20):
    state = ppo.init(config, env.spec, env.device)
    env.restart(config.seed)
    batch = ppo.advantages(config, state.networks, collect(env, state.networks.policy, config.num_steps, state.rng.action))
    for _ in range(epochs):
        for rows in torch.randperm(len(batch.advantage), generator=state.rng.minibatch).split(256):
            state.optimizer.step(partial(ppo.loss, config), batch[rows])
        with torch.no_grad():
            log_ratio = state.networks.policy(batch.obs).log_prob(batch.action) - batch.log_prob
        yield kl_k3(log_ratio), clip_fraction(log_ratio, 0.2)


figure, panels = plt.subplots(1, 2, figsize=(9, 3), layout="constrained")
for clip, name in ((0.1, "ε = 0.1"), (0.2, "ε = 0.2"), (1e6, "not clipped")):
    for axes, trace in zip(panels, zip(*epochs_on_one_rollout(config.replace(clip=clip)), strict=True), strict=True):
        axes.plot(range(1, len(trace) + 1), trace, label=name)
panels[0].set(title="KL(π_old, π)", xlabel="epoch", yscale="log")
panels[1].set(title="share of ratios outside 1 ± 0.2", xlabel="epoch")
panels[0].legend(frameon=False)

# %% [markdown]
# ## Train
#
# The preset `ant` is chosen by the id: 64 ants, 10 epochs, and a learning rate that follows the KL.

# %%
run = lem.train("ppo", env="Ant-v5", seed=1, total_steps=STEPS, callbacks=[LiveCurve()])

# %%
lines = read_metrics(run.path)
figure, panels = plt.subplots(1, 3, figsize=(12, 2.8), layout="constrained")
for axes, name in zip(panels, ("approx_kl", "clip_fraction", "learning_rate"), strict=True):
    axes.plot([line["step"] for line in lines], [line[name] for line in lines])
    axes.set(title=name, xlabel="environment steps", ylim=(0, None))
panels[0].axhline(0.01, color="silver", linestyle="--")

# %% [markdown]
# An epoch whose KL is above twice the dashed line divides the learning rate by 1.5, one below half of it multiplies it.
#
# ## Beside its ancestors
#
# REINFORCE takes one step on a rollout, TRPO one as long as the KL allows, PPO some eighty small ones.

# %%
others = [lem.train(name, env="Ant-v5", seed=1, total_steps=STEPS) for name in ("reinforce", "trpo")]
pictures = lem.plot(*[one.path for one in (*others, run)])

# %% [markdown]
# ## Evaluate, and look
#
# The policy acts by its mean, from starts that training never saw: NumPy in, NumPy out, in a plain loop of Gymnasium's.

# %%
scores = lem.evaluate(run.policy, episodes=20, seed=0)
print(f"{scores.mean_return:.0f} ± {scores.std_return:.0f}, {scores.terminated} of {scores.episodes} fell")

env = gym.make("Ant-v5", render_mode="rgb_array", width=240, height=180)
obs, _ = env.reset(seed=0)
frames = [env.render()]
for t in range(200):
    obs, _, terminated, truncated, _ = env.step(run.policy.act(obs))
    frames += [env.render()] if t % 2 else []
    if terminated or truncated:
        break
save_frames(frames, Path("ant.webp"), fps=10)
show_pictures([Path("ant.webp")])
