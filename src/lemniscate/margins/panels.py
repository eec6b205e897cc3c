"""The panels of the picture of margins."""

from lemniscate.envs.probe import Axis, Value
from lemniscate.margins.record import AxisMargins
from lemniscate.margins.sentences import span, within
from lemniscate.report.margins_plot import Panel


def panel(one: AxisMargins, episodes: int) -> Panel:
    """The panel of an axis."""
    axis, inside = one.axis, within(one, episodes)
    places = [_place(axis, value) for value in axis.values]
    ends = [side.last for side in one.sides.values() if side.first is not None]
    return Panel(
        title=axis.title,
        unit=axis.shown_unit,
        values=places,
        names=[str(value) for value in axis.values] if isinstance(axis.nominal, str) else [],
        nominal=_place(axis, axis.nominal),
        margin=(_place(axis, inside[0]), _place(axis, inside[-1])) if inside else None,
        edges=[_place(axis, value) for value in ends if value is not None],
        margin_text=(span(axis, inside) if one.sides else "") if inside else "none",
        alive=[alive / episodes for alive in one.alive],
        returns=one.mean_returns,
    )


def _place(axis: Axis, value: Value) -> float:
    """The place of a value on the horizontal axis; words stand side by side."""
    return float(axis.values.index(value)) if isinstance(value, str) else axis.number(value)
