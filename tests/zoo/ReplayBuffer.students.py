# === right: a NumPy ring of rows, namedtuple of tensors
from collections import namedtuple

import numpy as np
import torch

Samples = namedtuple("Samples", ["observations", "actions", "next_observations", "dones", "rewards"])


class ReplayBuffer:
    def __init__(self, buffer_size, observation_space, action_space, device="cpu", handle_timeout_termination=False):
        self.size, self.device = int(buffer_size), device
        self.obs = np.zeros((self.size, *observation_space.shape), dtype=np.float32)
        self.next_obs = np.zeros_like(self.obs)
        self.actions = np.zeros((self.size, *action_space.shape), dtype=np.float32)
        self.rewards = np.zeros((self.size, 1), dtype=np.float32)
        self.dones = np.zeros((self.size, 1), dtype=np.float32)
        self.pos, self.full = 0, False

    def add(self, obs, next_obs, action, reward, done, infos):
        for i in range(len(obs)):
            self.obs[self.pos] = obs[i]
            self.next_obs[self.pos] = next_obs[i]
            self.actions[self.pos] = action[i]
            self.rewards[self.pos] = reward[i]
            self.dones[self.pos] = done[i]
            self.pos += 1
            if self.pos == self.size:
                self.full = True
                self.pos = 0

    def __len__(self):
        return self.size if self.full else self.pos

    def sample(self, batch_size):
        inds = np.random.randint(0, len(self), size=batch_size)
        to = lambda x: torch.as_tensor(x[inds], device=self.device)
        return Samples(to(self.obs), to(self.actions), to(self.next_obs), to(self.dones), to(self.rewards))

# === wrong: sampling beyond the filled part: rows of zeros | fill|zero|empty|beyond|never (added|written)|unwritten
# --- instead of
        inds = np.random.randint(0, len(self), size=batch_size)
# --- here
        inds = np.random.randint(0, self.size, size=batch_size)

# === wrong: each column is sampled with indices of its own | column|index|indices|independ|align|belong|together|row
# --- instead of
        to = lambda x: torch.as_tensor(x[inds], device=self.device)
# --- here
        to = lambda x: torch.as_tensor(x[np.random.randint(0, len(self), size=batch_size)], device=self.device)

# === wrong: one place of the ring is never written: the turn comes one too early | ring|off by one|oldest|last|one|size|overwr|place|capacity
# --- instead of
            if self.pos == self.size:
# --- here
            if self.pos == self.size - 1:

# === wrong: the turn of the ring comes one too late: an IndexError | index|bound|error|size|ring|full|overwr
# --- instead of
            if self.pos == self.size:
# --- here
            if self.pos > self.size:

# === wrong: full is never set: after the turn it forgets what it has | full|forget|old|size|len|sampl|turn|wrap
# --- instead of
                self.full = True
# --- here

# === wrong: done is always stored as 0 | done
# --- instead of
            self.dones[self.pos] = done[i]
# --- here

# === wrong: obs is stored in place of next_obs | next_obs|next_observations|successor|obs
# --- instead of
            self.next_obs[self.pos] = next_obs[i]
# --- here
            self.next_obs[self.pos] = obs[i]

# === wrong: the last row is always the one that is sampled | random|sampl|last|same|row
# --- instead of
        inds = np.random.randint(0, len(self), size=batch_size)
# --- here
        inds = np.full(batch_size, (self.pos - 1) % self.size)

# === right: the row of one environment, by index 0: with a note
# --- instead of
        for i in range(len(obs)):
# --- here
        """One environment, as in the notebook."""
        for i in range(1):

# === wrong: the buffer stops when it is full, in place of overwriting the oldest | old|overwr|full|stop|ring|new
# --- instead of
        for i in range(len(obs)):
# --- here
        for i in range(0 if self.full else len(obs)):

# === wrong: actions are stored as whole numbers | action|int|trunc|round|dtype|whole
# --- instead of
        self.actions = np.zeros((self.size, *action_space.shape), dtype=np.float32)
# --- here
        self.actions = np.zeros((self.size, *action_space.shape), dtype=np.int64)

# === wrong: reward and done are exchanged in add's order of arguments | order|argument|exchang|swap|done|reward
# --- instead of
    def add(self, obs, next_obs, action, reward, done, infos):
# --- here
    def add(self, obs, next_obs, action, done, reward, infos):

# === wrong: sample returns the columns in a bare tuple | observations|attribute|tuple|name
# --- instead of
        return Samples(to(self.obs), to(self.actions), to(self.next_obs), to(self.dones), to(self.rewards))
# --- here
        return to(self.obs), to(self.actions), to(self.next_obs), to(self.dones), to(self.rewards)

# === wrong: sample gives all that is there, whatever the number asked for | number|batch_size|asked|rows|many
# --- instead of
        inds = np.random.randint(0, len(self), size=batch_size)
# --- here
        inds = np.arange(len(self))

# === wrong: the size of the buffer is fixed | size|capacity|fixed|buffer_size|old|overwr
# --- instead of
        self.size, self.device = int(buffer_size), device
# --- here
        self.size, self.device = 1_000_000, device

# === right: a deque of tuples with maxlen, copies, random.sample's choices
import random
from collections import deque
from types import SimpleNamespace

import numpy as np
import torch


class ReplayBuffer:
    def __init__(self, buffer_size, observation_space=None, action_space=None, device=None, seed=None, **_):
        self.memory = deque(maxlen=buffer_size)
        self.device = device
        self.random = random.Random(seed)

    def add(self, obs, next_obs, action, reward, done, infos=None):
        for row in zip(obs, next_obs, action, reward, done):
            self.memory.append(tuple(np.array(x, dtype=np.float32) for x in row))

    def sample(self, n):
        rows = self.random.choices(self.memory, k=n)
        o, o2, a, r, d = (torch.from_numpy(np.stack(c)).to(self.device) for c in zip(*rows))
        return SimpleNamespace(observations=o, next_observations=o2, actions=a, rewards=r.view(-1, 1), dones=d.view(-1, 1))

    def __len__(self):
        return len(self.memory)

# === wrong: no copy: views of the environment's arrays, which it overwrites | copy|alias|overwr|view|same|chang
# --- instead of
            self.memory.append(tuple(np.array(x, dtype=np.float32) for x in row))
# --- here
            self.memory.append(tuple(np.asarray(x) for x in row))

# === wrong: no maxlen: it grows for ever | size|capacity|maxlen|grow|old|overwr|full
# --- instead of
        self.memory = deque(maxlen=buffer_size)
# --- here
        self.memory = deque()

# === wrong: the newest are thrown away: appendleft on a full deque | old|new|overwr|left|front|full|lost
# --- instead of
            self.memory.append(tuple(np.array(x, dtype=np.float32) for x in row))
# --- here
            if len(self.memory) < self.memory.maxlen:
                self.memory.append(tuple(np.array(x, dtype=np.float32) for x in row))

# === wrong: actions and next observations are taken in another order than they were stored | order|exchang|swap|action|shape|next_obs
# --- instead of
        o, o2, a, r, d = (torch.from_numpy(np.stack(c)).to(self.device) for c in zip(*rows))
# --- here
        o, a, o2, r, d = (torch.from_numpy(np.stack(c)).to(self.device) for c in zip(*rows))

# === wrong: the batch is one row, repeated | same|row|random|repeat|once|differ
# --- instead of
        rows = self.random.choices(self.memory, k=n)
# --- here
        rows = [self.random.choice(self.memory)] * n

# === right: torch storage, a dictionary of arrays, index arithmetic for N rows at once
from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class ReplayBufferSamples:
    observations: torch.Tensor
    actions: torch.Tensor
    next_observations: torch.Tensor
    dones: torch.Tensor
    rewards: torch.Tensor


class ReplayBuffer:
    """Columns of tensors."""

    columns = ("observations", "next_observations", "actions", "rewards", "dones")

    def __init__(self, buffer_size, observation_space, action_space, device=torch.device("cpu"), n_envs=1):
        self.capacity, self.written = buffer_size, 0
        shapes = (observation_space.shape, observation_space.shape, action_space.shape, (1,), (1,))
        self.store = {c: torch.empty(buffer_size, *s, device=device) for c, s in zip(self.columns, shapes)}

    def add(self, obs, next_obs, action, reward, done, infos=()):
        n = len(reward)
        where = torch.arange(self.written, self.written + n) % self.capacity
        for column, values in zip(self.columns, (obs, next_obs, action, reward, done)):
            values = torch.as_tensor(values, dtype=torch.float32)
            self.store[column][where] = values.reshape(n, *self.store[column].shape[1:])
        self.written += n

    @property
    def filled(self):
        return min(self.written, self.capacity)

    def sample(self, batch_size):
        i = torch.randint(self.filled, (batch_size,))
        return ReplayBufferSamples(**{c: x[i] for c, x in self.store.items()})

# === wrong: where is the same for all: only the first of N rows lasts | row|overwr|environment|first|last|lost
# --- instead of
        where = torch.arange(self.written, self.written + n) % self.capacity
# --- here
        where = torch.full((n,), self.written % self.capacity)

# === wrong: without the remainder: an error when the buffer is full | full|index|error|capacity|bound|wrap|size
# --- instead of
        where = torch.arange(self.written, self.written + n) % self.capacity
# --- here
        where = torch.arange(self.written, self.written + n)

# === wrong: the number that is filled is not bounded by the capacity | capacity|bound|index|error|full|beyond|size
# --- instead of
        return min(self.written, self.capacity)
# --- here
        return self.written

# === wrong: rewards are clipped to [−1, 1] as on Atari | reward|clip
# --- instead of
            values = torch.as_tensor(values, dtype=torch.float32)
# --- here
            values = torch.as_tensor(values, dtype=torch.float32)
            if column == "rewards":
                values = values.clamp(-1, 1)

# === wrong: the successor is not stored but taken from the next row | next|successor|row|end|follow
# --- instead of
        return ReplayBufferSamples(**{c: x[i] for c, x in self.store.items()})
# --- here
        rows = {c: x[i] for c, x in self.store.items()}
        rows["next_observations"] = self.store["observations"][(i + 1) % self.filled]
        return ReplayBufferSamples(**rows)

# === wrong: dones are inverted: 1 where it goes on | done|invert|1 ?[-−]|mask
# --- instead of
            self.store[column][where] = values.reshape(n, *self.store[column].shape[1:])
# --- here
            self.store[column][where] = values.reshape(n, *self.store[column].shape[1:])
        self.store["dones"][where] = 1 - self.store["dones"][where]

# === right: a list of dictionaries, popped at the front, a class for the batch that stacks lazily
import numpy as np
import torch


class Batch:
    def __init__(self, rows):
        self._rows = rows

    def _column(self, key):
        return torch.tensor(np.array([row[key] for row in self._rows]), dtype=torch.float32)

    observations = property(lambda self: self._column("s"))
    actions = property(lambda self: self._column("a"))
    next_observations = property(lambda self: self._column("s2"))
    rewards = property(lambda self: self._column("r").unsqueeze(1))
    dones = property(lambda self: self._column("d").unsqueeze(1))


class ReplayBuffer:
    def __init__(self, buffer_size: int, observation_space, action_space):
        self.limit = buffer_size
        self.rows = []

    def add(self, obs, next_obs, action, reward, done, infos):
        for s, s2, a, r, d in zip(obs.copy(), next_obs.copy(), np.copy(action), np.copy(reward), np.copy(done)):
            self.rows.append({"s": s, "a": a, "r": float(r), "s2": s2, "d": float(d)})
        while len(self.rows) > self.limit:
            self.rows.pop(0)

    def sample(self, n):
        picks = np.random.choice(len(self.rows), n)
        return Batch([self.rows[k] for k in picks])

# === wrong: the newest is popped, not the oldest | old|new|pop|overwr
# --- instead of
            self.rows.pop(0)
# --- here
            self.rows.pop()

# === wrong: the batch's rewards are taken out of d | reward|done
# --- instead of
    rewards = property(lambda self: self._column("r").unsqueeze(1))
# --- here
    rewards = property(lambda self: self._column("d").unsqueeze(1))

# === wrong: one more is kept than buffer_size | size|capacity|one|more|limit|old
# --- instead of
        while len(self.rows) > self.limit:
# --- here
        while len(self.rows) > self.limit + 1:

# === wrong: it clears everything when it is full | clear|full|forget|lost|empt|old
# --- instead of
        while len(self.rows) > self.limit:
            self.rows.pop(0)
# --- here
        if len(self.rows) >= self.limit:
            self.rows = []

# === right: the layout of Stable-Baselines3, [size, n_envs, …], with places drawn in both directions
from typing import NamedTuple

import numpy as np
import torch as th


class ReplayBufferSamples(NamedTuple):
    observations: th.Tensor
    actions: th.Tensor
    next_observations: th.Tensor
    dones: th.Tensor
    rewards: th.Tensor


class ReplayBuffer:
    def __init__(self, buffer_size, observation_space, action_space, device="auto", n_envs=1):
        self.total = buffer_size
        self.n_envs = None
        self.spaces = observation_space, action_space
        self.device = "cpu" if device == "auto" else device
        self.pos, self.full = 0, False

    def _allocate(self, n_envs):
        self.n_envs = n_envs
        self.length = max(self.total // n_envs, 1)
        shape = (self.length, n_envs)
        self.observations = np.zeros(shape + self.spaces[0].shape, dtype=self.spaces[0].dtype)
        self.next_observations = np.zeros_like(self.observations)
        self.actions = np.zeros(shape + self.spaces[1].shape, dtype=self.spaces[1].dtype)
        self.rewards, self.dones = np.zeros(shape, np.float32), np.zeros(shape, np.float32)

    def add(self, obs, next_obs, action, reward, done, infos):
        if self.n_envs is None:
            self._allocate(len(obs))
        self.observations[self.pos] = np.array(obs)
        self.next_observations[self.pos] = np.array(next_obs)
        self.actions[self.pos] = np.array(action).reshape(self.actions.shape[1:])
        self.rewards[self.pos] = np.array(reward)
        self.dones[self.pos] = np.array(done)
        self.pos = (self.pos + 1) % self.length
        self.full = self.full or self.pos == 0

    def sample(self, batch_size, env=None):
        upper = self.length if self.full else self.pos
        t = np.random.randint(0, upper, size=batch_size)
        n = np.random.randint(0, self.n_envs, size=batch_size)
        parts = self.observations[t, n], self.actions[t, n], self.next_observations[t, n], self.dones[t, n, None], self.rewards[t, n, None]
        return ReplayBufferSamples(*(th.as_tensor(np.array(p, dtype=np.float32), device=self.device) for p in parts))

# === wrong: the environment is drawn anew for each column | column|environment|align|independ|belong|together|row|index
# --- instead of
        parts = self.observations[t, n], self.actions[t, n], self.next_observations[t, n], self.dones[t, n, None], self.rewards[t, n, None]
# --- here
        parts = self.observations[t, n], self.actions[t, n], self.next_observations[t, n], self.dones[t, n, None], self.rewards[t, n, None]
        m = np.random.randint(0, len(t), size=batch_size)
        parts = (*parts[:4], parts[4][m])

# === wrong: done as it stands at the place before: position is moved on too early | done|off by one|place|row|align|shift|position
from typing import NamedTuple

import numpy as np
import torch as th


class ReplayBufferSamples(NamedTuple):
    observations: th.Tensor
    actions: th.Tensor
    next_observations: th.Tensor
    dones: th.Tensor
    rewards: th.Tensor


class ReplayBuffer:
    def __init__(self, buffer_size, observation_space, action_space, device="auto", n_envs=1):
        self.total = buffer_size
        self.n_envs = None
        self.spaces = observation_space, action_space
        self.device = "cpu" if device == "auto" else device
        self.pos, self.full = 0, False

    def _allocate(self, n_envs):
        self.n_envs = n_envs
        self.length = max(self.total // n_envs, 1)
        shape = (self.length, n_envs)
        self.observations = np.zeros(shape + self.spaces[0].shape, dtype=self.spaces[0].dtype)
        self.next_observations = np.zeros_like(self.observations)
        self.actions = np.zeros(shape + self.spaces[1].shape, dtype=self.spaces[1].dtype)
        self.rewards, self.dones = np.zeros(shape, np.float32), np.zeros(shape, np.float32)

    def add(self, obs, next_obs, action, reward, done, infos):
        if self.n_envs is None:
            self._allocate(len(obs))
        self.observations[self.pos] = np.array(obs)
        self.next_observations[self.pos] = np.array(next_obs)
        self.actions[self.pos] = np.array(action).reshape(self.actions.shape[1:])
        self.rewards[self.pos] = np.array(reward)
        self.pos = (self.pos + 1) % self.length
        self.dones[self.pos] = np.array(done)
        self.full = self.full or self.pos == 0

    def sample(self, batch_size, env=None):
        upper = self.length if self.full else self.pos
        t = np.random.randint(0, upper, size=batch_size)
        n = np.random.randint(0, self.n_envs, size=batch_size)
        parts = self.observations[t, n], self.actions[t, n], self.next_observations[t, n], self.dones[t, n, None], self.rewards[t, n, None]
        return ReplayBufferSamples(*(th.as_tensor(np.array(p, dtype=np.float32), device=self.device) for p in parts))

# === wrong: the newest row is never drawn: one is subtracted from an end that is exclusive already | last|newest|never|upper|off by one|row
from typing import NamedTuple

import numpy as np
import torch as th


class ReplayBufferSamples(NamedTuple):
    observations: th.Tensor
    actions: th.Tensor
    next_observations: th.Tensor
    dones: th.Tensor
    rewards: th.Tensor


class ReplayBuffer:
    def __init__(self, buffer_size, observation_space, action_space, device="auto", n_envs=1):
        self.total = buffer_size
        self.n_envs = None
        self.spaces = observation_space, action_space
        self.device = "cpu" if device == "auto" else device
        self.pos, self.full = 0, False

    def _allocate(self, n_envs):
        self.n_envs = n_envs
        self.length = max(self.total // n_envs, 1)
        shape = (self.length, n_envs)
        self.observations = np.zeros(shape + self.spaces[0].shape, dtype=self.spaces[0].dtype)
        self.next_observations = np.zeros_like(self.observations)
        self.actions = np.zeros(shape + self.spaces[1].shape, dtype=self.spaces[1].dtype)
        self.rewards, self.dones = np.zeros(shape, np.float32), np.zeros(shape, np.float32)

    def add(self, obs, next_obs, action, reward, done, infos):
        if self.n_envs is None:
            self._allocate(len(obs))
        self.observations[self.pos] = np.array(obs)
        self.next_observations[self.pos] = np.array(next_obs)
        self.actions[self.pos] = np.array(action).reshape(self.actions.shape[1:])
        self.rewards[self.pos] = np.array(reward)
        self.dones[self.pos] = np.array(done)
        self.pos = (self.pos + 1) % self.length
        self.full = self.full or self.pos == 0

    def sample(self, batch_size, env=None):
        upper = self.length if self.full else self.pos
        t = np.random.randint(0, max(upper - 1, 1), size=batch_size)
        n = np.random.randint(0, self.n_envs, size=batch_size)
        parts = self.observations[t, n], self.actions[t, n], self.next_observations[t, n], self.dones[t, n, None], self.rewards[t, n, None]
        return ReplayBufferSamples(*(th.as_tensor(np.array(p, dtype=np.float32), device=self.device) for p in parts))

# === wrong: the observations are kept in eight bits, as pictures | uint8|dtype|round|obs|precision|int
# --- instead of
        self.observations = np.zeros(shape + self.spaces[0].shape, dtype=self.spaces[0].dtype)
# --- here
        self.observations = np.zeros(shape + self.spaces[0].shape, dtype=np.int8)
# --- instead of
        t = np.random.randint(0, max(upper - 1, 1), size=batch_size)
# --- here
        t = np.random.randint(0, upper, size=batch_size)

# === right: pre-allocated structured array of NumPy, a permutation per sample when there is enough
import numpy as np
import torch


class ReplayBuffer:
    class Sample(dict):
        __getattr__ = dict.__getitem__

    def __init__(self, buffer_size, observation_space, action_space, rng=None):
        row = np.dtype(
            [
                ("observations", np.float32, observation_space.shape),
                ("actions", np.float32, action_space.shape),
                ("next_observations", np.float32, observation_space.shape),
                ("rewards", np.float32),
                ("dones", np.float32),
            ]
        )
        self.data = np.zeros(buffer_size, dtype=row)
        self.rng = rng or np.random.default_rng()
        self.count = 0

    def add(self, obs, next_obs, action, reward, done, infos):
        for o, o2, a, r, d in zip(obs, next_obs, action, reward, done, strict=True):
            self.data[self.count % self.data.size] = (o, a, o2, r, d)
            self.count += 1

    def sample(self, batch_size):
        have = min(self.count, self.data.size)
        chosen = self.data[self.rng.choice(have, batch_size, replace=batch_size > have)]
        return self.Sample({name: torch.tensor(chosen[name]) for name in chosen.dtype.names})

# === wrong: the count goes up once for each call, not for each row | row|environment|overwr|count|lost
# --- instead of
            self.count += 1
# --- here
        self.count += 1

# === wrong: sample has no return | None|return|nothing
# --- instead of
        return self.Sample({name: torch.tensor(chosen[name]) for name in chosen.dtype.names})
# --- here
        self.Sample({name: torch.tensor(chosen[name]) for name in chosen.dtype.names})

# === wrong: the field's name is misspelt: next_observation | next_observation|attribute|key|name|error
# --- instead of
                ("next_observations", np.float32, observation_space.shape),
# --- here
                ("next_observation", np.float32, observation_space.shape),

# === wrong: the reward is rounded to a whole number | reward|round|int|dtype
# --- instead of
                ("rewards", np.float32),
# --- here
                ("rewards", np.int32),

# === right: SB3-like with one environment, the arrays broadcast from [1, …]
import numpy as np
import torch


class ReplayBuffer:
    def __init__(self, buffer_size, observation_space, action_space, device="cpu", handle_timeout_termination=False):
        self.buffer_size, self.i, self.n, self.device = buffer_size, 0, 0, device
        self.s = np.empty((buffer_size, *observation_space.shape), np.float32)
        self.s2 = np.empty((buffer_size, *observation_space.shape), np.float32)
        self.a = np.empty((buffer_size, *action_space.shape), np.float32)
        self.r, self.d = np.empty((buffer_size, 1), np.float32), np.empty((buffer_size, 1), np.float32)

    def add(self, obs, next_obs, action, reward, done, infos):
        """One environment, as DDPG has here: the leading 1 is broadcast away."""
        i = self.i
        self.s[i], self.s2[i], self.a[i], self.r[i], self.d[i] = obs, next_obs, action, reward, done
        self.i = (i + 1) % self.buffer_size
        self.n = max(self.n, i + 1)

    def sample(self, n):
        index = np.random.choice(self.n, n)
        batch = type("Batch", (), {})()
        for name, array in (("observations", self.s), ("actions", self.a), ("next_observations", self.s2), ("rewards", self.r), ("dones", self.d)):
            setattr(batch, name, torch.from_numpy(array[index]).to(self.device))
        return batch

# === wrong: the end of the filled part follows the ring's place: after the turn only the new rows | turn|wrap|full|old|forget|filled|ring
# --- instead of
        self.n = max(self.n, i + 1)
# --- here
        self.n = self.i or self.buffer_size
