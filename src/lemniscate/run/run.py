"""The surroundings of a training loop: the generator that the loop is written over.

    for env in run.until(config.total_steps, state):
        ...one update, one `run.log`...

Between two bodies of the loop the generator evaluates, saves, calls the callbacks and stops; the loop does not see it.

At a planned checkpoint the environments restart from a seed derived from (run seed, step), in a run that goes on as in
one that is resumed. So both end in the same bits, whatever the simulator.
"""

import math
import random
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch

from lemniscate.envs.returned import told_with_place
from lemniscate.envs.vec_env import Episodes, VecEnv
from lemniscate.errors import NonFiniteError, NotStoredError, UserError, resume_line, shown
from lemniscate.nn.memory import Carrier
from lemniscate.optim.compiled import Compiler
from lemniscate.run.checkpoint import require_storable
from lemniscate.run.config import RunConfig
from lemniscate.run.directory import Saver, load_networks
from lemniscate.run.environments import Curriculum
from lemniscate.run.evaluate import critic_of, evaluate
from lemniscate.run.loggers import NO_EPISODES, Logger, LoggerClass, require_logger
from lemniscate.run.metrics import read_metrics
from lemniscate.run.seeding import derive, seed_globals
from lemniscate.run.signals import EVERY_CLOSE, FIRST_CLOSE, LOOKS, signals
from lemniscate.run.state import TrainState, require_agreement
from lemniscate.run.stopping import Stopped, StopRequest
from lemniscate.run.updates import Watched, acted_with
from lemniscate.system.console import ProgressBar, say
from lemniscate.system.world import World

AGREED_EVERY = 16
"""steps of the environments after which several processes ask each other whether one is to stop"""

TRAINING = 0
"""the stream of seeds that training environments restart from"""

S = TypeVar("S", bound=TrainState)
Observer = Callable[[Sequence[tuple[int, Mapping[str, float]]], TrainState], bool]
"""(step, metrics) of new lines and the state, to whether the run is to stop; it leaves the state as it is"""


@dataclass
class Iteration:
    """The present iteration of the loop: what was so when it began, and whether it is whole."""

    step: int = 0
    episodes: int = 0
    """whole training episodes of the run so far"""
    acted: dict[str, torch.Tensor] | None = None
    """what the policy was made of, where its update is looked at"""
    watched: Watched | None = None
    """what its gradient steps were given, there too"""
    began: float = field(default_factory=time.monotonic)
    cut_short: bool = False
    """whether it takes fewer steps than it was to: its state is nobody's to resume from"""


class Run:
    """The surroundings of one training loop: run directory, loggers, environments."""

    def __init__(
        self,
        path: Path,
        algorithm: str,
        config: RunConfig,
        envs: tuple[VecEnv, VecEnv | None],
        *,
        world: World,
        loggers: Sequence[LoggerClass],
        progress: bool,
        record_video: Callable[[TrainState], None],
        observer: Observer | None,
        locate: Callable[[str], Path],
    ) -> None:
        self.path, self.algorithm, self.config = path, algorithm, config
        self._home = path.absolute()  # an environment or a callback may change the working directory
        self.world, (self.env, self.eval_env) = world, envs
        self.spec = self.env.spec
        self.seconds = 0.0
        """how long the training loop took"""
        self._saver = Saver(self._home, algorithm, config, self.spec, world)
        self._logger_classes, self._loggers = loggers if world.is_first else (), list[Logger]()
        self._visible, self._record_video, self._observer, self._locate = progress, record_video, observer, locate
        self._compiler = Compiler(world.busy)
        self._stop = StopRequest(world.size > 1, self._how_to_go_on, self._compiler.stopping)
        self._iteration, self._lines, self._episodes = Iteration(), 0, 0
        """the present iteration; lines logged by the loop and whole training episodes so far"""
        self._recent_returns = deque[float](maxlen=100)
        self._unobserved: list[tuple[int, dict[str, float]]] = []
        """logged lines that callbacks have not seen"""
        self._refused: Exception | None = None
        """what a logger raised"""
        self._notices_said, self._restored, self._ended = 0, False, False
        """notices of the environments that have been said; whether the loop may begin, and has come to its end"""
        self._last_line = 0.0, 0
        """when the last line was logged, and at which step"""

    def restore(self, state: S) -> S:
        """Restore `state` from the newest planned checkpoint, if there is one; then open the loggers.

        The directory of a new run is created here: a state that cannot be made leaves nothing behind. A warm start is
        saved as a checkpoint at step 0, so that from then on the run does not depend on where its networks came from.
        """
        saver = self._saver
        require_storable(type(state).__name__, state.saved())
        if not saver.exists:  # first, since it may fail
            self._begin(state)
        saver.open()
        restored = saver.restore(state)
        if not restored and saver.exists:
            self._begin(state)
        if not restored and self.config.warm_start:
            saver.save(state, planned=True)
        if restored and self._curriculum:
            self.env.backend.call(saver.calls)
        compiled = self.config.is_compiled
        if compiled and self._visible:
            say("Compiling: up to a minute the first time, 5 to 10 s from then on.")
        state.prepare(self.world, self._compiler if compiled else None)
        record = {"algorithm": self.algorithm, **self.config.to_json()}
        self._loggers += [require_logger(make(self._home, record, state.step)) for make in self._logger_classes]
        lines = read_metrics(self._home) if self.world.is_first else []
        self._episodes = sum(len(line.get("episode/returns", ())) for line in lines)
        self._lines = sum("time/collect" in line for line in lines)
        saver.logged = max((line["step"] for line in lines), default=0)
        self._restored = True
        return state

    def until(self, total_steps: int, state: TrainState) -> Iterator[VecEnv]:
        """The environments, once for each update, until `total_steps` are taken or a callback stops the run.

        Raises `Stopped` after a signal, when the current update is done and saved.
        """
        if not self._restored:
            raise UserError(f"train() of {self.algorithm} must begin with state = run.restore(init(…)).")
        self._bar = ProgressBar(total_steps, state.step, self._visible)
        started = time.monotonic()
        self._last_line = started, state.step
        try:
            with self._stop.heard():
                self.world.begin(lambda: self.env.steps)
                if state.step == 0 and (self.config.video_every or self.config.video_every_episodes):
                    self._record(state)
                self._restart(state)
                going_on = state.step < total_steps
                while going_on:
                    # Some LOOKS lines of a run have signals, of a short one a fifth: more would cost more than 1 %.
                    least = 1 if hasattr(state, "replay") else 5  # there lines are few, and each is of many steps
                    every = max(least, math.ceil(total_steps * self._lines / (LOOKS * max(1, state.step))))
                    looks = self.world.is_first and self._lines % every == 0
                    look = self._lines // every
                    close = look if look < FIRST_CLOSE or look % EVERY_CLOSE == 0 else None
                    before = (acted_with(state), Watched(state, close)) if looks else (None, None)
                    self._iteration = Iteration(state.step, self._episodes, *before)
                    yield self.env
                    if watched := self._iteration.watched:
                        watched.end()
                    if state.step <= self._iteration.step and not self._iteration.cut_short:
                        raise UserError(
                            f"An update of {self.algorithm} leaves state.step as it was: add its steps to it."
                        )
                    # What a body that was cut short would have had done, the process does that resumes the run.
                    planned = not self._iteration.cut_short and self._do_what_is_due(state, total_steps)
                    going_on = not self._stopped(state, planned) and state.step < total_steps
                    if planned and going_on:
                        self._restart(state)
                self._ended = True
        finally:
            self.seconds = time.monotonic() - started
            self._bar.close()

    def steps(self, count: int) -> Iterator[int]:
        """The numbers below `count`, for a body of the loop that takes many steps; asked to stop, it takes fewer."""
        for number in range(count):
            asked = self._stop.signum > 0
            if self.world.size > 1:
                asked = number % AGREED_EVERY == 0 and any(self.world.each(asked))
            if asked:
                self._iteration.cut_short = True
                return
            yield number

    def log(self, state: TrainState, metrics: Mapping[str, torch.Tensor | float], episodes: Episodes) -> None:
        """Write one line of metrics.

        Raises `NonFiniteError` where a loss, the gradient or a parameter is NaN or infinite; no checkpoint is touched.
        Raises `UserError` for metrics that are no scalars, and for a `state.step` that is no whole number.
        """
        try:
            numbers = {name: float(value) for name, value in metrics.items()}
        except (AttributeError, TypeError, ValueError, RuntimeError) as error:
            if isinstance(error, RuntimeError) and "Scalar" not in str(error):
                raise  # of a device, which tells late of what failed before
            said = f"run.log of {self.algorithm} is given {shown(metrics)}; metrics are scalars by their names"
            raise UserError(f"{said}: {error}.") from error
        if type(state.step) is not int:
            raise UserError(f"state.step of {self.algorithm} is {state.step!r}; it must be a whole number of Python's.")
        if self._iteration.cut_short and state.step == self._iteration.step:
            return  # not a step was taken: the run that is resumed writes this line
        require_finite(state, numbers)
        if self.world.size > 1:
            require_agreement(self.world, state)
        if episodes.returns:
            self._episodes += len(episodes.returns)
            self._recent_returns.extend(episodes.returns)
            numbers["episode/return"] = sum(episodes.returns) / len(episodes.returns)
            numbers["episode/length"] = sum(episodes.lengths) / len(episodes.lengths)
        if self._iteration.acted is not None:
            update = self._iteration.acted, self.env.ages, self._iteration.watched
            numbers |= signals(state, self.config, self.spec, self.env.recent(), *update)
        numbers |= {f"info/{name.removeprefix('info/')}": mean for name, mean in episodes.measures.items()}
        # The speed since the last line, everything included; the seconds of the loop's body by their use.
        now, (before, step_before), collect = time.monotonic(), self._last_line, self.env.collecting
        self.env.collecting = 0.0
        numbers["time/steps_per_second"] = (state.step - step_before) / max(now - before, 1e-9)
        numbers |= {"time/collect": collect, "time/learn": now - self._iteration.began - collect}
        self._last_line = now, state.step
        self._lines += 1
        self._write(state.step, numbers, episodes)
        notices = self.env.backend.notices if self.world.is_first else ()
        for notice in notices[self._notices_said :]:
            say(notice)
        self._notices_said = len(notices)
        recent = self._recent_returns
        self._bar.update(state.step, sum(recent) / len(recent) if recent else None, learned=bool(metrics))

    def require_whole(self, state: TrainState) -> None:
        """Raise `UserError` if the algorithm did not go through the loop of `until` to its end; the state is saved."""
        if not self._ended:
            if state.step > self._saver.last_planned:
                self._saver.save(state, planned=False)
            done = f"at step {state.step:,} of {self.config.total_steps:,}, where its policy is stored"
            raise UserError(
                f"train() of {self.algorithm} left the loop of run.until {done}: to stop a run, let a callback return"
                " True."
            )

    def require_stored(self) -> None:
        """Raise `NotStoredError` if the disk refused the last checkpoint."""
        if failure := self._saver.failure:
            raise NotStoredError(
                f"The final checkpoint of {self.path} is not stored: {failure}. When the disk takes it, go on with"
                f" {resume_line(self.path)}; it resumes at step {self._saver.last_planned:,}."
            )

    def close(self, pictures: list[Path]) -> None:
        """Close the loggers, which may take the pictures, and the environments; unlock the directory."""
        self._stop.end()
        with ExitStack() as closing:  # each, whatever another one raises
            closing.callback(self._saver.close)
            for env in filter(None, (self.eval_env, self.env)):
                closing.callback(env.close)
            for logger in reversed(self._loggers):
                closing.callback(logger.close, pictures)

    def _do_what_is_due(self, state: TrainState, total_steps: int) -> bool:
        """The work after a whole update; returns whether a planned checkpoint was part of it."""
        config, before, step = self.config, self._iteration.step, state.step
        finished = step >= total_steps
        if config.average_last and step > (1 - config.average_last) * total_steps:
            state.mean.add(state.policy)
            if finished:
                state.mean.move_to(state.policy)
        elif config.average_last:
            state.mean.load_state_dict({})  # what was added is of a total that has been extended since
        if _passed(config.evaluate_every, before, step):
            self._evaluate(state)
        if self._curriculum:
            self._advance_curriculum(self._curriculum, self._unobserved, state)
        by_episodes = _passed(config.video_every_episodes, self._iteration.episodes, self._episodes)
        if not self._iteration.cut_short and (by_episodes or _passed(config.video_every, before, step)):
            self._record(state)
        planned = not self._iteration.cut_short and (finished or _passed(self._checkpoint_every, before, step))
        if planned:
            with self._stop.storing(), self.world.busy():
                self._saver.save(state, planned=True)
            self.world.saved(self._home)
        return planned

    def _stopped(self, state: TrainState, planned: bool) -> bool:
        """Whether a callback stops the run here; the state is saved then, and where a callback fails.

        Raises `Stopped` where a signal does, after the same.
        """
        stop = self._observer is not None or self._refused is not None
        try:
            if self._refused:
                raise self._refused
            lines, self._unobserved = self._unobserved, []
            if self._observer:
                with globals_undisturbed(), self.world.busy():
                    stop = self._observer(lines, state)
            signum = self._stop.signum  # one that comes from here on counts at the next update
            if self.world.size > 1:
                said = self.world.each((stop, signum))
                stop, signum = any(asked for asked, _ in said), max(each for _, each in said)
            stop = stop or signum > 0
        finally:
            if stop:
                self._stop.settle()
                if not planned and state.step > self._saver.last_planned:
                    self._saver.save(state, planned=False)
        if stop and not (planned and state.step >= self.config.total_steps):
            self._tell_stop(state.step, signum)
        return stop

    def _tell_stop(self, step: int, signum: int) -> None:
        saved = "not saved" if self._saver.failure else "saved"
        by = "" if signum else "by a callback "
        here = f"Stopped {by}at step {step:,}; the policy is {saved}."
        message = f"{here} {self._how_to_go_on()[:-1]}, and ends in the same bits as a run that was never stopped."
        if signum:
            raise Stopped(message if self.world.is_first else "", signum)
        if self.world.is_first:
            say(message)

    def _how_to_go_on(self) -> str:
        planned = f"It resumes at step {self._saver.last_planned:,}, the last planned checkpoint."
        return f"Go on with: {resume_line(self.path)}\n{planned}"

    def _restart(self, state: TrainState) -> None:
        seed = derive(self.config.seed, TRAINING, state.step)
        seed_globals(seed)  # nothing here draws from them, but a user's environment may
        if memory := getattr(state.networks, "memory", None):
            self.env.carrier = Carrier(memory, state.networks.remember)
        with self.world.busy():  # it may make them all again
            self.env.restart(seed, state.step)
        state.on_restart(self.env)

    def _begin(self, state: TrainState) -> None:
        """Do what is done before step 0: load the networks of a warm start, and ask the curriculum."""
        if self.config.warm_start:
            sentence = load_networks(state.networks, self.config, self.spec, self._locate)
            state.on_warm_start()
            if self._visible:
                say(sentence)
        if self._curriculum:
            self._advance_curriculum(self._curriculum, [(0, {})], state)

    @cached_property
    def _curriculum(self) -> Curriculum | None:
        name = self.config.curriculum
        return Curriculum(name, self.world) if name else None

    def _advance_curriculum(
        self, curriculum: Curriculum, lines: Sequence[tuple[int, Mapping[str, float]]], state: TrainState
    ) -> None:
        with globals_undisturbed():
            decided = curriculum.decide(lines)
        before = dict(self._saver.calls)
        for calls in decided:
            self.env.backend.call(calls)
            self._saver.calls |= calls
        if self._saver.calls != before:
            state.on_change()

    @cached_property
    def _checkpoint_every(self) -> int:
        """The configured interval; else a fifth of the run, or three episodes of each environment if that is longer.

        Where a limit is above 1,000 steps, as the 27,000 of Atari's, episodes hardly ever last so long.
        """
        longest = min(self.spec.max_episode_steps or 0, 1000)
        fifth = -(-self.config.total_steps // 5)
        return self.config.checkpoint_every or max(fifth, 3 * longest * self.config.num_envs)

    @contextmanager
    def _as_side_task(self, what: str, state: TrainState) -> Iterator[None]:
        """Inside is done what training does not notice; what fails there costs only itself."""
        try:
            with globals_undisturbed(), self.world.busy():
                yield
        except (UserError, OSError) as error:  # no display any more, a full disk, an endless episode
            say(f"No {what} at step {state.step:,}: {error}")
        except Exception as error:  # whatever an environment or its picture raises
            say(f"No {what} at step {state.step:,}: {told_with_place(error)}.")
        except Stopped:
            if self.world.size > 1 or state.step == self._iteration.step:  # nothing has been learned since
                raise
            self._stop.end()
            self._iteration.cut_short = True  # the process that resumes the run does what was due
        finally:
            if self.env.backend.once and not self._stop.signum:  # a run that stops takes no step more
                self._restart(state)

    def _record(self, state: TrainState) -> None:
        if self.world.is_first:
            with self._as_side_task("recording", state):
                if self.env.backend.once:
                    self.env.close()
                self._record_video(state)

    def _evaluate(self, state: TrainState) -> None:
        config, scores = self.config, None
        if self.eval_env:
            with self._as_side_task("evaluation", state):
                critic = critic_of(state.networks, config)
                scores = evaluate(state.policy, self.eval_env, config.evaluate_episodes, config.seed, critic=critic)
        if scores:
            self._write(state.step, {f"evaluation/{name}": value for name, value in scores.means().items()})
        if scores and config.keep_best:
            with self.world.busy():
                self._saver.save_if_best(state, scores.mean_return)

    def _write(self, step: int, numbers: dict[str, float], episodes: Episodes = NO_EPISODES) -> None:
        if "step" in numbers:
            raise UserError(f"run.log of {self.algorithm} is given a metric named step, which each line has already.")
        with self.world.busy():
            for logger in self._loggers:
                try:
                    logger.write(step, dict(numbers), episodes)  # it may change its own
                except Exception as error:  # raised where the state can be saved
                    self._refused = self._refused or error
        self._saver.logged = step
        self._unobserved.append((step, numbers))


@contextmanager
def globals_undisturbed() -> Iterator[None]:
    """Restore the global generators afterwards: Python's, NumPy's legacy one, torch's on the CPU and on every GPU."""
    python, numpy = random.getstate(), np.random.get_state()  # noqa: NPY002
    gpus = range(torch.cuda.device_count()) if torch.cuda.is_initialized() else ()
    try:
        with torch.random.fork_rng(gpus):
            yield
    finally:
        random.setstate(python)
        np.random.set_state(numpy)  # noqa: NPY002


def require_finite(state: TrainState, numbers: Mapping[str, float]) -> None:
    """Raise `NonFiniteError` where a loss, the gradient or a parameter is NaN or infinite."""
    for name, value in numbers.items():
        if name.startswith(("losses/", "gradient")) and not math.isfinite(value):
            raise NonFiniteError(f"{name} is {value} in the update that ends at step {state.step:,}.")
    with torch.no_grad():
        total = sum(map(torch.sum, state.networks.parameters()))
    if math.isfinite(total):  # a NaN shows in the sum, and so does a mere overflow
        return
    for name, values in state.networks.named_parameters():
        bad = values[~values.isfinite()]
        if len(bad):
            said = f"The parameter {name} is {bad[0].item()} after the update"
            raise NonFiniteError(f"{said} that ends at step {state.step:,}.")


def _passed(every: int, before: int, after: int) -> bool:
    """Whether a multiple of `every` lies after `before` and not after `after`; 0 stands for never."""
    return every > 0 and after // every > before // every
