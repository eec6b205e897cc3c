"""Exercises on the replay buffer: its contents, and the rows that go into it."""

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
from gymnasium import spaces

from lemniscate.course.exercise import Function, Note, call_by_name

SIZE = 6


def _row(number: int, envs: int = 1) -> dict[str, Any]:
    """A transition in which every part says which one it is; every third one ends."""
    ones = np.full(envs, number, dtype=np.float32)
    obs = np.stack([ones, ones], axis=1)
    row = {"obs": obs, "next_obs": obs + 0.5, "action": ones[:, None] / 10, "reward": -ones, "done": ones % 3 == 0}
    names = {"actions": "action", "rewards": "reward", "dones": "done", "terminated": "done", "terminations": "done"}
    return {**row, **{other: row[name] for other, name in names.items()}, "infos": [{}] * envs}


def _made(buffer: Function) -> Any:
    box = spaces.Box(-np.inf, np.inf, (2,), np.float32)
    act = spaces.Box(-1, 1, (1,), np.float32)
    known = {"buffer_size": SIZE, "capacity": SIZE, "size": SIZE, "device": "cpu", "n_envs": 1}
    return call_by_name(buffer, **known, observation_space=box, action_space=act, handle_timeout_termination=False)


def _sampled(made: Any, rows: int = 3000) -> dict[str, np.ndarray]:
    """Many samples, [rows, …] each."""
    batch = made.sample(rows)
    names = {"obs": "observations", "action": "actions", "next_obs": "next_observations", "done": "dones"}
    return {
        name: np.asarray(getattr(batch, their)).reshape(rows, -1)
        for name, their in {**names, "reward": "rewards"}.items()
    }


def replay_buffer(buffer: Function) -> Iterator[str]:
    """`ReplayBuffer(buffer_size, observation_space, action_space)` with `add` and `sample`."""
    made = _made(buffer)
    reused = _row(1)
    call_by_name(made.add, **reused)
    call_by_name(made.add, **_row(2))
    for name in ("obs", "next_obs", "action", "reward"):
        reused[name] += 100  # as an environment does that writes over its own arrays
    reused["done"][:] = True
    batch = _sampled(made)
    seen = set(batch["obs"][:, 0].tolist())
    if seen - {1.0, 2.0, 101.0}:
        yield "rows that were never written are sampled. Likely: it draws from the whole capacity."
    for name, changed in (("obs", 101), ("next_obs", 101.5), ("action", 100.1), ("reward", 99), ("done", True)):
        if np.isclose(batch[name].astype(float), changed).any():
            yield f"{name} of a stored row changed with the array that it came from. Likely: it is not copied."
    if len(seen) < 2:
        yield "of two stored rows one was found in 3000 samples."
    for number in range(3, 10):
        call_by_name(made.add, **_row(number))
    yield from _after_nine(_sampled(made))


def _after_nine(batch: dict[str, np.ndarray]) -> Iterator[str]:
    """Nine rows went into six places: 4 to 9 are left."""
    numbers = batch["obs"][:, 0]
    seen, counts = np.unique(numbers, return_counts=True)
    if set(seen.tolist()) != set(range(4, 10)):
        was = ", ".join(f"{number:g}" for number in seen)
        why = "the last place is never used, or sampled" if len(seen) == 5 else "the oldest rows are not overwritten"
        yield f"after nine rows in six places it holds {was}; it should hold 4 to 9. Likely: {why}."
        return
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
    for terminated, truncated in ((False, False), (True, False), (False, True)):
        stored: list[Any] = []
        rb = SimpleNamespace(add=lambda *args, **named: stored.append((args, named)))  # noqa: B023
        ended = terminated or truncated
        next_obs = np.stack([first_of_next if ended else last, np.full(2, 5, np.float32)])
        infos = (
            {"final_obs": np.array([last, None], dtype=object), "_final_obs": np.array([True, False])} if ended else {}
        )
        flags = {"terminations": np.array([terminated, False]), "truncations": np.array([truncated, False])}
        number = np.arange(1, 3, dtype=np.float32)
        row = {"obs": np.stack([number, number], axis=1), "action": number[:, None] / 10, "reward": -number}
        given = {"obs": row["obs"].copy(), "actions": row["action"].copy(), "rewards": row["reward"].copy()}
        try:
            call_by_name(function, rb=rb, **given, next_obs=next_obs.copy(), **flags, infos=infos)
        except KeyError as error:
            if "final_observation" in str(error):
                yield "infos has no final_observation: since Gymnasium 1.0 it is called final_obs."
                return
            raise
        if len(stored) != 1:
            yield f"it adds {len(stored)} times; one call of rb.add has the rows of all environments."
            return
        order = _columns(*stored[0])
        yield from _given(order, row)
        yield from _stored(order, terminated, truncated, last)


def _columns(args: tuple[Any, ...], named: dict[str, Any]) -> dict[str, Any]:
    """The arguments of `rb.add`, by the names of its parameters."""
    same = {"actions": "action", "rewards": "reward", "dones": "done", "terminations": "done"}
    by_place = dict(zip(("obs", "next_obs", "action", "reward", "done", "infos"), args, strict=False))
    return by_place | {same.get(name, name): value for name, value in named.items()}


def _given(order: dict[str, Any], row: dict[str, np.ndarray]) -> Iterator[str]:
    """Whether each column is there, and those that need no change are the step's."""
    for name in ("obs", "next_obs", "action", "reward", "done"):
        if name not in order:
            yield f"rb.add(obs, next_obs, action, reward, done, infos) was not given {name}."
            return
    for name, want in row.items():
        if not np.array_equal(np.ravel(order[name]), want.ravel()):
            yield (
                f"{name} is not that of the step. Likely: the order of the arguments, which is obs, next_obs, action,"
                " reward, done, infos."
            )


def _stored(order: dict[str, Any], terminated: bool, truncated: bool, last: np.ndarray) -> Iterator[str]:
    done, what = order["done"], "time-out" if truncated else "death"
    if bool(done[0]) and truncated:
        yield (
            "a time-out is stored as done, so nothing is bootstrapped from it. Likely: terminated | truncated; done is"
            " terminated alone."
        )
    elif bool(done[0]) != terminated:
        yield f"a {what} is stored with done = {bool(done[0])}."
    if (terminated or truncated) and not np.array_equal(order["next_obs"][0], last):
        said = f"the successor of a {what} is stored as the first observation of the next episode. Likely:"
        if truncated:
            yield f'{said} infos["final_obs"] is not used.'
        else:
            yield Note(f"{said} final_obs is used at time-outs alone. After a death the target does not look at it.")
    if not np.array_equal(order["next_obs"][1], np.full(2, 5)):
        yield "the successor of the other environment, which goes on, was changed."
