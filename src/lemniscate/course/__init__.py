"""Checks of functions and classes that a reader writes: correct, or wrong in a well-known way.

    from lemniscate import course

    def gae(reward, value, next_value, terminated, done, *, gamma, lam): ...

    course.check(gae)

A function is compared with a reference on small cases, each with one difficulty. Where a value differs, the result is
compared with those of well-known mistakes, and the mistake that agrees is named. A class, or a function with effects,
is judged by what it does; a whole training loop (`skeleton`) by what it learns. `start` lays out the notebooks.
"""

from types import FunctionType

from lemniscate.course import functions, loop, parts, setup
from lemniscate.course.exercise import Exercise, Finding, Inspection
from lemniscate.course.grading import grade
from lemniscate.course.loop import skeleton, start
from lemniscate.course.solution import Function, owner_of
from lemniscate.errors import UserError, shown, unknown_name
from lemniscate.system.console import say

__all__ = ["EXERCISES", "Finding", "check", "grade", "skeleton", "start"]


EXERCISES: dict[str, Exercise | Inspection] = {
    **functions.EXERCISES,
    "sample_categorical": Inspection(parts.see_sample_categorical, parts.sample_categorical),
    "Agent": Inspection(parts.see_agent, parts.agent),
    "Actor": Inspection(parts.see_actor, parts.actor),
    "QNetwork": Inspection(parts.see_q_network, parts.q_network),
    "set_seeds": Inspection(setup.see_set_seeds, setup.set_seeds),
    "make_envs": Inspection(setup.see_make_envs, setup.make_envs),
    "save_model": Inspection(setup.see_save_model, setup.save_model),
    "load_model": Inspection(setup.see_load_model, setup.load_model),
    "sync_envs": Inspection(setup.see_sync_envs, setup.sync_envs),
    "ReplayBuffer": Inspection(parts.see_replay_buffer, parts.replay_buffer),
    "add_to_replay": Inspection(parts.see_add_to_replay, parts.add_to_replay),
    "train": Inspection(loop.observe_train, loop.train, limit=300.0),
}
"""each exercise by the name of the function or class to write"""


def check(function: Function, name: str | None = None) -> Finding:
    """Judge a solution of an exercise; prints the finding, and returns it.

    Args:
        function: the solution: a function or a class. What `lemniscate.maths` has under its name takes and returns the
            same as there; docs/courses.md has the others. A method is given as it stands in its class,
            `Trainer.calculate_pg_loss`: what it uses of `self` is put there.
        name: the name of the exercise; by default that of the solution.

    Raises:
        UserError: a solution that is no function and no class, or has no name of its own; a name that is no exercise.
    """
    name = str(name or getattr(function, "__name__", "<lambda>"))
    if name not in EXERCISES and isinstance(function, FunctionType) and (owner := owner_of(function)):
        name = owner[1]  # a decorator has given it another name
    if name == "<lambda>":
        raise UserError(f'Which exercise is {shown(function)}? Name it: course.check(solution, "gae").')
    if isinstance(function, type) and name in EXERCISES:
        function = getattr(function, name, function)
    if name not in EXERCISES:
        classes = [cls for cls in getattr(function, "__mro__", ()) if not cls.__module__.startswith("torch")]
        methods = [method for method in EXERCISES if any(method in vars(cls) for cls in classes)]
        if not methods:
            raise unknown_name("exercise", name, EXERCISES)
        checks = ", ".join(f"course.check({name}.{method})" for method in methods)
        raise UserError(f"{name} is judged by its methods: {checks}.")
    if not callable(function):
        raise UserError(f"What can be checked is a function or a class, not {shown(function)}.")
    exercise = EXERCISES[name]
    finding = exercise.judge(name, exercise.observe(function))
    say(finding)
    return finding
