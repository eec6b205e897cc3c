"""A learning curve that grows below the cell of a notebook while the run trains."""

import io
import time
from collections.abc import Mapping
from typing import Any

from matplotlib.figure import Figure

from lemniscate.report.style import finish
from lemniscate.system.console import in_notebook
from lemniscate.system.notebook import Place


class LiveCurve:
    """A callback that draws the returns of training episodes, and of evaluations where the run has them.

        lem.train("ppo", "CartPole-v1", callbacks=[LiveCurve()])

    The picture is replaced at most once in `seconds`, and at the end of the run. Outside a notebook nothing is drawn.
    """

    def __init__(self, seconds: float = 1.0) -> None:
        self.seconds = seconds
        self._drawn = -float("inf")
        self._place = Place()
        self._curves: dict[str, list[tuple[int, float]]] = {"episode/return": [], "evaluation/return": []}

    def __call__(self, step: int, metrics: Mapping[str, float], policy: Any) -> None:
        """Take the returns of one line, and draw if it is time."""
        for name, points in self._curves.items():
            if name in metrics:
                points.append((step, metrics[name]))
        due = time.monotonic() - self._drawn >= self.seconds or step >= policy.config.total_steps
        if due and any(self._curves.values()) and in_notebook():
            from IPython.display import Image

            self._place.show(Image(self.draw(policy.config), format="png"))
            self._drawn = time.monotonic()

    def draw(self, config: Any) -> bytes:
        """The curves so far as a PNG; `config` has the title and the length of the run."""
        figure = Figure(figsize=(7, 3), layout="constrained")
        axes = figure.subplots()
        for points, style, label in zip(self._curves.values(), ("-", "o-"), ("training", "evaluation"), strict=True):
            if points:
                axes.plot(*zip(*points, strict=True), style, label=label, linewidth=1.5, markersize=4)
        axes.set(xlabel="environment steps", ylabel="return of an episode", xlim=(0, config.total_steps))
        axes.set_title(f"{config.env}, seed {config.seed}", loc="left")
        axes.legend(frameon=False)
        finish(axes)
        png = io.BytesIO()
        figure.savefig(png, format="png", dpi=90)
        return png.getvalue()
