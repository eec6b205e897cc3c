# %% [markdown]
# # 3 · DDPG on Hopper
#
# A leg that hops, three torques, and an off-policy algorithm: it learns from every step it ever took. You write the target
# of Q and the way in which the target networks follow, train, and measure the overestimation bias of Q.

# %%
import torch

import lemniscate as lem
from lemniscate import course
from lemniscate.algos import ddpg

STEPS = 30_000

# %% [markdown]
# ## The target
#
# Q(s, a) should be the reward plus the discounted value of what follows, as the *target* networks estimate it:
# $y = r + \gamma Q'(s', \mu'(s'))$. A fall ends the value. A time limit does not, which is why the replay buffer holds
# `terminated` alone.


# %%
def td_target(reward, next_value, terminated, *, gamma):
    """y, [B]."""
    return reward + gamma * next_value * ~terminated


course.check(td_target)


# %% [markdown]
# Q is trained towards a target made of Q, which is unstable. So the target is computed with *target networks*, copies that
# follow slowly: $\theta' \leftarrow (1 - \tau)\,\theta' + \tau\,\theta$, in place.


# %%
def polyak(target, online, tau):
    """Move each tensor of `target` towards its twin of `online`."""
    with torch.no_grad():
        for mine, theirs in zip(target, online, strict=True):
            mine.copy_((1 - tau) * mine + tau * theirs)


course.check(polyak)

# %% [markdown]
# ## Train
#
# `preset="course"` is the configuration of a university course: a million steps, an hour or two. Here are fewer, with
# smaller networks, to see the first progress.

# %%
ddpg.td_target, ddpg.polyak = td_target, polyak
run = lem.train(
    "ddpg",
    env="Hopper-v5",
    preset="course",
    seed=1,
    total_steps=STEPS,
    learning_starts=STEPS // 6,
    hidden=(64, 64),
    critic_hidden=(64, 64),
    evaluate_every=STEPS // 3,
)
pictures = lem.plot(run.path)

# %% [markdown]
# ## The overestimation bias of Q
#
# The curve `q` in the metrics is a mean over actions taken long ago: it cannot be compared with anything. Q at the first step
# of an episode can: with the discounted return of that episode.

# %%
scores = lem.evaluate(run.policy, episodes=10, seed=0)
print(scores.mean_return, "·", scores.q_bias)
print(scores.to_course())

# %% [markdown]
# **Try.** `network="layer_norm"` with `actor_learning_rate=1e-3, critic_learning_rate=1e-3`. `policy_delay=1`. A
# `td_target` that forgets `~terminated`: what does Q predict then? And exploration on the mountain
# car: [`docs/notes/exploration.md`](../notes/exploration.md).
