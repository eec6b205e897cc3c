"""Callbacks: what a user's functions are called with after each logged line, and when they stop a run."""

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from lemniscate.api.policy import TrainedPolicy
from lemniscate.errors import UserError, shown
from lemniscate.run.config import RunConfig
from lemniscate.run.run import Observer
from lemniscate.run.state import TrainState
from lemniscate.spec import Spec

if TYPE_CHECKING:
    from lemniscate.doctor import Attendance

Callback = Callable[[int, Mapping[str, float], TrainedPolicy], object]
"""(step, metrics, policy) of a logged line; a true result stops the run"""


class StopAt:
    """Stops a run at its first logged line at or after so many steps; `resume` goes on with it.

    Args:
        steps: if they are planned checkpoints, nothing is computed again when the run goes on.
    """

    def __init__(self, steps: int) -> None:
        self.steps = steps

    def __call__(self, step: int, _metrics: Mapping[str, float], _policy: TrainedPolicy) -> bool:
        """Whether the run has come so far."""
        return step >= self.steps


class PolicySnapshot(TrainedPolicy):
    """The policy of a run at the line that a callback is shown. Its weights are copied when it is first used.

    A callback may keep a policy that it has used. One that it has not used raises `UserError` later.
    """

    def __init__(self, state: TrainState, spec: Spec, config: RunConfig, step: int) -> None:
        self.spec, self.config, self.step = spec, config, step
        self._state: TrainState | None = state

    @cached_property
    def networks(self) -> Any:
        """The copy, on the CPU."""
        if self._state is None:
            why = "was not used while its callback ran, and the run has changed since"
            raise UserError(f"This policy {why}; use it there.")
        networks = self.config.networks(self.spec)
        networks.load_state_dict(self._state.networks.state_dict())
        return networks.eval()

    def __getstate__(self) -> dict[str, Any]:  # of a copy: the run goes on with the state
        return {**vars(self), "networks": self.networks, "_state": None}

    def expire(self) -> None:
        """Refuse to copy the weights from now on: the run goes on to change them."""
        self._state = None


def call_callbacks(
    functions: Sequence[Callback],
    spec: Spec,
    config: RunConfig,
    attend: "Attendance | None",
) -> Observer:
    """The function that a run calls after each logged line: every callback in turn, each with a policy of its own.

    Before them `attend` gets the step and the metrics of a line that has signals.
    """

    def observe(lines: Sequence[tuple[int, Mapping[str, float]]], state: TrainState) -> bool:
        stop = False
        for step, metrics in lines:
            if attend and metrics.get("episode/return"):
                attend.was_paid = True
            if attend and "reward/largest" in metrics:
                attend(step, metrics)
            for function in functions:
                policy = PolicySnapshot(state, spec, config, step)
                said = function(step, MappingProxyType(dict(metrics)), policy)
                if not isinstance(said, bool | np.bool_ | None):
                    raise UserError(
                        f"A callback returns True to stop, or False or None; {shown(function)} returned {shown(said)}."
                    )
                stop = bool(said) or stop
                policy.expire()
        return stop

    return observe
