"""What surrounds a training loop: the generator that the loop is written over.

    for env in run.until(config.total_steps, state):
        ...one update...

Between two bodies the generator logs, evaluates, saves and stops; the loop knows nothing of it.

A checkpoint is a place where the run starts anew: there the environments restart from a seed derived from (run seed,
step), in a run that goes on as in one that is resumed. So both end in the same bits, whatever the simulator.
"""

import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TypeVar

import torch
from filelock import FileLock, Timeout

from lemniscate.data.replay import bytes_per_transition
from lemniscate.envs.episodes import Episodes
from lemniscate.envs.vec_env import VecEnv
from lemniscate.errors import NonFiniteError, UserError
from lemniscate.nn.networks import has_bfloat16
from lemniscate.run import checkpoint
from lemniscate.run.config import OffPolicyConfig, RunConfig
from lemniscate.run.directory import create_directory, newest_resumable
from lemniscate.run.evaluate import evaluate
from lemniscate.run.loggers import LOGGERS, NO_EPISODES, Logger
from lemniscate.run.progress import ProgressBar
from lemniscate.run.q_bias import critic_of
from lemniscate.run.seeding import derive, globals_undisturbed, seed_globals
from lemniscate.run.state import TrainState

WORTH_COMPILING = 15_000
"""gradient steps of a run from which on a native one is sooner done"""

TRAINING = 0
"""the stream of seeds that training environments restart from"""


S = TypeVar("S", bound=TrainState)


class Stopped(KeyboardInterrupt):
    """The run was asked to stop (Ctrl-C, SIGTERM), and has saved itself."""

    def __init__(self, message: str, signum: int) -> None:
        super().__init__(message)
        self.signum = signum


class Run:
    """A run directory, its loggers, and its environments."""

    def __init__(
        self,
        path: Path,
        algorithm: str,
        config: RunConfig,
        envs: tuple[VecEnv, VecEnv],
        *,
        loggers: tuple[str, ...] = ("jsonl", "tensorboard"),
        progress: bool = True,
        film: Callable[[TrainState], None] | None = None,
    ) -> None:
        self.path, self.algorithm, self.config = path, algorithm, config
        self.env, self.eval_env = envs
        self.spec = self.env.spec
        self._logger_names, self._visible, self._film = loggers, progress, film
        self._loggers: list[Logger] = []
        self._stop_signal = 0
        self._recent: list[float] = []
        self._lock = FileLock(path / ".lock", timeout=0)

    def announce(self) -> None:
        """Say what the run is about to take; to be called before there is a state."""
        config = self.config
        if self._visible and isinstance(config, OffPolicyConfig):
            size = config.capacity * bytes_per_transition(self.spec) / 1e6
            print(
                f"It will remember {config.capacity:,} transitions: {size:,.1f} MB, and as much in each checkpoint.",
                file=sys.stderr,
            )
            if config.matmul == "bfloat16" and not has_bfloat16(self.env.device):
                print("This processor has no products in bfloat16; --matmul float32 is faster.", file=sys.stderr)

    def restore(self, state: S) -> S:
        """Fill `state` from the newest checkpoint to resume from, if there is one; then open the loggers.

        A new run gets its directory here: what no state can be made for leaves nothing behind.
        """
        if not (self.path / "config.json").exists():
            create_directory(self.path, "config.json", {"algorithm": self.algorithm, "config": self.config.to_json()})
        try:
            self._lock.acquire()
        except Timeout:
            raise UserError(f"{self.path} is being trained by another process.") from None
        found = newest_resumable(self.path)
        if found:
            found.restore(state)
        elif checkpoint.list_steps(self.path / "checkpoints"):
            print(f"{self.path} has no planned checkpoint to go on from; it begins again at step 0.", file=sys.stderr)
        self._forget_after(state.step)
        self._choose_engine(state)
        config = {"algorithm": self.algorithm, **self.config.to_json()}
        for name in self._logger_names:
            self._loggers.append(LOGGERS[name](self.path, config, state.step))
        return state

    def until(self, total_steps: int, state: TrainState) -> Iterator[VecEnv]:
        """The environments, once for each update, until `total_steps` are taken.

        Raises:
            Stopped: after a signal, when the current update is done and saved.
        """
        self._bar = ProgressBar(total_steps, state.step, self._visible)
        started = time.monotonic()
        self._clock, self._clock_step = started, state.step
        try:
            with self._catching_signals():
                if state.step == 0:
                    self._record(state)
                self._restart(state)
                while state.step < total_steps:
                    before = state.step
                    yield self.env
                    self._between(state, before, total_steps)
        finally:
            self.seconds = time.monotonic() - started
            self._bar.close()

    def log(self, state: TrainState, metrics: Mapping[str, torch.Tensor | float], episodes: Episodes) -> None:
        """Write one line of metrics.

        Raises:
            NonFiniteError: a loss or the gradient is NaN or infinite; the last checkpoint is untouched.
        """
        numbers = {name: float(value) for name, value in metrics.items()}
        for name, value in numbers.items():
            if name.startswith(("losses/", "gradient")) and not -float("inf") < value < float("inf"):
                raise NonFiniteError(f"{name} is {value} in the update that ends at step {state.step:,}.")
        if episodes.returns:
            self._recent = (self._recent + episodes.returns)[-100:]
            numbers["episode/return"] = sum(episodes.returns) / len(episodes.returns)
            numbers["episode/length"] = sum(episodes.lengths) / len(episodes.lengths)
        now = time.monotonic()
        numbers["time/steps_per_second"] = (state.step - self._clock_step) / max(now - self._clock, 1e-9)
        self._clock, self._clock_step = now, state.step
        self._write(state.step, numbers, episodes)
        self._bar.update(state.step, sum(self._recent) / len(self._recent) if self._recent else None)

    def close(self, pictures: list[Path] | None = None) -> None:
        """Close loggers and environments, and give the directory free."""
        for logger in self._loggers:
            logger.close(pictures or [])
        self.env.close()
        self.eval_env.close()
        self._lock.release()

    def _choose_engine(self, state: TrainState) -> None:
        if engine_of(self.config) == "native":
            if self._visible:
                print(
                    "Compiling: half a minute or a whole one the first time, 5 to 10 s from then on.", file=sys.stderr
                )
            state.compile()

    def _restart(self, state: TrainState) -> None:
        seed = derive(self.config.seed, TRAINING, state.step)
        seed_globals(seed)  # nothing here draws from them, but somebody's environment may
        self.env.restart(seed, state.step)
        state.on_restart()

    def _checkpoint_interval(self) -> int:
        """As asked for; else a fifth of the run, but room for three whole episodes of each copy between restarts."""
        longest = self.spec.max_episode_steps or 0
        fifth = -(-self.config.total_steps // 5)
        return self.config.checkpoint_every or max(fifth, 3 * longest * self.config.num_envs)

    def _between(self, state: TrainState, before: int, total_steps: int) -> None:
        every, interval = self.config.evaluate_every, self._checkpoint_interval()
        if every and state.step // every > before // every:
            self._evaluate(state)
        every = self.config.video_every
        if every and state.step // every > before // every:
            self._record(state)
        finished = state.step >= total_steps
        planned = finished or state.step // interval > before // interval
        if planned:
            self._save(state, planned=True)
        if planned and not finished:
            self._restart(state)
        if self._stop_signal and not finished:
            if not planned:
                self._save(state, planned=False)
            last = newest_resumable(self.path)
            message = (
                f"Stopped at step {state.step:,}; the policy is saved. Go on with: lemniscate resume {self.path}\n"
                f"It takes up the run at step {last.numbers['step'] if last else 0:,}, the last planned checkpoint, and"
                " ends in the bits of a run that was never stopped."
            )
            raise Stopped(message, self._stop_signal)

    def _record(self, state: TrainState) -> None:
        if not (self.config.video_every and self._film):
            return
        try:
            with globals_undisturbed():
                self._film(state)
        except (UserError, OSError) as error:  # no display any more, a full disk: it costs this recording, not the run
            print(f"No recording at step {state.step:,}: {error}", file=sys.stderr)

    def _evaluate(self, state: TrainState) -> None:
        try:
            with globals_undisturbed():
                critic = critic_of(state.networks, self.config)
                episodes, seed = self.config.evaluate_episodes, self.config.seed
                scores = evaluate(state.policy, self.eval_env, episodes, seed, critic=critic)
        except UserError as error:  # an endless episode costs this evaluation, not the run
            print(f"No evaluation at step {state.step:,}: {error}", file=sys.stderr)
            return
        metrics = {"evaluation/return": scores.mean_return, "evaluation/length": sum(scores.lengths) / scores.episodes}
        metrics |= {f"evaluation/{name}": value for name, value in scores.measures.items()}
        if scores.q_bias:
            predicted, realised = scores.q_bias.means
            metrics |= {"evaluation/q": predicted, "evaluation/q_realised": realised}
            metrics |= {"evaluation/q_bias": scores.q_bias.bias}
        self._write(state.step, metrics)

    def _write(self, step: int, numbers: dict[str, float], episodes: Episodes = NO_EPISODES) -> None:
        for logger in self._loggers:
            logger.write(step, numbers, episodes)

    def _save(self, state: TrainState, planned: bool) -> None:
        record = {
            "algorithm": self.algorithm,
            "planned": planned,
            "config": self.config.to_json(),
            "spec": checkpoint.spec_to_json(self.spec),
        }
        try:
            # An unplanned one is kept beside the planned ones, never in the place of one.
            keep = self.config.keep_checkpoints + (not planned)
            checkpoint.write(self.path / "checkpoints", state, state.step, record, keep)
        except OSError as error:  # a full disk costs this checkpoint, not the run, and not the checkpoints before it
            print(f"The checkpoint at step {state.step:,} could not be written: {error}.", file=sys.stderr)

    def _forget_after(self, step: int) -> None:
        """Checkpoints beyond the one resumed from are damaged or unplanned; the run will come by there again."""
        for later in checkpoint.list_steps(self.path / "checkpoints"):
            if later > step:
                shutil.rmtree(self.path / "checkpoints" / f"step-{later}")

    @contextmanager
    def _catching_signals(self) -> Iterator[None]:
        """Ctrl-C and SIGTERM wait for the end of the update; a second Ctrl-C does not wait."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return

        def remember(signum: int, _frame: FrameType | None) -> None:
            if self._stop_signal:
                raise KeyboardInterrupt
            self._stop_signal = signum

        previous = {signum: signal.signal(signum, remember) for signum in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for signum, handler in previous.items():
                signal.signal(signum, handler)


def engine_of(config: RunConfig) -> str:
    """The engine asked for; of itself, "native" for a run that is long enough to repay it, else "eager"."""
    if config.engine != "auto":
        return config.engine
    return "native" if config.gradient_steps >= WORTH_COMPILING else "eager"
