"""The notebooks and the training loop with gaps that a student is given, and the judgement of a training loop.

First a look inside (`inside.py`): gradients and steps against the equations. What that does not understand is judged by
small worlds: in each the better of two actions is known, and one mistake makes the other one look better; one more
world has Box actions. A loop that passes them all, and was not proved right inside, is trained on CartPole-v1.
"""

import inspect
import json
import re
import tomllib
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, closing
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from torch.optim.optimizer import register_optimizer_step_pre_hook

from lemniscate.api.agents import Agent, playing
from lemniscate.course import inside
from lemniscate.course.exercise import TEMPLATES, Note, raised
from lemniscate.course.solution import Function
from lemniscate.envs.vector_view import VectorView, make_vec
from lemniscate.errors import UserError, unknown_name
from lemniscate.run.evaluate import evaluate
from lemniscate.system.console import say
from lemniscate.system.files import at_home

SKELETONS = ("ppo",)
SOLUTION = re.compile(r"^( *)# <solution>\n(.*?) *# </solution>\n", re.DOTALL | re.MULTILINE)
"""the lines of a program that its skeleton leaves out"""
GAPS, SOLVED = r'\1raise NotImplementedError("to be written")\n', r"\2"
"""what stands for them, in the two versions of a program"""
NOTEBOOKS = Path(__file__).parent / "notebooks"

STEPS, NUM_ENVS = 2_048, 8
LEARNED = 0.25
"""the least that each of two actions has moved where it pays, in the small world of Box actions; 0.7 is usual"""
FEW_GRADIENT_STEPS = 100
"""a loop that has made fewer in a small world may have long rollouts"""
CARTPOLE_STEPS, CARTPOLE_RETURN, EPISODES = 60_000, 150, 24


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
    path = at_home(path or f"{name}.py")
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
    folder = at_home(folder)
    texts = {"README.md": (NOTEBOOKS / "README.md").read_text("utf-8"), **_files(GAPS)}
    if solutions:
        texts |= {f"solutions/{name}": text for name, text in _files(SOLVED).items()}
    _write({folder / name: text for name, text in texts.items()})
    return folder / "README.md"


def _write(files: dict[Path, str]) -> None:
    """Write new files: `UserError` where one exists, and then none is written, or cannot be written."""
    if there := list(filter(Path.exists, files)):
        raise UserError(f"{there[0]} exists already, and nothing is overwritten; name another place.")
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


def observation_of(state: int) -> np.ndarray:
    """The observation of a state of a small world: a one-hot vector [6]."""
    return np.eye(6, dtype=np.float32)[state]


class WorldEnv(gym.Env):
    """A small world of `worlds.toml`, in which action 0 is better than action 1 in state 0."""

    def __init__(self, world: int) -> None:
        self.world = WORLDS[world]
        self.observation_space = gym.spaces.Box(0, 1, (6,), np.float32)
        self.action_space: gym.Space = gym.spaces.Discrete(2)
        self._bonus = 0.0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """A state to begin in."""
        super().reset(seed=seed)
        self._state = int(self.np_random.choice(len(self.world["starts"]), p=self.world["starts"]))
        return self._obs(), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict]:
        """The move of that action."""
        move = self.world["moves"][self._state][int(action)]
        reward, end = move["reward"] + self._bonus, move.get("end")
        self._bonus, self._state = move.get("next_bonus", 0.0), move["to"]
        return self._obs(), reward, end == "death", end == "time-out", {}

    def _obs(self) -> np.ndarray:
        return observation_of(self.world.get("seen", range(6))[self._state])


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
        return observation_of(0), float(action[0] - action[1]), True, False, {}


WORLDS: list[dict[str, Any]] = tomllib.loads((TEMPLATES / "worlds.toml").read_text("utf-8"))["world"]


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
            action = _trained(function, envs, lambda action: float(action) <= 0.5)
        seen[f"world {number}"] = float(action)
        if action > 0.5:
            return
    if verdict.sentence:
        return
    taken: list[np.ndarray] = []
    with closing(make_vec(partial(BoxEnv, taken), NUM_ENVS)) as envs:
        try:
            first, second = _trained(function, envs, lambda both: min(both[0], -both[1]) >= LEARNED)
            seen["box"] = [float(first), float(second)]
        except Exception as error:  # what it raises is a finding, which has to say that it is not of Discrete actions
            seen["box raised"] = {"sentence": raised(error), "steps": len(taken)}
    if not verdict.is_proved:
        with (
            closing(make_vec("CartPole-v1", NUM_ENVS, backend="gymnasium")) as envs,
            acting(started(function, envs, CARTPOLE_STEPS), envs) as player,
        ):
            seen["return"] = evaluate(player, envs.env, EPISODES, 12_345).mean_return


def _worlds(verdict: inside.Verdict) -> list[dict[str, Any]]:
    """The worlds in which a loop with that verdict is trained."""
    return [] if verdict.sentence else WORLDS[:1] if verdict.is_proved else WORLDS


def train(seen: Mapping[str, Any]) -> Iterator[str]:
    """Sentences on an observed training loop: on its inside first, on its returns last."""
    verdict = inside.judged(seen["inside"])
    if verdict.sentence:
        yield verdict.sentence
    for number, world in enumerate(_worlds(verdict)):
        if seen[f"world {number}"] > 0.5:
            yield f"small world {number + 1} of {len(WORLDS) + 1}: {world['mistake']}."
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
        counts = "num" in word or re.search(r"(^|_)n_", word)  # how many there are
        if "env" in word and not counts and is_required:
            known[name] = envs
        elif "seed" in word:
            known[name] = 1
        elif "total" in word or "timesteps" in word or ("step" in word and is_required):
            known[name] = steps
        elif is_required and parameter.kind not in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
            raise TypeError(f"its parameter {name} is not known; a training loop takes envs, total_steps and seed")
    return function(**known)


def _trained(function: Function, envs: VectorView, is_right: Callable[[np.ndarray], bool]) -> np.ndarray:
    """The mean action after training; of a loop that is slow, or whose rollouts are long, after more of it."""
    made = list[Any]()
    watch = register_optimizer_step_pre_hook(lambda *_: made.append(None))
    try:
        action = _mean_action(function, envs, STEPS)
        for factor in (4, 32):
            if is_right(action) or (factor == 32 and len(made) >= FEW_GRADIENT_STEPS):
                break
            action = _mean_action(function, envs, factor * STEPS)
        return action
    finally:
        watch.remove()


def _mean_action(function: Function, envs: VectorView, steps: int) -> np.ndarray:
    """In state 0 of a small world, after training; over many rows, since a policy may draw its actions."""
    with acting(started(function, envs, steps), envs) as player:
        return player(torch.from_numpy(observation_of(0)).repeat(64, 1)).mode().double().mean(0).numpy()


def acting(made: Any, envs: VectorView) -> AbstractContextManager[Agent]:
    """The agent that a training loop returned, from observations [N, O] to actions in [-1, 1], or choices.

    Raises:
        TypeError: there is nothing.
        UserError: it does not act.
    """
    if made is None:
        raise TypeError("train returned None; it should return an agent with act(obs), or a function")
    return playing(made, envs.env, 12_345, None, normalized=False, deterministic=True)
