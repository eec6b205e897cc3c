"""Replay buffers and what is put into them: the right ones pass, each well-known mistake is named."""

import random
from collections import deque, namedtuple
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from course_findings import Solutions, passes_from_a_file, says
from lemniscate import course

ALL = Solutions()
is_right, is_wrong = ALL.is_right, ALL.is_wrong


class ReplayBuffer:
    """The usual ring; what is wrong with it is a class attribute."""

    not_copied = ()
    filled = True
    together = True
    wraps = True
    places = staticmethod(lambda size: size)

    def __init__(self, buffer_size, observation_space, action_space):
        self.size, self.written, self.rows = buffer_size, 0, {}
        self.empty = {
            "obs": np.zeros(2),
            "next_obs": np.zeros(2),
            "action": np.zeros(1),
            "reward": np.zeros(1),
            "done": np.zeros(1),
        }
        self.rows = [dict(self.empty) for _ in range(buffer_size)]

    def add(self, obs, next_obs, action, reward, done, infos):
        values = {"obs": obs[0], "next_obs": next_obs[0], "action": action[0], "reward": reward[0:1], "done": done[0:1]}
        copy = {name: value if name in self.not_copied else np.array(value) for name, value in values.items()}
        if self.wraps or self.written < self.size:
            self.rows[self.written % self.places(self.size)] = copy
        self.written += 1

    def sample(self, batch_size):
        high = min(self.written, self.places(self.size)) if self.filled else self.size
        rows = [np.random.randint(high, size=batch_size) for _ in range(5)]  # noqa: NPY002
        names = ("obs", "next_obs", "action", "reward", "done")
        chosen = dict(zip(names, rows[:1] * 5 if self.together else rows, strict=True))
        obs, next_obs, action, reward, done = (np.stack([self.rows[i][name] for i in chosen[name]]) for name in names)
        return SimpleNamespace(observations=obs, next_observations=next_obs, actions=action, rewards=reward, dones=done)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        *(
            ({"not_copied": (name,)}, f"{name} of a stored row changed with the array that it came from")
            for name in ("obs", "next_obs", "action", "reward", "done")
        ),
        ({"filled": False}, "rows that were never written are sampled"),
        ({"together": False}, "indices of its own"),
        ({"wraps": False}, "the oldest rows are not overwritten"),
        ({"places": staticmethod(lambda size: size - 1)}, "the last place is never used"),
    ],
)
def test_a_replay_buffer_keeps_the_last_rows_whole(wrong, words):
    assert course.check(ReplayBuffer)
    says(type("ReplayBuffer", (ReplayBuffer,), wrong), "ReplayBuffer", words)


def adder(
    done=lambda terminated, truncated: terminated, where=lambda t, u: t | u, key="final_obs", order=lambda *row: row
):
    def add_to_replay(rb, obs, actions, next_obs, rewards, terminations, truncations, infos):
        true_next = next_obs.copy()
        for i in np.flatnonzero(where(terminations, truncations)):
            true_next[i] = infos[key][i]
        rb.add(*order(obs, true_next, actions, rewards, done(terminations, truncations)), infos)

    return add_to_replay


def test_a_time_out_is_stored_with_its_true_successor_and_not_as_done():
    assert str(course.check(adder(), "add_to_replay")) == "✓ add_to_replay: right."
    assert course.check(adder(where=lambda terminated, truncated: truncated), "add_to_replay")

    def never(terminated, truncated):
        return terminated & False

    says(adder(done=lambda t, u: t | u), "add_to_replay", "Likely: terminated | truncated")
    for name, order in {
        "obs": lambda obs, next_obs, *rest: (next_obs, next_obs, *rest),
        "action": lambda obs, next_obs, action, reward, done: (obs, next_obs, 2 * action, reward, done),
        "reward": lambda obs, next_obs, action, reward, done: (obs, next_obs, action, reward * 0.1, done),
    }.items():
        says(adder(order=order), "add_to_replay", f"{name} is not that of the step")
    exchanged = adder(order=lambda obs, next_obs, action, reward, done: (obs, action, next_obs, reward, done))
    says(exchanged, "add_to_replay", "the order of the arguments, which is obs, next_obs, action, reward, done, infos")
    says(adder(done=never), "add_to_replay", "a death is stored with done = False")
    says(adder(where=never), "add_to_replay", 'infos["final_obs"] is not used')
    says(adder(key="final_observation"), "add_to_replay", "since Gymnasium 1.0 it is called final_obs")


# --- buffers in other styles ---

Samples = namedtuple("Samples", "observations actions next_observations dones rewards")


@is_right("ReplayBuffer")
class Ring:
    """Arrays of NumPy and several environments, as Stable-Baselines3's."""

    def __init__(self, buffer_size, observation_space, action_space, device="auto", n_envs=1):
        self.size, self.n_envs, self.position, self.is_full = max(buffer_size // n_envs, 1), n_envs, 0, False
        shapes = observation_space.shape, action_space.shape, observation_space.shape, (1,), (1,)
        self.parts = [np.zeros((self.size, n_envs, *shape), np.float32) for shape in shapes]

    def add(self, obs, next_obs, action, reward, done, infos):
        columns = obs, action, next_obs, np.reshape(done, (-1, 1)), np.reshape(reward, (-1, 1))
        for part, column in zip(self.parts, columns, strict=True):
            part[self.position] = column
        self.position = (self.position + 1) % self.size
        self.is_full = self.is_full or not self.position

    def high(self):
        return self.size if self.is_full else self.position

    def rows(self, batch_size):
        return np.random.randint(0, self.high(), size=batch_size)  # noqa: NPY002

    def sample(self, batch_size, env=None):
        rows, envs = self.rows(batch_size), np.random.randint(0, self.n_envs, size=batch_size)  # noqa: NPY002
        return Samples(*(torch.tensor(part[rows, envs]) for part in self.parts))


@is_right("ReplayBuffer")
class Deque:
    """Rows in a deque, arguments in another order, a dictionary, samples without replacement."""

    def __init__(self, capacity, obs_space=None, act_space=None):
        self.rows = deque(maxlen=capacity)

    def add(self, state, action, reward, next_state, done):
        for i in range(len(state)):
            self.rows.append([np.copy(part[i]) for part in (state, action, reward, next_state, done)])

    def sample(self, n):
        names = "observations", "actions", "rewards", "next_observations", "dones"
        columns = zip(*random.sample(self.rows, n), strict=True)
        return {name: torch.tensor(np.array(column)) for name, column in zip(names, columns, strict=True)}


@dataclass
class Batch:
    observations: torch.Tensor
    next_observations: torch.Tensor
    actions: torch.Tensor
    rewards: torch.Tensor
    dones: torch.Tensor


@is_right("ReplayBuffer")
class Tensors:
    """Tensors, a generator of its own without a seed, a dataclass, the names in the plural."""

    def __init__(self, max_size, observation_space, action_space, device="cpu", seed=None):
        self.size, self.written, self.generator = max_size, 0, np.random.default_rng(seed)
        shapes = observation_space.shape, observation_space.shape, action_space.shape, (), ()
        self.parts = [torch.zeros(max_size, *shape, device=device) for shape in shapes]

    def __len__(self):
        return min(self.written, self.size)

    def add(self, obs, next_obs, actions, rewards, terminations, infos=None):
        for row in zip(obs, next_obs, actions, rewards, terminations, strict=True):
            for part, value in zip(self.parts, row, strict=True):
                part[self.written % self.size] = torch.as_tensor(value)
            self.written += 1

    def sample(self, batch_size):
        rows = torch.as_tensor(self.generator.choice(len(self), batch_size, replace=False))
        return Batch(*(part[rows] for part in self.parts))


@is_right("ReplayBuffer")
class Liste:
    """Names that nobody knows, a named tuple; rows of several environments stay together."""

    def __init__(self, groesse, beobachtungen, aktionen):
        self.groesse, self.zeilen = groesse, []

    def add(self, beobachtung, folge, aktion, lohn, ende, *rest):
        self.zeilen = [*self.zeilen, (beobachtung + 0, folge + 0, aktion + 0, lohn + 0, ende.copy())][-self.groesse :]

    def sample(self, anzahl):
        zeilen = [self.zeilen[i] for i in torch.randint(len(self.zeilen), (anzahl,)).tolist()]
        obs, next_obs, action, reward, done = (np.concatenate(column) for column in zip(*zeilen, strict=True))
        return Samples(obs, action, next_obs, done, reward)


@is_right("ReplayBuffer")
class OfInfos(Deque):
    """Looks into the dictionary of the vector environment."""

    def add(self, obs, next_obs, action, reward, done, infos):
        super().add(obs, action, reward, infos.get("final_obs", next_obs), done)


@is_right("ReplayBuffer")
class OfListOfInfos(Deque):
    """Goes through a list of dictionaries, as Stable-Baselines3."""

    def add(self, obs, next_obs, action, reward, done, infos):
        for o, n, a, r, d, info in zip(obs, next_obs, action, reward, done, infos, strict=True):
            super().add(*(np.copy(part)[None] for part in (o, a, r, n, d and not info.get("TimeLimit.truncated"))))


@is_right("ReplayBuffer")
class SpinningUp(Ring):
    """Sizes in place of spaces, single words in a dictionary."""

    def __init__(self, obs_dim, act_dim, size):
        super().__init__(size, np.zeros(obs_dim), np.zeros(act_dim))

    def sample(self, batch_size=32):
        names = "obs", "act", "obs2", "done", "rew"
        return dict(zip(names, super().sample(batch_size), strict=True))


def test_a_dimension_of_environments_that_is_kept_is_noted():
    class Kept(Deque):
        def add(self, *row):
            self.rows.append([torch.tensor(part) for part in row[:5]])

        def sample(self, batch_size):
            obs, next_obs, action, reward, done = map(
                torch.stack, zip(*random.sample(self.rows, batch_size), strict=True)
            )
            return Samples(obs, action, next_obs, done, reward)

    assert "shape [3, 1, 2]; networks take [3, 2]" in passes_from_a_file(Kept, "ReplayBuffer")


def test_a_buffer_for_one_environment_passes_with_a_note():
    assert "of several it keeps the first alone" in passes_from_a_file(ReplayBuffer, "ReplayBuffer")
    alone = ring(__init__=lambda self, size, o, a: Ring.__init__(self, size, o, a))
    assert passes_from_a_file(alone, "ReplayBuffer") == "right."


def ring(**changes):
    return type("ReplayBuffer", (Ring,), changes)


def changed(change):
    """A ring whose samples are changed."""
    return ring(sample=lambda self, n: change(Ring.sample(self, n)))


def part_by_itself(place):
    def sample(self, n):
        batch, other = Ring.sample(self, n), Ring.sample(self, n)
        return Samples(*(other[i] if i == place else part for i, part in enumerate(batch)))

    return ring(sample=sample)


def neighbours(self, n):
    rows = self.rows(n)
    obs, action, _, done, reward = (torch.tensor(part[rows, 0]) for part in self.parts)
    return Samples(obs, action, torch.tensor(self.parts[0][(rows + 1) % self.high(), 0]), done, reward)


for words, solution in {
    "next_obs is of another row than obs. Likely: each part is drawn by indices": part_by_itself(2),
    "indices of its own": part_by_itself(4),
    "some places are never drawn": ring(rows=lambda self, n: np.arange(self.high() - n, self.high())),
    "places are never drawn": ring(rows=lambda self, n: np.arange(n)),
    "the last one is not drawn": ring(rows=lambda self, n: np.random.randint(0, max(self.high() - 1, 1), n)),  # noqa: NPY002
    "more often than others": ring(rows=lambda self, n: np.random.randint(0, self.high(), (2, n)).min(0)),  # noqa: NPY002
    "obs and next_obs are exchanged": changed(lambda b: b._replace(observations=b[2], next_observations=b[0])),
    "reward is of another row than obs. Likely: it is done": changed(lambda b: b._replace(rewards=b.dones)),
    "it is 1 − done": changed(lambda b: b._replace(dones=1 - b.dones)),
    "its sign": changed(lambda b: b._replace(rewards=-b.rewards)),
    "it is the next row's obs": ring(sample=neighbours),
    "next_obs is of another row than obs. Likely: it is obs": ring(
        add=lambda self, o, n, *rest: Ring.add(self, o, o, *rest)
    ),
    "of 2 sampled rows has shape [1, 2]; it should be [2, 2]": changed(lambda b: Samples(*(part[:1] for part in b))),
    "of 3 sampled rows has shape [6, 2]": ring(sample=lambda self, n: Ring.sample(self, self.high())),
    "returns has no observations": changed(tuple),
    "returns has no next_observations": changed(
        lambda b: {
            name.replace("vations", "vation") if "next" in name else name: b._asdict()[name] for name in b._fields
        }
    ),
    "rows of a batch belong together": ring(rows=lambda self, n: np.full(n, np.random.randint(self.high()))),  # noqa: NPY002
    "or neighbours are taken": ring(rows=lambda self, n: (np.random.randint(self.high()) + np.arange(n)) % self.high()),  # noqa: NPY002
    "reward is of another row": changed(lambda b: b._replace(rewards=b.rewards.round())),
    "add takes obs, next_obs, action, done, reward; a loop calls rb.add(obs, next_obs, action, reward, done": ring(
        add=lambda self, obs, next_obs, action, done, reward, infos: Ring.add(
            self, obs, next_obs, action, reward, done, infos
        )
    ),
    "it holds 2, 4, 6, 8": ring(
        __init__=lambda self, size, o, a, n_envs: Ring.__init__(self, size, o, a),
        add=lambda self, *row: Ring.add(self, *(part[-1:] for part in row[:5]), {}),
    ),
    "has no rewards": changed(lambda b: SimpleNamespace(obs=b[0], actions=b[1], dones=b[3], next_obs=b[2])),
    "the oldest rows": ring(add=lambda self, *row: None if self.is_full else Ring.add(self, *row)),
    "six places": ring(__init__=lambda self, buffer_size, o, a: Ring.__init__(self, buffer_size + 4, o, a)),
    "it raised AttributeError": ring(add=lambda self, *row: self.buffer.append(row)),
    "raised AttributeError": changed(lambda b: None),
    "it raised SystemExit": ring(sample=lambda self, n: exit()),
}.items():
    is_wrong("ReplayBuffer", words)(solution)

# --- rows in other styles ---


@is_right("add_to_replay")
def by_keywords(buffer, observations, actions, next_observations, rewards, terminated, truncated, info):
    real, ended = np.array(next_observations), np.logical_or(terminated, truncated)
    if ended.any():
        real[ended] = np.stack(info["final_obs"][ended])
    buffer.add(obs=observations, next_obs=real, action=actions, reward=rewards, dones=terminated, infos=info)


@is_right("add_to_replay")
def one_by_one(rb, obs, actions, next_obs, rewards, terminations, truncations, infos):
    for i in range(len(obs)):
        ended = "final_obs" in infos and (terminations[i] or truncations[i])
        rb.add(obs[i], infos["final_obs"][i] if ended else next_obs[i], actions[i], rewards[i], terminations[i], {})


@is_right("add_to_replay")
def by_mask(puffer, beob, akt, folge, lohn, tot, zeit, infos):
    ended, last = infos.get("_final_obs", np.zeros(len(beob), bool)), infos.get("final_obs", folge)
    rows = [last[i] if ended[i] else row for i, row in enumerate(folge)]
    puffer.add(beob, np.stack(rows), akt, lohn, tot.astype(np.float32), [infos] * len(beob))


@is_right("add_to_replay")
def of_numbers(rb, obs, actions, next_obs, rewards, terminations, truncations, infos):
    """For `final_obs` that is an array of numbers."""
    ended = (terminations | truncations)[:, None]
    true = np.where(ended, infos["final_obs"], next_obs).astype(np.float32) if ended.any() else next_obs
    rb.add(*map(torch.as_tensor, (obs, true, actions, rewards, terminations)), infos)


@is_right("add_to_replay")
def by_slices(rb, obs, actions, next_obs, rewards, terminations, truncations, infos):
    for i, ended in enumerate(terminations | truncations):
        row, true = slice(i, i + 1), next_obs[i : i + 1].copy()
        if ended:
            true[0] = infos["final_obs"][i]
        rb.add(obs[row], true, actions[row], rewards[row], terminations[row], [{}])


def without_a_copy(rb, obs, actions, next_obs, rewards, terminations, truncations, infos):
    for i in np.flatnonzero(terminations | truncations):
        next_obs[i] = infos["final_obs"][i]
    rb.add(obs, next_obs, actions, rewards, terminations, infos)


def until_the_first(rb, obs, actions, next_obs, rewards, terminations, truncations, infos):
    true_next = next_obs.copy()
    for i in np.flatnonzero(terminations | truncations)[:1]:
        true_next[i] = infos["final_obs"][i]
    rb.add(obs, true_next, actions, rewards, terminations, infos)


def of_the_first(rb, obs, actions, next_obs, rewards, terminations, truncations, infos):
    adder()(rb, obs[:1], actions[:1], next_obs[:1], rewards[:1], terminations[:1], truncations[:1], infos)


for words, solution in {
    "Likely: .copy() is missing": without_a_copy,
    "a death at the time limit is stored with done = False": adder(done=lambda t, u: t & ~u),
    "with done = True": adder(done=lambda t, u: ~t),
    "a death is stored with done = False": adder(done=lambda t, u: u),
    "is not used": adder(where=lambda t, u: t),
    'infos["final_obs"] is not used': until_the_first,
    "was not given infos": lambda rb, obs, actions, next_obs, rewards, terminations, *_: rb.add(
        obs, next_obs, actions, rewards, terminations
    ),
    "is not that of the step. Likely: the order": adder(order=lambda o, n, a, r, d: (o, a, r, n, d)),
    "obs is not that of the step. Likely: the order": adder(order=lambda o, n, a, r, d: (n, o, a, r, d)),
    "obs is not that of the step": of_the_first,
    "was not given done": lambda rb, obs, actions, next_obs, rewards, *_: rb.add(obs, next_obs, actions, rewards),
    "it adds 0 times": lambda rb, obs, actions, next_obs, rewards, terminations, truncations, infos: None,
    "it adds 2 times": lambda rb, *given: [adder()(rb, *given) for _ in range(2)],
    "it raised AttributeError": lambda rb, *given: rb.push(*given),
}.items():
    is_wrong("add_to_replay", words)(solution)


@pytest.mark.parametrize(("name", "solution"), ALL.right)
def test_a_right_one_in_another_style_passes(name, solution):
    passes_from_a_file(solution, name)


@pytest.mark.parametrize(
    ("name", "solution", "words"), ALL.wrong, ids=[f"{name}-{words}" for name, _, words in ALL.wrong]
)
def test_another_mistake_is_named(name, solution, words):
    says(solution, name, words)
