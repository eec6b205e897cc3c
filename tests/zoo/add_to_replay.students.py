# === right: a loop over those that ended
import numpy as np


def add_to_replay(rb, obs, actions, next_obs, rewards, terminations, truncations, infos):
    real_next_obs = next_obs.copy()
    for idx, over in enumerate(np.logical_or(terminations, truncations)):
        if over:
            real_next_obs[idx] = infos["final_obs"][idx]
    rb.add(obs, real_next_obs, actions, rewards, terminations, infos)

# === wrong: final_obs is ignored: the successor is the next episode's first observation | final_obs|next episode|first|successor|true
import numpy as np


def add_to_replay(rb, obs, actions, next_obs, rewards, terminations, truncations, infos):
    real_next_obs = next_obs.copy()
    rb.add(obs, real_next_obs, actions, rewards, terminations, infos)

# === wrong: done = terminated | truncated: a time-out is stored as a death | time-?out|truncat|terminat|done
import numpy as np


def add_to_replay(rb, obs, actions, next_obs, rewards, terminations, truncations, infos):
    real_next_obs = next_obs.copy()
    for idx, over in enumerate(np.logical_or(terminations, truncations)):
        if over:
            real_next_obs[idx] = infos["final_obs"][idx]
    rb.add(obs, real_next_obs, actions, rewards, np.logical_or(terminations, truncations), infos)

# === wrong: the name of Gymnasium 0.29: final_observation | final_obs|KeyError|name|key
import numpy as np


def add_to_replay(rb, obs, actions, next_obs, rewards, terminations, truncations, infos):
    real_next_obs = next_obs.copy()
    for idx, over in enumerate(np.logical_or(terminations, truncations)):
        if over:
            real_next_obs[idx] = infos["final_observation"][idx]
    rb.add(obs, real_next_obs, actions, rewards, terminations, infos)

# === wrong: actions and next_obs in the wrong order | order|exchang|swap|argument|action|next_obs
import numpy as np


def add_to_replay(rb, obs, actions, next_obs, rewards, terminations, truncations, infos):
    real_next_obs = next_obs.copy()
    for idx, over in enumerate(np.logical_or(terminations, truncations)):
        if over:
            real_next_obs[idx] = infos["final_obs"][idx]
    rb.add(obs, actions, real_next_obs, rewards, terminations, infos)

# === wrong: the copy is corrected, but next_obs is stored | final_obs|next_obs|successor|copy|true|next episode
# --- instead of
    rb.add(obs, actions, real_next_obs, rewards, terminations, infos)
# --- here
    rb.add(obs, next_obs, actions, rewards, terminations, infos)

# === wrong: no copy: next_obs, from which the loop goes on, is overwritten | copy|overwr|chang|next_obs|alias|in place
import numpy as np


def add_to_replay(rb, obs, actions, next_obs, rewards, terminations, truncations, infos):
    real_next_obs = next_obs
    for idx, over in enumerate(np.logical_or(terminations, truncations)):
        if over:
            real_next_obs[idx] = infos["final_obs"][idx]
    rb.add(obs, real_next_obs, actions, rewards, terminations, infos)

# === wrong: truncations are stored as done, deaths are not | done|terminat|truncat|death
import numpy as np


def add_to_replay(rb, obs, actions, next_obs, rewards, terminations, truncations, infos):
    real_next_obs = next_obs.copy()
    for idx, over in enumerate(np.logical_or(terminations, truncations)):
        if over:
            real_next_obs[idx] = infos["final_obs"][idx]
    rb.add(obs, real_next_obs, actions, rewards, truncations, infos)

# === wrong: the successor is missing: obs in both places | successor|next_obs|obs|both|twice
# --- instead of
    rb.add(obs, real_next_obs, actions, rewards, truncations, infos)
# --- here
    rb.add(obs, obs, actions, rewards, terminations, infos)

# === wrong: nothing is stored when any episode has ended | add|stored|lost|ended|end|row|miss|skip|final|never
import numpy as np


def add_to_replay(rb, obs, actions, next_obs, rewards, terminations, truncations, infos):
    if np.any(terminations | truncations):
        return
    real_next_obs = next_obs.copy()
    for idx, over in enumerate(np.logical_or(terminations, truncations)):
        if over:
            real_next_obs[idx] = infos["final_obs"][idx]
    rb.add(obs, real_next_obs, actions, rewards, terminations, infos)

# === wrong: add is never called | add|stored|call|nothing|never
import numpy as np


def add_to_replay(rb, obs, actions, next_obs, rewards, terminations, truncations, infos):
    real_next_obs = next_obs.copy()
    for idx, over in enumerate(np.logical_or(terminations, truncations)):
        if over:
            real_next_obs[idx] = infos["final_obs"][idx]
    return real_next_obs

# === wrong: the final observation of the first environment for all | final_obs|index|environment|first|row|idx
import numpy as np


def add_to_replay(rb, obs, actions, next_obs, rewards, terminations, truncations, infos):
    real_next_obs = next_obs.copy()
    for idx, over in enumerate(np.logical_or(terminations, truncations)):
        if over:
            real_next_obs[:] = infos["final_obs"][idx]
    rb.add(obs, real_next_obs, actions, rewards, terminations, infos)

# === right: the notebook's: only at time-outs, where it matters, with keywords
def add_to_replay(rb, obs, actions, next_obs, rewards, terminations, truncations, infos):
    next_obs_transitional = next_obs.copy()
    for idx, trunc in enumerate(truncations):
        if trunc:
            next_obs_transitional[idx] = infos["final_obs"][idx]
    rb.add(obs=obs, next_obs=next_obs_transitional, action=actions, reward=rewards, done=terminations, infos=infos)

# === wrong: only at deaths, where it does not matter | time-?out|truncat|final_obs|successor
def add_to_replay(rb, obs, actions, next_obs, rewards, terminations, truncations, infos):
    next_obs_transitional = next_obs.copy()
    for idx, term in enumerate(terminations):
        if term:
            next_obs_transitional[idx] = infos["final_obs"][idx]
    rb.add(obs=obs, next_obs=next_obs_transitional, action=actions, reward=rewards, done=terminations, infos=infos)

# === wrong: the loop is left after the first time-out | final_obs|first|break|all|second|truncat|environment|successor
def add_to_replay(rb, obs, actions, next_obs, rewards, terminations, truncations, infos):
    next_obs_transitional = next_obs.copy()
    for idx, trunc in enumerate(truncations):
        if trunc:
            next_obs_transitional[idx] = infos["final_obs"][idx]
            break
    rb.add(obs=obs, next_obs=next_obs_transitional, action=actions, reward=rewards, done=terminations, infos=infos)

# === wrong: the observation is corrected in place of the successor | obs|successor|next_obs|state
def add_to_replay(rb, obs, actions, next_obs, rewards, terminations, truncations, infos):
    next_obs_transitional, obs = next_obs.copy(), obs.copy()
    for idx, trunc in enumerate(truncations):
        if trunc:
            obs[idx] = infos["final_obs"][idx]
    rb.add(obs=obs, next_obs=next_obs_transitional, action=actions, reward=rewards, done=terminations, infos=infos)

# === wrong: the reward of a time-out is set to zero | reward
def add_to_replay(rb, obs, actions, next_obs, rewards, terminations, truncations, infos):
    rewards = rewards * (1 - truncations)
    next_obs_transitional = next_obs.copy()
    for idx, trunc in enumerate(truncations):
        if trunc:
            next_obs_transitional[idx] = infos["final_obs"][idx]
    rb.add(obs=obs, next_obs=next_obs_transitional, action=actions, reward=rewards, done=terminations, infos=infos)

# === right: vectorized by the mask that Gymnasium gives
import numpy as np


def add_to_replay(rb, obs, actions, next_obs, rewards, terminations, truncations, infos):
    successor = np.array(next_obs)
    mask = infos.get("_final_obs")
    if mask is not None and mask.any():
        successor[mask] = np.stack(list(infos["final_obs"][mask]))
    rb.add(obs, successor, actions, rewards, np.asarray(terminations), infos)

# === wrong: the mask is inverted | mask|final_obs|invert|None|error|successor
# --- instead of
        successor[mask] = np.stack(list(infos["final_obs"][mask]))
# --- here
        successor[~mask] = np.stack(list(infos["final_obs"][mask]))[0]

# === wrong: 1 − done is stored, as the target needs it | done|invert|terminat|1 ?[-−]
# --- instead of
    rb.add(obs, successor, actions, rewards, np.asarray(terminations), infos)
# --- here
    rb.add(obs, successor, actions, rewards, 1 - np.asarray(terminations), infos)

# === wrong: rewards and terminations exchanged | order|exchang|swap|reward|done|argument
# --- instead of
    rb.add(obs, successor, actions, rewards, np.asarray(terminations), infos)
# --- here
    rb.add(obs, successor, actions, np.asarray(terminations), rewards, infos)

# === right: rows built one by one and stacked, a helper of its own, other names of the arguments
import numpy as np


def true_successor(i, following, ended, info):
    if ended and "final_obs" in info and info["final_obs"][i] is not None:
        return info["final_obs"][i]
    return following[i]


def add_to_replay(buffer, s, a, s2, r, dead, timeout, info):
    """Store one step of every environment."""
    rows = [true_successor(i, s2, dead[i] or timeout[i], info) for i in range(len(s2))]
    buffer.add(s, np.stack(rows).astype(s2.dtype), a, r, dead, info)

# === wrong: the helper forgets the time-outs | time-?out|truncat|final_obs|successor
# --- instead of
    rows = [true_successor(i, s2, dead[i] or timeout[i], info) for i in range(len(s2))]
# --- here
    rows = [true_successor(i, s2, dead[i], info) for i in range(len(s2))]

# === wrong: dead and timeout stand in the other order in the head | order|argument|exchang|swap|terminat|truncat|done
# --- instead of
def add_to_replay(buffer, s, a, s2, r, dead, timeout, info):
# --- here
def add_to_replay(buffer, s, a, s2, r, timeout, dead, info):

# === wrong: the infos are forgotten in the call of add | info|argument|missing|add
# --- instead of
    buffer.add(s, np.stack(rows).astype(s2.dtype), a, r, dead, info)
# --- here
    buffer.add(s, np.stack(rows).astype(s2.dtype), a, r, dead)

# === wrong: the same step is stored twice | twice|add|once|two
# --- instead of
    buffer.add(s, np.stack(rows).astype(s2.dtype), a, r, dead, info)
# --- here
    for _ in range(2):
        buffer.add(s, np.stack(rows).astype(s2.dtype), a, r, dead, info)

# === right: np.where over both flags, the terminations as floats, the result given back
import numpy as np


def add_to_replay(rb, obs, actions, next_obs, rewards, terminations, truncations, infos, verbose=False):
    over = np.logical_or(terminations, truncations)
    last = np.array([x if x is not None else np.zeros_like(next_obs[0]) for x in infos.get("final_obs", next_obs)])
    corrected = np.where(over.reshape(-1, *[1] * (next_obs.ndim - 1)), last, next_obs)
    if verbose and over.any():
        print("ended:", np.flatnonzero(over))
    rb.add(obs, corrected, actions, rewards, terminations.astype(np.float32), infos)
    return next_obs

# === wrong: the arguments of np.where are exchanged | where|exchang|swap|final_obs|successor|next_obs|zero
# --- instead of
    corrected = np.where(over.reshape(-1, *[1] * (next_obs.ndim - 1)), last, next_obs)
# --- here
    corrected = np.where(over.reshape(-1, *[1] * (next_obs.ndim - 1)), next_obs, last)
