# %% [markdown]
# # 2 · LunarLander
#
# A lander, four commands, eight numbers to see, and −100 for a crash. PPO on sixteen parallel environments. You write the
# function in which a lander that hovers is told from one that crashed, and the critic's loss, and read a run's pictures.

# %%
import torch

import lemniscate as lem
from lemniscate import course
from lemniscate.algos import ppo
from lemniscate.report.playback import show_film

STEPS = 300_000

# %% [markdown]
# ## A time-out is not a death
#
# After 1,000 steps the time limit cuts an episode, whatever the lander is doing. The task has not ended there: the value
# of the state it was in goes on. So the row of a time-out bootstraps, and the row of a crash
# does not. Which flag belongs where?


# %%
def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    """(advantage, target), each [T, N]."""
    delta = reward + gamma * next_value * ~terminated - value
    advantage = torch.zeros_like(delta)
    trace = torch.zeros_like(delta[0])
    for t in reversed(range(len(delta))):
        trace = delta[t] + gamma * lam * trace * ~done[t]
        advantage[t] = trace
    return advantage, advantage + value


course.check(gae)


# %% [markdown]
# The critic is fitted to the target by half the mean square. Some clip how far a value may move from where it was when
# the data was collected; then the *larger* of the two errors counts.


# %%
def value_loss(value, target, old_value=None, clip=None):
    """A scalar."""
    error = (value - target).square()
    if clip is not None:
        near = old_value + (value - old_value).clamp(-clip, clip)
        error = torch.maximum(error, (near - target).square())
    return error.mean() / 2


course.check(value_loss)

# %% [markdown]
# ## Train, and read what happened
#
# The preset `lunar-lander` is chosen by the id. Sixteen environments, 8 epochs, γ = 0.999: a landing pays long after the
# decision that made it possible.

# %%
ppo.gae, ppo.value_loss = gae, value_loss
run = lem.train("ppo", env="LunarLander-v3", seed=1, total_steps=STEPS)
scores = lem.evaluate(run.policy, episodes=20, seed=0)
print(f"{scores.mean_return:.0f} ± {scores.std_return:.0f}")
pictures = lem.plot(run.path)

# %% [markdown]
# `losses/value` falls and `explained_variance` climbs towards 1: the critic predicts the returns well. `approx_kl` and
# `clip_fraction` say how far each update moved the policy. Entropy falls as the policy becomes more certain.

# %%
lem.watch(run.policy, video="lander.webp")
show_film("lander.webp")

# %% [markdown]
# **Try.** `gamma=0.9`: how does it land, and why? Take `done` for `terminated` in `gae`, and watch what becomes of hovering.
