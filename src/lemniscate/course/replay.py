"""What a replay buffer has to keep, and what has to be put into it."""

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
    return {
        "obs": np.stack([ones, ones], axis=1),
        "next_obs": np.stack([ones, ones], axis=1) + 0.5,
        "action": ones[:, None] / 10,
        "actions": ones[:, None] / 10,
        "reward": -ones,
        "rewards": -ones,
        "done": np.full(envs, number % 3 == 0),
        "dones": np.full(envs, number % 3 == 0),
        "terminated": np.full(envs, number % 3 == 0),
        "terminations": np.full(envs, number % 3 == 0),
        "infos": [{}] * envs,
    }


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
    reused["obs"] += 100  # as an environment does that writes over its own observations
    seen = set(_sampled(made)["obs"][:, 0].tolist())
    if 101.0 in seen:
        yield "a stored observation changed with the array it came from. Likely: it is not copied."
    if 0.0 in seen:
        yield "rows that were never written are sampled. Likely: it draws from the whole capacity."
    if seen - {0.0, 101.0} != {1.0, 2.0}:
        yield f"of two stored rows {len(seen)} were found in 3000 samples."
    for number in range(3, 10):
        call_by_name(made.add, **_row(number))
    yield from _after_nine(_sampled(made))


def _after_nine(batch: dict[str, np.ndarray]) -> Iterator[str]:
    """Nine rows went into six places: 4 to 9 are left."""
    numbers = batch["obs"][:, 0]
    seen, counts = np.unique(numbers, return_counts=True)
    if set(seen.tolist()) != set(range(4, 10)):
        was = ", ".join(f"{number:g}" for number in seen)
        why = "the last place is never used, or never sampled" if len(seen) == 5 else "it does not go round"
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
        given = {"obs": np.zeros((2, 2), np.float32), "actions": np.zeros((2, 1), np.float32), "rewards": np.ones(2)}
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
        args, named = stored[0]
        yield from _stored(args, named, terminated, truncated, last)


def _stored(args: tuple, named: dict[str, Any], terminated: bool, truncated: bool, last: np.ndarray) -> Iterator[str]:
    order = dict(zip(("obs", "next_obs", "action", "reward", "done", "infos"), args, strict=False)) | named
    done = order.get("done", order.get("dones", order.get("terminations")))
    what = "time-out" if truncated else "death"
    if done is None:
        yield "rb.add(obs, next_obs, action, reward, done, infos) was not given done."
    elif bool(done[0]) and truncated:
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
