"""Several descents by turns, as one native call."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call

from lemniscate.maths import means
from lemniscate.nn.descent import STEPS_PER_CALL, Descent, in_calls
from lemniscate.nn.native import Native

Watched = list[dict[str, Tensor]]
Learn = Callable[..., Watched]
"""learn(config, state, turns, batch, *by_step) -> what each step watched; row k of `by_step` is for step k"""


class Joint:
    """`learn`, in which `descents` take turns, each seeing where the others have come to.

    It may do what lies between their steps as well: gather rows, move targets.
    """

    def __init__(self, learn: Learn, *descents: Descent[Any]) -> None:
        self._learn = learn
        self._descents = descents
        self._networks = _Networks(learn, [descent.objective for descent in descents])
        self._programs: dict[tuple[bool, ...], Native[..., Watched]] | None = None

    def __call__(
        self, config: Any, state: Any, turns: Sequence[bool], batch: Any, *by_step: Tensor
    ) -> Mapping[str, Tensor]:
        """As `learn`; once native, with the same shapes at every call, and up to four steps in each native one.

        Args:
            config: for `learn`.
            state: for `learn`, which may change its tensors, and nothing else of it.
            turns: for each of K steps, whether it is one at which everything moves.
            batch: record of tensors [B, …].
            *by_step: tensors [K, …].

        Returns:
            Means over the steps of what they watched.
        """
        if self._programs is None:
            return means(self._learn(config, state, turns, batch, *by_step))
        watched: Watched = []
        done = 0
        for chunk in in_calls(STEPS_PER_CALL, *by_step):
            now = tuple(turns[done : done + len(chunk[0])])
            if now not in self._programs:
                self._programs[now] = Native(self._functional, self._learn, self._descents[0].device)
            watched += self._programs[now](config, state, now, batch, *chunk)
            done += len(now)
        return means(watched)

    def make_native(self) -> None:
        """From the next call on, each pattern of turns is a program of its own."""
        self._programs = {}

    def _functional(self, *args: Any) -> Watched:
        """`learn`, while the networks are made of views of the vectors that the descents move."""
        owned = enumerate(descent.parameters() for descent in self._descents)
        views = {f"objectives.{i}.{name}": view for i, parameters in owned for name, view in parameters.items()}
        with torch.no_grad():
            return functional_call(self._networks, views, args)


class _Networks(nn.Module):
    """`learn` as a module, so that `functional_call` can put other parameters under it."""

    def __init__(self, learn: Learn, objectives: list[nn.Module]) -> None:
        super().__init__()
        self.objectives = nn.ModuleList(objectives)
        self._learn = learn

    def forward(self, *args: Any) -> Watched:
        return self._learn(*args)
