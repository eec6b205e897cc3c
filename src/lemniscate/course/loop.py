"""The notebooks and the training loop with gaps that a student is given, and the judgement of a training loop.

First a look inside (`inside.py`): gradients and steps against the equations. What that does not understand is judged by
small worlds: in each the better of two actions is known, and one mistake makes the other one look better; one more
world has Box actions. A loop that passes them all, and was not proved right inside, is trained on CartPole-v1.
"""

import inspect
import json
import re
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from lemniscate.api.agents import METHODS
from lemniscate.course import inside
from lemniscate.course.exercise import TEMPLATES, Note, raised
from lemniscate.course.solution import Function
from lemniscate.envs.vector_view import VectorView, make_vec
from lemniscate.errors import UserError, unknown_name
from lemniscate.system.console import say

SKELETONS = ("ppo",)
SOLUTION = re.compile(r"^( *)# <solution>\n(.*?) *# </solution>\n", re.DOTALL | re.MULTILINE)
"""the lines of a program that its skeleton leaves out"""
GAPS, SOLVED = r'\1raise NotImplementedError("to be written")\n', r"\2"
"""what stands for them, in the two versions of a program"""
NOTEBOOKS = Path(__file__).parent / "notebooks"

STEPS, NUM_ENVS = 2_048, 8
LEARNED = 0.25
"""the least that each of two actions has moved where it pays, in the small world of Box actions; 0.7 is usual"""
CARTPOLE_STEPS, CARTPOLE_RETURN, EPISODES_EACH = 60_000, 150, 3


def skeleton(name: str = "ppo", path: str | Path | None = None) -> Path:
    """Write a training loop to fill in, as one file that runs by itself and checks itself.

    Args:
        name: ppo.
        path: the new file; by default `ppo.py` here.

    Raises:
        UserError: an unknown name; a file that exists, or cannot be written.
    """
    if name not in SKELETONS:
        raise unknown_name("skeleton", name, SKELETONS)
    path = Path(path or f"{name}.py")
    with_gaps = SOLUTION.sub(GAPS, solution(name))
    _write({path: with_gaps.replace(f"python {name}.py", f"python {path.name}")})
    return path


def solution(name: str) -> str:
    """The program of a skeleton without gaps."""
    # Not a module: it is a text for the reader's own file, and nothing here may come to import it.
    return (TEMPLATES / f"{name}.py.txt").read_text("utf-8")


def start(folder: str | Path, *, solutions: bool = False) -> Path:
    """Lay out the course: notebooks with gaps and their checks, a training loop, and the page to begin with, returned.

    Args:
        folder: where to; made if it is not there.
        solutions: the same files without gaps too, in `folder/solutions`.

    Raises:
        UserError: a file that exists already, and then none is written; a folder that cannot be written.
    """
    texts = {"README.md": (NOTEBOOKS / "README.md").read_text("utf-8"), **_files(GAPS)}
    if solutions:
        texts |= {f"solutions/{name}": text for name, text in _files(SOLVED).items()}
    _write({Path(folder) / name: text for name, text in texts.items()})
    return Path(folder) / "README.md"


def _write(files: dict[Path, str]) -> None:
    """Write new files: `UserError` where one exists, and then none is written, or cannot be written."""
    for file in filter(Path.exists, files):
        raise UserError(f"{file} exists already, and nothing is overwritten; name another place.")
    for file, text in files.items():
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text, "utf-8")
        except OSError as error:
            raise UserError(f"{file} cannot be written: {error.strerror}.") from error


def _files(version: str) -> dict[str, str]:
    """By name the text of each notebook and training loop, with its gaps or solved."""
    texts = {}
    for file in sorted(NOTEBOOKS.glob("*.py.txt")):
        program = SOLUTION.sub(version, file.read_text("utf-8"))
        program = re.sub(r"\[([^][]+)\]\(\.\./[^)]+\)", r"\1", program)  # a link to a page that is not there
        texts[f"{file.name.removesuffix('.py.txt')}.ipynb"] = notebook(program)
    return texts | {f"{name}.py": SOLUTION.sub(version, solution(name)) for name in SKELETONS}


def notebook(program: str) -> str:
    """The notebook (nbformat 4.5) of a program whose cells begin with `# %%` or `# %% [markdown]`."""
    cells = []
    for number, part in enumerate(re.split("^# %%", program, flags=re.MULTILINE)[1:]):
        kind, _, text = part.partition("\n")
        text = re.sub("^# ?", "", text, flags=re.MULTILINE) if kind else text
        own = {"cell_type": "markdown"} if kind else {"cell_type": "code", "execution_count": None, "outputs": []}
        cells.append({**own, "id": f"cell-{number}", "metadata": {}, "source": text.strip("\n").splitlines(True)})
    python = {"kernelspec": {"name": "python3", "display_name": "Python 3"}, "language_info": {"name": "python"}}
    whole = {"cells": cells, "metadata": python, "nbformat": 4, "nbformat_minor": 5}
    return json.dumps(whole, indent=1, ensure_ascii=False) + "\n"


@dataclass(frozen=True)
class World:
    """A small world in which action 0 is better than action 1 in state 0."""

    moves: list[list[dict[str, Any]]]
    """by state and action: its effect, as `worlds.toml` says"""
    starts: list[float]
    """by state: the probability that an episode begins there"""
    mistake: str
    """a sentence on what action 1 in state 0 reveals"""
    seen: Sequence[int] = range(6)
    """by state: the state that it looks like"""

    def obs(self, state: int) -> np.ndarray:
        """The observation of a state: a one-hot vector [6]."""
        return np.eye(6, dtype=np.float32)[self.seen[state]]


class WorldEnv(gym.Env):
    """A world as an environment."""

    def __init__(self, world: int) -> None:
        self.world = WORLDS[world]
        self.observation_space = gym.spaces.Box(0, 1, (6,), np.float32)
        self.action_space: gym.Space = gym.spaces.Discrete(2)
        self._bonus = 0.0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """A state to begin in."""
        super().reset(seed=seed)
        self._state = int(self.np_random.choice(len(self.world.starts), p=self.world.starts))
        return self.world.obs(self._state), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict]:
        """The move of that action."""
        move = self.world.moves[self._state][int(action)]
        reward, end = move["reward"] + self._bonus, move.get("end")
        self._bonus, self._state = move.get("next_bonus", 0.0), move["to"]
        return self.world.obs(self._state), reward, end == "death", end == "time-out", {}


class BoxEnv(WorldEnv):
    """World 0 with a Box of two actions: the reward is the first minus the second."""

    def __init__(self, taken: list[np.ndarray]) -> None:
        super().__init__(0)
        self.taken = taken
        """a place for the actions"""
        self.action_space = gym.spaces.Box(-1, 1, (2,), np.float32)

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict]:
        """A death after one action."""
        self.taken.append(action)
        return self.world.obs(0), float(action[0] - action[1]), True, False, {}


WORLDS = [World(**world) for world in tomllib.loads((TEMPLATES / "worlds.toml").read_text("utf-8"))["world"]]


def observe_train(function: Function, seen: dict[str, Any]) -> None:
    """Run `train(envs, total_steps, seed)` on the probe, in the small worlds, on CartPole-v1, up to the first finding.

    It returns what acts: an agent with `act`, or a function of observations. What the probe has proved right is not
    looked for in small worlds again.
    """
    say("A look inside, then small worlds, then CartPole-v1 if need be: up to a minute.")
    names = getattr(function, "__globals__", {}) | vars(function)
    names |= {name: each.default for name, each in inspect.signature(function).parameters.items()}
    seen["inside"] = inside.watched(lambda envs: started(function, envs, CARTPOLE_STEPS), names)
    verdict = inside.judged(seen["inside"])
    for number in range(len(_worlds(verdict))):
        with closing(make_vec(WorldEnv, NUM_ENVS, env_kwargs={"world": number})) as envs:
            action = _mean_action(function, envs, WORLDS[number].obs(0), STEPS)
            if action > 0.5:  # a right loop may only be slow
                action = _mean_action(function, envs, WORLDS[number].obs(0), 4 * STEPS)
        seen[f"world {number}"] = float(action)
        if action > 0.5:
            return
    if verdict.sentence:
        return
    taken: list[np.ndarray] = []
    with closing(make_vec(partial(BoxEnv, taken), NUM_ENVS)) as envs:
        try:
            first, second = _mean_action(function, envs, WORLDS[0].obs(0), STEPS)
            if min(first, -second) < LEARNED:
                first, second = _mean_action(function, envs, WORLDS[0].obs(0), 4 * STEPS)
            seen["box"] = [float(first), float(second)]
        except Exception as error:  # what it raises is a finding, which has to say that it is not of Discrete actions
            seen["box raised"] = {"sentence": raised(error), "steps": len(taken)}
    if not verdict.is_proved:
        with closing(make_vec("CartPole-v1", NUM_ENVS, backend="gymnasium")) as envs:
            seen["return"] = _mean_return(acting(started(function, envs, CARTPOLE_STEPS), envs), envs)


def _worlds(verdict: inside.Verdict) -> list[World]:
    """The worlds in which a loop with that verdict is trained."""
    return [] if verdict.sentence else WORLDS[:1] if verdict.is_proved else WORLDS


def train(seen: Mapping[str, Any]) -> Iterator[str]:
    """Sentences on an observed training loop: on its inside first, on its returns last."""
    verdict = inside.judged(seen["inside"])
    if verdict.sentence:
        yield verdict.sentence
    for number, world in enumerate(_worlds(verdict)):
        if seen[f"world {number}"] > 0.5:
            yield f"small world {number + 1} of {len(WORLDS) + 1}: {world.mistake}."
    if "box raised" in seen:
        sentence = f"in the small world with Box actions {seen['box raised']['sentence']}"
        yield sentence if seen["box raised"]["steps"] else Note(f"it is for Discrete actions; {sentence}.")
    elif min(seen["box"][0], -seen["box"][1]) < LEARNED:
        yield (
            f"in the small world with Box actions it takes {seen['box'][0]:.2g} and {seen['box'][1]:.2g}, though the"
            " first minus the second is the reward. Likely: the actions are not those whose log-probability is trained."
        )
    if not verdict.is_proved and seen["return"] < CARTPOLE_RETURN:
        yield (
            f"all small worlds are right, but on CartPole-v1 the mean return after {CARTPOLE_STEPS:,} steps is"
            f" {seen['return']:.0f}; {CARTPOLE_RETURN} is expected. None of the known mistakes; are the settings those"
            " of the skeleton?"
        )


def started(function: Function, envs: VectorView, steps: int) -> Any:
    """Call a training loop, whatever its parameters are named; of a class, the method `train` of an object.

    Raises:
        TypeError: a parameter without a default that is neither environments, nor steps, nor a seed.
    """
    if inspect.isclass(function):
        trainer = _called(function, envs, steps)
        made = _called(trainer.train, envs, steps)
        return trainer if made is None else made
    return _called(function, envs, steps)


def _called(function: Function, envs: VectorView, steps: int) -> Any:
    known: dict[str, Any] = {}
    for name, parameter in inspect.signature(function).parameters.items():
        is_required, word = parameter.default is parameter.empty, name.lower()
        if "env" in word and "num" not in word and "n_" not in word and is_required:
            known[name] = envs
        elif "seed" in word:
            known[name] = 1
        elif "total" in word or "timesteps" in word or ("step" in word and is_required):
            known[name] = steps
        elif is_required and parameter.kind not in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
            raise TypeError(f"its parameter {name} is not known; a training loop takes envs, total_steps and seed")
    return function(**known)


def acting(made: Any, envs: VectorView) -> Callable[[np.ndarray], np.ndarray]:
    """The agent of a training loop as a function from observations [N, O] to actions, for `envs.step`.

    Raises:
        TypeError: nothing acts.
    """
    method = next((getattr(made, name) for name in METHODS if hasattr(made, name)), made)
    if not callable(method):
        raise TypeError(f"train returned {type(made).__name__}; it should return an agent with act(obs), or a function")

    def act(obs: np.ndarray) -> np.ndarray:
        try:
            action = method(obs)
        except (TypeError, AttributeError, RuntimeError):  # a function of tensors
            action = method(torch.as_tensor(obs))
        action = action[0] if isinstance(action, tuple) else action
        action = action.detach().cpu().numpy() if isinstance(action, torch.Tensor) else np.asarray(action)
        is_scores = (
            isinstance(envs.single_action_space, gym.spaces.Discrete) and action.ndim == 2 and action.shape[1] > 1
        )
        return action.argmax(1) if is_scores else action.reshape(envs.action_space.shape)

    return act


def _mean_action(function: Function, envs: VectorView, obs: np.ndarray, steps: int) -> np.ndarray:
    """At one observation, after training; over several calls, since a policy may draw its actions."""
    act = acting(started(function, envs, steps), envs)
    return np.mean([act(np.tile(obs, (envs.num_envs, 1))) for _ in range(8)], (0, 1))


def _mean_return(act: Callable[[np.ndarray], Any], envs: VectorView) -> float:
    """Over the first episodes that end, from unseen starts; each environment plays equally many."""
    obs, _ = envs.reset(seed=12_345)
    running, returns = np.zeros(envs.num_envs), [[] for _ in range(envs.num_envs)]
    while min(map(len, returns)) < EPISODES_EACH:
        obs, reward, terminated, truncated, _ = envs.step(np.asarray(act(obs)))
        running += reward
        for i in np.flatnonzero(terminated | truncated):
            returns[i].append(running[i])
            running[i] = 0.0
    # The first ones of each alone: of all that ended, short episodes would be more than their share.
    return float(np.mean([episode for row in returns for episode in row[:EPISODES_EACH]]))
