"""The surroundings of a training loop: the generator that the loop is written over.

    for env in run.until(config.total_steps, state):
        ...one update, one `run.log`...

Between two bodies of the loop the generator evaluates, saves, calls the callbacks and stops; the loop does not see it.

At a planned checkpoint the environments restart from a seed derived from (run seed, step), in a run that goes on as in
one that is resumed. So both end in the same bits, whatever the simulator.
"""

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TypeVar

import torch

from lemniscate.envs.episodes import Episodes
from lemniscate.envs.vec_env import VecEnv
from lemniscate.errors import NonFiniteError, NotStoredError, UserError, resume_line
from lemniscate.optim import compiled
from lemniscate.run.agreement import episodes_of_all
from lemniscate.run.config import RunConfig
from lemniscate.run.directory import Saver
from lemniscate.run.evaluate import evaluate
from lemniscate.run.loggers import NO_EPISODES, JsonLines, Logger, LoggerClass, TensorBoard
from lemniscate.run.metrics import read_metrics
from lemniscate.run.q_bias import critic_of
from lemniscate.run.seeding import derive, globals_undisturbed, seed_globals
from lemniscate.run.state import TrainState
from lemniscate.run.warm_start import load_networks
from lemniscate.system.console import ProgressBar, say
from lemniscate.system.world import World

WORTH_COMPILING = 15_000
"""gradient steps from which on a run ends sooner if they are compiled"""

PATIENCE = 1.0
"""seconds that an update has to end by itself after a signal, then to be interrupted"""

PATIENCE_OF_SEVERAL = 6.0
"""the same where several processes have to agree first"""

AGREED_EVERY = 16
"""steps of the environments after which several processes ask each other whether one is to stop"""

TRAINING = 0
"""the stream of seeds that training environments restart from"""

S = TypeVar("S", bound=TrainState)
Observer = Callable[[int, Mapping[str, float], TrainState], bool]
"""(step, metrics, state) of a logged line, to whether the run is to stop; it leaves the state as it is"""


class Stopped(KeyboardInterrupt):
    """The run was asked to stop (Ctrl-C, SIGTERM), and has saved itself."""

    def __init__(self, message: str, signum: int) -> None:
        super().__init__(message)
        self.signum = signum


class Run:
    """The surroundings of one training loop: run directory, loggers, environments."""

    def __init__(
        self,
        path: Path,
        algorithm: str,
        config: RunConfig,
        envs: tuple[VecEnv, VecEnv | None],
        *,
        world: World | None = None,
        loggers: Sequence[LoggerClass] = (JsonLines, TensorBoard),
        progress: bool = True,
        film: Callable[[TrainState], None] | None = None,
        observer: Observer | None = None,
    ) -> None:
        self.path, self.algorithm, self.config = path, algorithm, config
        self.world = world = world or World(config.shards)
        self.env, self.eval_env = envs
        self.spec = self.env.spec
        self.seconds = 0.0
        """how long the training loop took"""
        self._saver = Saver(path, algorithm, config, self.spec, world)
        self._logger_classes, self._loggers = loggers if world.is_first else (), list[Logger]()
        self._visible, self._film, self._observer = progress, film, observer
        self._bar = ProgressBar(config.total_steps, 0, visible=False)
        self._recent_returns: list[float] = []
        self._unobserved: list[tuple[int, dict[str, float]]] = []
        """logged lines that callbacks have not seen"""
        self._episodes = 0
        """whole training episodes so far"""
        self._logged = 0
        """the step of the last line of metrics"""
        self._stop_signal, self._asked_at = 0, 0.0
        self._cut_short = False
        """whether the body of the loop took fewer steps than it was to: its state is nobody's to resume from"""
        self._patience = PATIENCE if world.size == 1 else PATIENCE_OF_SEVERAL
        self._hurry, self._ended = threading.Timer(self._patience, self._ask_again), threading.Event()
        self._hurry.daemon = True
        """asks again to stop; whether the loop has ended"""
        self._line_time, self._line_step = 0.0, 0
        """when the last line was logged, and at which step"""
        self._body_time, self._body_began = 0.0, 0.0
        """seconds spent in bodies of the loop since the last line, and when the present body began"""

    def restore(self, state: S) -> S:
        """Restore `state` from the newest planned checkpoint, if there is one; then open the loggers.

        The directory of a new run is created here: a state that cannot be made leaves nothing behind. A warm start is
        saved as a checkpoint at step 0, so that from then on the run does not depend on where its networks came from.
        """
        saver = self._saver
        if self.config.warm_start and not saver.exists:  # first, since it may fail
            self._begin_warm(state)
        saver.open()
        restored = saver.restore(state)
        if self.config.warm_start and not restored:
            if saver.exists:
                self._begin_warm(state)
            saver.save(state, planned=True, logged=0)
        state.join(self.world)
        if is_compiled(self.config):
            if self._visible:
                say("Compiling: up to a minute the first time, 5 to 10 s from then on.")
            compiled.around = self.world.busy
            state.compile()
        record = {"algorithm": self.algorithm, **self.config.to_json()}
        self._loggers += [make(self.path, record, state.step) for make in self._logger_classes]
        lines = read_metrics(self.path) if self.world.is_first else []
        self._episodes = sum(len(line.get("episode/returns", ())) for line in lines)
        self._logged = max((line["step"] for line in lines), default=0)
        return state

    def until(self, total_steps: int, state: TrainState) -> Iterator[VecEnv]:
        """The environments, once for each update, until `total_steps` are taken or a callback stops the run.

        Raises:
            Stopped: after a signal, when the current update is done and saved.
        """
        self._bar = ProgressBar(total_steps, state.step, self._visible)
        started = time.monotonic()
        self._line_time, self._line_step = started, state.step
        try:
            with stop_signals_to(self._stop):
                self.world.begin(lambda: self.env.steps)
                if state.step == 0 and (self.config.video_every or self.config.video_every_episodes):
                    self._record(state)
                self._restart(state)
                going_on = True
                while going_on and state.step < total_steps:
                    before, episodes_before = state.step, self._episodes
                    self._body_began = time.monotonic()
                    yield self.env
                    self._body_time += time.monotonic() - self._body_began
                    going_on = self._between(state, before, episodes_before, total_steps)
        finally:
            self._ended.set()
            self._hurry.cancel()
            compiled.stopping.clear()
            self.seconds = time.monotonic() - started
            self._bar.close()

    def steps(self, count: int) -> Iterator[int]:
        """The numbers below `count`, for a body of the loop that takes many steps; asked to stop, it takes fewer."""
        for number in range(count):
            if number % AGREED_EVERY == 0 or self.world.size == 1:
                self._cut_short = any(self.world.each(bool(self._stop_signal)))
            if self._cut_short:
                return
            yield number

    def log(self, state: TrainState, metrics: Mapping[str, torch.Tensor | float], episodes: Episodes) -> None:
        """Write one line of metrics.

        Raises:
            NonFiniteError: a loss, the gradient or a parameter is NaN or infinite; the last checkpoint is untouched.
        """
        numbers = {name: float(value) for name, value in metrics.items()}
        for name, value in numbers.items():
            if name.startswith(("losses/", "gradient")) and not -float("inf") < value < float("inf"):
                raise NonFiniteError(f"{name} is {value} in the update that ends at step {state.step:,}.")
        state.require_finite()
        if self.world.size > 1:
            episodes = episodes_of_all(self.world, state, episodes)
        if episodes.returns:
            self._episodes += len(episodes.returns)
            self._recent_returns = (self._recent_returns + episodes.returns)[-100:]
            numbers["episode/return"] = sum(episodes.returns) / len(episodes.returns)
            numbers["episode/length"] = sum(episodes.lengths) / len(episodes.lengths)
        self._write(state.step, numbers | self._times(state.step), episodes)
        recent = self._recent_returns
        self._bar.update(state.step, sum(recent) / len(recent) if recent else None)

    def require_stored(self) -> None:
        """Raise `NotStoredError` if the disk refused the last checkpoint."""
        if failure := self._saver.failure:
            raise NotStoredError(
                f"The final checkpoint of {self.path} is not stored: {failure}. When the disk takes it, go on with"
                f" {resume_line(self.path)}; it resumes at step {self._saver.last_planned:,}."
            )

    def close(self, pictures: list[Path] | None = None) -> None:
        """Close the loggers and the environments, and unlock the directory."""
        self._ended.set()
        for logger in self._loggers:
            logger.close(pictures or [])
        for env in (self.env, self.eval_env):
            if env:
                env.close()
        self._saver.close()

    def _times(self, step: int) -> dict[str, float]:
        """The speed since the last line, everything included, and the seconds of the loop's bodies by their use."""
        now = time.monotonic()
        collect, body = self.env.collecting.take(), self._body_time + now - self._body_began
        speed = (step - self._line_step) / max(now - self._line_time, 1e-9)
        self._line_time, self._line_step = now, step
        self._body_time, self._body_began = 0.0, now
        return {"time/steps_per_second": speed, "time/collect": collect, "time/learn": body - collect}

    def _between(self, state: TrainState, before: int, episodes_before: int, total_steps: int) -> bool:
        """Do what is due after an update; returns whether the run goes on."""
        whole = not self._cut_short  # else it evaluates, films and plans what the next process will do
        if whole and _passed(self.config.evaluate_every, before, state.step):
            self._evaluate(state)
        by_episodes = _passed(self.config.video_every_episodes, episodes_before, self._episodes)
        if whole and (by_episodes or _passed(self.config.video_every, before, state.step)):
            self._record(state)
        finished = whole and state.step >= total_steps
        planned = finished or (whole and _passed(self._checkpoint_interval(), before, state.step))
        if planned:
            with self.world.busy():
                self._saver.save(state, planned=True, logged=self._logged)
            self.world.saved(self.path)
        stop, signum = self._asked_to_stop(state, planned)
        if stop and not finished:
            self._tell_stop(state.step, signum)
        elif planned and not finished:
            self._restart(state)
        return not (stop or finished)

    def _asked_to_stop(self, state: TrainState, saved: bool) -> tuple[bool, int]:
        """Whether the run stops, and by which signal, or 0. The state is saved then, and where a callback fails."""
        lines, self._unobserved = self._unobserved, []
        stop, signum = True, 0
        try:
            with globals_undisturbed():
                answers = [self._observer(step, numbers, state) for step, numbers in lines] if self._observer else []
            said = self.world.each((any(answers), self._stop_signal))  # a signal from here on counts at the next update
            signum = max(signum for _, signum in said)
            stop = any(asked for asked, _ in said) or bool(signum)
        finally:
            if stop:
                self._hurry.cancel()  # the update has ended; the disk may take its time
            if stop and not saved and state.step > self._saver.planned_at:
                self._saver.save(state, planned=False, logged=self._logged)
        return stop, signum

    def _tell_stop(self, step: int, signum: int) -> None:
        saved = "not saved" if self._saver.failure else "saved"
        by = "" if signum else "by a callback "
        message = (
            f"Stopped {by}at step {step:,}; the policy is {saved}. Go on with: {resume_line(self.path)}\n"
            f"It resumes at step {self._saver.last_planned:,}, the last planned checkpoint, and ends in the same bits"
            " as a run that was never stopped."
        )
        if signum:
            raise Stopped(message if self.world.is_first else "", signum)
        if self.world.is_first:
            say(message)

    def _restart(self, state: TrainState) -> None:
        seed, shards = derive(self.config.seed, TRAINING, state.step), state.shards
        seed_globals(seed)  # nothing here draws from them, but a user's environment may
        seeds = [derive(seed, shard) for shard in shards.held] if shards.count > 1 else [seed]
        self.env.restart(*seeds, steps=state.step)
        state.on_restart()

    def _begin_warm(self, state: TrainState) -> None:
        sentence = load_networks(state.networks, self.config, self.spec)
        state.on_warm_start()
        if self._visible:
            say(sentence)

    def _checkpoint_interval(self) -> int:
        """The configured interval; else a fifth of the run, or three episodes of each environment if that is longer.

        Where a limit is above 1,000 steps, as the 27,000 of Atari's, episodes hardly ever last so long.
        """
        longest = min(self.spec.max_episode_steps or 0, 1000)
        fifth = -(-self.config.total_steps // 5)
        return self.config.checkpoint_every or max(fifth, 3 * longest * self.config.num_envs)

    def _record(self, state: TrainState) -> None:
        if not self.world.is_first:
            return
        try:
            with globals_undisturbed(), self.world.busy():
                if self._film:
                    self._film(state)
        except (UserError, OSError) as error:  # no display any more, a full disk: it costs this recording, not the run
            say(f"No recording at step {state.step:,}: {error}")

    def _evaluate(self, state: TrainState) -> None:
        if not self.eval_env:
            return
        try:
            with globals_undisturbed(), self.world.busy():
                config, critic = self.config, critic_of(state.networks, self.config)
                scores = evaluate(state.policy, self.eval_env, config.evaluate_episodes, config.seed, critic=critic)
        except UserError as error:  # an endless episode costs this evaluation, not the run
            say(f"No evaluation at step {state.step:,}: {error}")
            return
        self._write(state.step, {f"evaluation/{name}": value for name, value in scores.means().items()})

    def _write(self, step: int, numbers: dict[str, float], episodes: Episodes = NO_EPISODES) -> None:
        for logger in self._loggers:
            logger.write(step, numbers, episodes)
        self._logged = step
        self._unobserved.append((step, numbers))

    def _stop(self, signum: int, _frame: FrameType | None) -> None:
        """Stop after the current update; asked again, or if that takes longer than `PATIENCE`, at once."""
        if self._stop_signal and self.world.size > 1 and time.monotonic() - self._asked_at < self._patience - 1:
            return  # a launcher sends on what each process has been sent
        if self._stop_signal:
            self._hurry.cancel()
            raise Stopped(
                f"Stopped in the middle of an update, which is not saved. Go on with: {resume_line(self.path)}\n"
                f"It resumes at step {self._saver.last_planned:,}, the last planned checkpoint.",
                self._stop_signal,
            )
        self._stop_signal, self._asked_at = signum, time.monotonic()
        compiled.stopping.set()
        self._hurry.start()

    def _ask_again(self) -> None:
        """In a thread: send the signal again; where even that is not heard, end the process."""
        signal.pthread_kill(threading.main_thread().ident or 0, self._stop_signal)
        if not self._ended.wait(self._patience):
            say(f"Stopped; the update did not let itself be interrupted. Go on with: {resume_line(self.path)}")
            os._exit(128 + self._stop_signal)


def is_compiled(config: RunConfig) -> bool:
    """Whether a run is compiled: as configured; with "auto", if it is long enough to repay the compilation."""
    return config.compile == "on" or (config.compile == "auto" and config.gradient_steps >= WORTH_COMPILING)


def _passed(every: int, before: int, after: int) -> bool:
    """Whether a multiple of `every` lies after `before` and not after `after`; 0 stands for never."""
    return every > 0 and after // every > before // every


@contextmanager
def stop_signals_to(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Inside, `handler` receives Ctrl-C, SIGTERM, and the end of the terminal unless nohup has it ignored.

    Off the main thread, where no handler can be, they are left alone.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    hang_up = [signal.SIGHUP] if signal.getsignal(signal.SIGHUP) is signal.SIG_DFL else []
    previous = {signum: signal.signal(signum, handler) for signum in (signal.SIGINT, signal.SIGTERM, *hang_up)}
    try:
        yield
    finally:
        for signum, handler_before in previous.items():
            signal.signal(signum, handler_before)
