"""Exercises on the replay buffer: its contents, and the rows that go into it."""

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
from gymnasium import spaces

from lemniscate.course.exercise import Function, Note, call_by_name

SIZE = 6
COLUMNS = ("obs", "next_obs", "action", "reward", "done")
SAMPLED = ("observations", "next_observations", "actions", "rewards", "dones")
"""the attributes of a sample, in the order of the columns"""
ALIASES = {"actions": "action", "rewards": "reward", "dones": "done", "terminated": "done", "terminations": "done"}
"""other names of arguments of `add`"""


def _row(number: int) -> dict[str, Any]:
    """A transition in which every part says which one it is; every third one ends."""
    ones = np.full(1, number, dtype=np.float32)
    obs = np.stack([ones, ones], axis=1)
    return dict(zip(COLUMNS, (obs, obs + 0.5, ones[:, None] / 10, -ones, ones % 3 == 0), strict=True))


def _add(buffer: Any, row: dict[str, Any]) -> None:
    aliases = {name: row[column] for name, column in ALIASES.items()}
    call_by_name(buffer.add, **row, **aliases, infos=[{}])


def _sampled(buffer: Any, rows: int = 3000) -> dict[str, np.ndarray]:
    """Many samples, [rows, …] each, by column."""
    batch = buffer.sample(rows)
    parts = (np.asarray(getattr(batch, name)).reshape(rows, -1) for name in SAMPLED)
    return dict(zip(COLUMNS, parts, strict=True))


def replay_buffer(buffer: Function) -> Iterator[str]:
    """`ReplayBuffer(buffer_size, observation_space, action_space)` with `add` and `sample`."""
    box, act = spaces.Box(-np.inf, np.inf, (2,), np.float32), spaces.Box(-1, 1, (1,), np.float32)
    sizes = {"buffer_size": SIZE, "capacity": SIZE, "size": SIZE, "device": "cpu", "n_envs": 1}
    made = call_by_name(buffer, **sizes, observation_space=box, action_space=act, handle_timeout_termination=False)
    reused = _row(1)
    _add(made, reused)
    _add(made, _row(2))
    for name in ("obs", "next_obs", "action", "reward"):
        reused[name] += 100  # as an environment does that writes over its own arrays
    reused["done"][:] = True
    batch = _sampled(made)
    seen = set(batch["obs"][:, 0].tolist())
    if seen - {1.0, 2.0, 101.0}:
        yield "rows that were never written are sampled. Likely: it draws from the whole capacity."
    for name in COLUMNS:
        if np.isclose(batch[name].astype(float), np.ravel(reused[name])[0]).any():
            yield f"{name} of a stored row changed with the array that it came from. Likely: it is not copied."
    if len(seen) < 2:
        yield "of two stored rows one was found in 3000 samples."
    for number in range(3, 10):
        _add(made, _row(number))
    yield from _after_nine(_sampled(made))


def _after_nine(batch: dict[str, np.ndarray]) -> Iterator[str]:
    """Nine rows went into six places: 4 to 9 are left."""
    numbers = batch["obs"][:, 0]
    seen, counts = np.unique(numbers, return_counts=True)
    if set(seen.tolist()) != set(range(4, 10)):
        was = ", ".join(f"{number:g}" for number in seen)
        why = "the last place is never used, or sampled" if len(seen) == 5 else "the oldest rows are not overwritten"
        yield f"after nine rows in six places it holds {was}; it should hold 4 to 9. Likely: {why}."
    if counts.max() > 1.5 * counts.min():
        yield "some rows are sampled much more often than others; each should be as likely as any other."
    for name, want in (("action", numbers / 10), ("reward", -numbers), ("next_obs", numbers + 0.5)):
        if not np.allclose(batch[name][:, 0], want, atol=1e-5):
            yield f"{name} is of another row than obs. Likely: each part is drawn by indices of its own."
    if not np.array_equal(batch["done"][:, 0] > 0.5, numbers % 3 == 0):
        yield "done is not what was stored with the row."


def add_to_replay(function: Function) -> Iterator[str]:
    """`add_to_replay(rb, obs, actions, next_obs, rewards, terminations, truncations, infos)`, after each step.

    The environments are SAME_STEP: where one has ended, `next_obs` is the first of the next episode.
    """
    first_of_next, last = np.full(2, 7, np.float32), np.full(2, 3, np.float32)
    for end in ("", "death", "time-out"):
        stored: list[tuple[Any, dict[str, Any]]] = []
        rb = SimpleNamespace(add=lambda *args, **named: stored.append((args, named)))  # noqa: B023
        next_obs = np.stack([first_of_next if end else last, np.full(2, 5, np.float32)])
        finals = {"final_obs": np.array([last, None], dtype=object), "_final_obs": np.array([True, False])}
        flags = {"terminations": np.array([end == "death", False]), "truncations": np.array([end == "time-out", False])}
        number = np.arange(1, 3, dtype=np.float32)
        row = {"obs": np.stack([number, number], axis=1), "action": number[:, None] / 10, "reward": -number}
        given = {"obs": row["obs"].copy(), "actions": row["action"].copy(), "rewards": row["reward"].copy()}
        try:
            call_by_name(function, rb=rb, **given, next_obs=next_obs, **flags, infos=finals if end else {})
        except KeyError as error:
            if "final_observation" not in str(error):
                raise
            yield "infos has no final_observation: since Gymnasium 1.0 it is called final_obs."
        if len(stored) != 1:
            yield f"it adds {len(stored)} times; one call of rb.add has the rows of all environments."
        args, named = stored[0]
        order = dict(zip((*COLUMNS, "infos"), args, strict=False))
        order |= {ALIASES.get(name, name): value for name, value in named.items()}
        yield from _given(order, row)
        yield from _stored(order, end, last)


def _given(order: dict[str, Any], row: dict[str, np.ndarray]) -> Iterator[str]:
    """Sentences where a column is not there, or one that needs no change is not the step's."""
    for name in COLUMNS:
        if name not in order:
            yield f"rb.add(obs, next_obs, action, reward, done, infos) was not given {name}."
    for name, want in row.items():
        if not np.array_equal(np.ravel(order[name]), want.ravel()):
            yield (
                f"{name} is not that of the step. Likely: the order of the arguments, which is obs, next_obs, action,"
                " reward, done, infos."
            )


def _stored(order: dict[str, Any], end: str, last: np.ndarray) -> Iterator[str]:
    """Sentences where the end or the successor of the first environment's row is wrong."""
    done, next_obs = order["done"], order["next_obs"]
    if done[0] and end == "time-out":
        yield (
            "a time-out is stored as done, so nothing is bootstrapped from it. Likely: terminated | truncated; done is"
            " terminated alone."
        )
    if bool(done[0]) != (end == "death"):
        yield f"a {end or 'row within an episode'} is stored with done = {bool(done[0])}."
    if end and not np.array_equal(next_obs[0], last):
        said = f"the successor of a {end} is stored as the first observation of the next episode. Likely:"
        if end == "time-out":
            yield f'{said} infos["final_obs"] is not used.'
        yield Note(f"{said} final_obs is used at time-outs alone. After a death the target does not look at it.")
    if not np.array_equal(next_obs[1], np.full(2, 5)):
        yield "the successor of the other environment, which goes on, was changed."
