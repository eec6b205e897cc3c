"""Replay buffers and what is put into them: the right ones pass, each well-known mistake is named."""

from types import SimpleNamespace

import numpy as np
import pytest

from course_findings import says
from lemniscate import course


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
