# %% [markdown]
# # 5 · PPO on Ant
#
# Four legs, eight torques, 105 numbers to see. You have derived the clipped surrogate. Here you write it, draw it, see how
# far it lets a policy go, put it in the place of the library's, and train an ant to walk.

# %%
from time import perf_counter

import envpool
import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np
import torch
from PIL import Image

import lemniscate as lem
from lemniscate import course
from lemniscate.algos import ppo
from lemniscate.data.rollout import collect, epoch_minibatches
from lemniscate.maths import clip_fraction, kl_k3, standardize
from lemniscate.report.curves import LiveCurve
from lemniscate.report.playback import show_film
from lemniscate.run.loggers import read_metrics

STEPS = 150_000
torch.set_num_threads(1)  # networks this small are quickest so

# %% [markdown]
# ## Sixteen ants
#
# PPO forgets its data after each update, so it needs much of it, quickly: N environments are stepped together. An ant
# that falls is reset by the vector. Gymnasium's does it in the step *after* the fall, and ignores the action of that step:
# such a row is no experience, and no loss may see it.
#
# By default `make_vec` steps them one after the other; `async` gives each a process, which pays where a step costs more
# than a message. EnvPool steps them with threads of C++. Nothing is learned here: no on-policy algorithm can be faster.

# %%
envs = gym.make_vec("Ant-v5", num_envs=16)
envs.reset(seed=0)
obs, reward, terminated, truncated, _ = envs.step(envs.action_space.sample())
print("observation", obs.shape, " action", envs.action_space.shape, " reward", reward.shape, " end", terminated.shape)


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
print("EnvPool", steps_per_second(envpool.make_gymnasium("Ant-v5", num_envs=16)))


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
for axes, A in zip(panels, (torch.tensor([1.0]), torch.tensor([-1.0])), strict=True):
    axes.plot(ratio, ratio * A, color="silver", linewidth=4, label="r A")
    axes.plot(ratio, [-clipped_surrogate(r.log()[None], A, 0.2) for r in ratio], label="L")
    axes.set(title=f"A = {A.item():+.0f}", xlabel="ratio r", ylabel="objective", xticks=[0.5, 0.8, 1, 1.2, 1.5])
    axes.legend(frameon=False)
    axes.grid(alpha=0.3)

cases = torch.tensor([[0.5, 1.0, 1.5], [0.5, 1.0, 1.5]], requires_grad=True)
(-6 * clipped_surrogate(cases.log().flatten(), torch.tensor([1.0] * 3 + [-1.0] * 3), 0.2)).backward()
for sign, slopes in zip(("+1", "−1"), cases.grad, strict=True):
    print(
        f"A = {sign}: the gradient in r is {slopes[0]:2.0f} at r = 0.5, {slopes[1]:2.0f} at 1, {slopes[2]:2.0f} at 1.5"
    )

# %% [markdown]
# Two of the six gradients are zero: of a good action that has become more likely by more than ε, and of a bad one that has
# become less likely. The other two outside the range went the *wrong* way, and are pulled back: that is what the minimum
# is for.
#
# ## How far one rollout carries
#
# Clipping takes an incentive away; it forbids nothing. So take many epochs on one rollout, and measure how far π is from
# π_old: the KL, and the share of ratios outside $1 \pm 0.2$.

# %%
ppo.clipped_surrogate = clipped_surrogate
config = lem.config_for("ppo", "Ant-v5", num_envs=16, num_steps=128)
env, _ = lem.make_envs(config)


def epochs_on_one_rollout(config, epochs=20):
    state = ppo.init(config, env.spec, env.device)
    state.optimizer.learning_rate = config.learning_rate
    env.restart(config.seed)
    rollout = collect(env, state.networks.policy, config.num_steps, state.rng.action)
    batch = ppo.advantages(config, state.networks, rollout)
    for _ in range(epochs):
        for rows in epoch_minibatches(rollout.valid_rows, rollout.num_rows, 256, state.rng.minibatch):
            ppo.learn(config, state, batch, rows[None], standardize(batch.advantage[rows])[None])
        with torch.no_grad():
            log_ratio = state.networks.policy(batch.obs).log_prob(batch.action) - batch.log_prob
        yield kl_k3(log_ratio), clip_fraction(log_ratio, 0.2)


figure, panels = plt.subplots(1, 2, figsize=(9, 3), layout="constrained")
for clip, name in ((0.1, "ε = 0.1"), (0.2, "ε = 0.2"), (1e6, "not clipped")):
    for axes, trace in zip(panels, zip(*epochs_on_one_rollout(config.replace(clip=clip)), strict=True), strict=True):
        axes.plot(range(1, len(trace) + 1), trace, label=name)
panels[0].set(title="KL from π_old to π", xlabel="epoch", yscale="log")
panels[1].set(title="share of ratios outside 1 ± 0.2", xlabel="epoch")
panels[0].legend(frameon=False)
for axes in panels:
    axes.grid(alpha=0.3)

# %% [markdown]
# ## Train
#
# The preset `ant` is chosen by the id: 64 ants, 10 epochs of 8 minibatches, and a learning rate that follows the KL.

# %%
run = lem.train("ppo", env="Ant-v5", seed=1, total_steps=STEPS, callbacks=[LiveCurve()])
pictures = lem.plot(run.path)

# %% [markdown]
# `approx_kl` stays near 0.01, since an epoch above twice that divides the learning rate by 1.5, and one below half of it
# multiplies it. `clip_fraction` is the share of ratios that the clip has stopped, or would have.
#
# ## Beside its ancestors
#
# On a rollout REINFORCE takes one step, TRPO one as long as the KL allows, PPO eighty small ones.

# %%
runs = [lem.train(name, env="Ant-v5", seed=1, total_steps=STEPS) for name in ("reinforce", "trpo")] + [run]
figure, panels = plt.subplots(1, 2, figsize=(9, 3), layout="constrained")
for one, kl in zip(runs, ("approx_kl", "kl", "approx_kl"), strict=True):
    lines = [line for line in read_metrics(one.path) if "episode/return" in line]
    panels[0].plot([line["step"] for line in lines], [line["episode/return"] for line in lines])
    panels[1].plot([line["step"] for line in lines], [line[kl] for line in lines], label=one.path.name)
panels[0].set(title="return of an episode", xlabel="environment steps")
panels[1].set(title="KL of an update", xlabel="environment steps", yscale="log", ylim=(1e-6, 1))
panels[1].legend(frameon=False)
for axes in panels:
    axes.grid(alpha=0.3)

# %% [markdown]
# One seed ranks nothing. REINFORCE's KL falls with its learning rate, which ends at 0.
#
# ## Evaluate, and look
#
# The policy acts by its mean, from starts that training never saw. An ant that stands still is paid 1 for each step on its
# legs, about 1,000 an episode; walking begins above that. The film is a plain loop of Gymnasium's, NumPy in, NumPy out.

# %%
scores = lem.evaluate(run.policy, episodes=10, seed=0)
print(f"{scores.mean_return:.0f} ± {scores.std_return:.0f}, {scores.terminated} of {scores.episodes} fell")

ant = gym.make("Ant-v5", render_mode="rgb_array", width=240, height=180)
obs, _ = ant.reset(seed=0)
frames = []
for t in range(200):
    obs, _, terminated, truncated, _ = ant.step(run.policy.act(obs))
    frames += [] if t % 2 else [Image.fromarray(ant.render())]
    if terminated or truncated:
        break
frames[0].save("ant.webp", save_all=True, append_images=frames[1:], duration=100, loop=0)
show_film("ant.webp")

# %% [markdown]
# `lemniscate train ppo --env Ant-v5 --total-steps 3_000_000 --seeds 1-5` takes eighteen minutes a seed on two cores, and
# ended at 4,773 ± 231, after a million steps it was at 2,799 ± 253; both measured with older code
# ([returns](../results.md)).
#
# **Try.** `clip=1e6`, with `desired_kl=None`: how large does the KL become, and what becomes of the walk? `epochs=1`? Half as
# many ants, HalfCheetah, Humanoid? And write the whole loop yourself: [`algos/ppo.py`](../../src/lemniscate/algos/ppo.py) is
# 170 lines.
