"""Callbacks: functions of the user's that see a run while it trains, and may stop it."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import Any

import torch

from lemniscate.api.policy import TrainedPolicy
from lemniscate.errors import UserError, shown
from lemniscate.run.config import RunConfig
from lemniscate.run.run import Observer
from lemniscate.run.seeding import generator
from lemniscate.run.state import TrainState
from lemniscate.spec import Spec
from lemniscate.system import named

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

    def __init__(self, copy_networks: Callable[[], Any], spec: Spec, config: RunConfig, step: int) -> None:
        self.spec, self.config, self.step = spec, config, step
        self._copy_networks = copy_networks
        self._noise = generator(config.seed, torch.device("cpu"), 4)

    def __getattr__(self, name: str) -> Any:  # called for what is not there: the networks, until they are copied
        if name != "networks":
            raise AttributeError(f"A policy has no attribute {name!r}.")
        self.networks = self._copy_networks().eval()
        return self.networks

    def expire(self) -> None:
        """Refuse to copy the weights from now on: the run goes on to change them."""
        self._copy_networks = _too_late


def find_callbacks(callbacks: Callback | str | Sequence[Callback | str]) -> list[Callback]:
    """The functions themselves: of functions, or names of functions, as in `train`, or one of these.

    Raises:
        UserError: a callback that cannot be loaded or called.
    """
    several: Sequence[Any] = callbacks if isinstance(callbacks, list | tuple) else [callbacks]
    functions = [_by_name(one) if isinstance(one, str) else one for one in several]
    for function in functions:
        if not named.takes(function, 3):
            raise UserError(f"A callback must be a function of (step, metrics, policy), not {shown(function)}.")
    return functions


def _by_name(name: str) -> Any:
    """The function `module:function`, or an object of `module:Class(key=value, …)`. Raises `UserError`."""
    found = named.find_callable(name)
    made = found.func if isinstance(found, partial) else found
    if not isinstance(made, type):
        return found
    try:
        return found()
    except TypeError as error:
        raise UserError(f"{name} cannot be made; give its arguments as module:Class(key=value, …): {error}.") from error


def call_callbacks(
    functions: Sequence[Callback], copy_networks: Callable[[TrainState], Any], spec: Spec, config: RunConfig
) -> Observer:
    """The function that a run calls after each logged line: every callback in turn, each with a policy of its own.

    Args:
        functions: the callbacks.
        copy_networks: networks on the CPU that share nothing with those of the state.
        spec: of the policy.
        config: of the run.
    """

    def observe(step: int, metrics: Mapping[str, float], state: TrainState) -> bool:
        stop = False
        for function in functions:
            policy = PolicySnapshot(lambda: copy_networks(state), spec, config, step)
            stop = bool(function(step, MappingProxyType(dict(metrics)), policy)) or stop
            policy.expire()
        return stop

    return observe


def _too_late() -> Any:
    raise UserError("This policy was not used while its callback ran, and the run has changed since; use it there.")
