"""Two costs against each other: what no other choice beats in both stands out, the rest is dimmed.

Both costs are positive and smaller is better: error against time, bytes, or evaluations. A point is dominated when
another is at most as large in both costs and smaller in one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from btfref.errors import InputError
from btfref.types import PathLike

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure
    from matplotlib.transforms import Bbox


#: Colours (Okabe and Ito 2008: told apart by the colour-blind) and markers of groups, in their order; as their numbers
#: differ by one, 56 groups look different.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#000000", "#e69f00", "#56b4e9")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")

#: Opacity of dominated points and their names.
DIM = 0.35

#: Places of a name around its point in points of the page, best first; the front's line leaves points to the right.
_PLACES = tuple(
    (distance * x, distance * y)
    for distance in (6, 13, 22, 33)
    for x, y in ((0.7, 0.9), (1, 0), (0.7, -0.9), (-1, 0), (-0.7, 0.9), (-0.7, -0.9), (0, 1.1), (0, -1.1))
)


@dataclass(frozen=True)
class Point:
    """One choice: its name and its two costs, both above 0; points of a group share a colour.

    ``low`` and ``high`` are the ends of an interval about ``y``, drawn as a bar.
    """

    name: str
    x: float
    y: float
    group: str = ""
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True)
class Panel:
    """One diagram: points and what their costs are, with units."""

    title: str
    x_label: str
    y_label: str
    points: list[Point] = field(default_factory=list)


def front(points: Sequence[Point]) -> np.ndarray:
    """Which points no other one dominates.

    Parameters
    ----------
    points : sequence of Point

    Returns
    -------
    ndarray of bool, shape (len(points),)
        Equal points do not dominate each other.

    Raises
    ------
    InputError
        For a cost that is not finite or not above 0.
    """
    cost = np.array([(p.x, p.y) for p in points], float).reshape(-1, 2)
    wrong = ~(np.isfinite(cost) & (cost > 0)).all(1)
    if wrong.any():
        bad = points[int(np.argmax(wrong))]
        raise InputError(
            "not a cost", field=bad.name, got=f"({bad.x:g}, {bad.y:g})", expected="finite numbers above 0"
        )
    no_worse = (cost[:, None] <= cost[None]).all(-1)
    better = (cost[:, None] < cost[None]).any(-1)
    return np.logical_not((no_worse & better).any(0))


def pareto_table(panel: Panel) -> list[str]:
    """The points of a panel as a table in Markdown, by the first cost; what stands on the front is bold.

    Parameters
    ----------
    panel : Panel

    Returns
    -------
    list of str
        Lines.

    Raises
    ------
    InputError
        See :func:`front`.
    """
    best = front(panel.points)
    groups = any(p.group for p in panel.points)
    header = ["", panel.x_label, panel.y_label, "dominated by"]
    lines = [[*header[:1], *(["of"] if groups else []), *header[1:]]]
    lines.append(["---"] * len(lines[0]))
    for i in sorted(range(len(best)), key=lambda i: (panel.points[i].x, panel.points[i].y)):
        p = panel.points[i]
        by = [q.name for q in panel.points if q.x <= p.x and q.y <= p.y and (q.x < p.x or q.y < p.y)]
        name = f"**{p.name}**" if best[i] else p.name
        error = f"{p.y:.4g}" if p.low is None else f"{p.y:.4g} ({p.low:.3g} … {p.high:.3g})"
        lines.append([name, *([p.group] if groups else []), f"{p.x:.4g}", error, ", ".join(by)])
    return ["| " + " | ".join(cells) + " |" for cells in lines]


def draw_pareto(panels: Sequence[Panel], path: PathLike | IO[Any]) -> None:
    """Write panels as one picture: up to three side by side, more of them in rows of two.

    Parameters
    ----------
    panels : sequence of Panel
        Each holds at least one point; groups of the same name share a colour across panels.
    path : path-like or file object
        PNG, SVG or PDF by its suffix; a file object gets a PNG.

    Raises
    ------
    InputError
        See :func:`front`.
    """
    _figure(panels).savefig(path, dpi=150)


def pareto_svg(panels: Sequence[Panel]) -> str:
    """The same picture as an ``<svg>`` element, to be set into a page.

    Returns
    -------
    str
    """
    import io

    import matplotlib as mpl

    text = io.StringIO()
    # A fixed salt keeps the ids, and with them the page, the same from run to run.
    with mpl.rc_context({"svg.hashsalt": "btfref", "svg.fonttype": "none"}):
        _figure(panels).savefig(text, format="svg", metadata={"Date": None})
    whole = text.getvalue()
    return whole[whole.index("<svg") :].strip()


def _figure(panels: Sequence[Panel]) -> Figure:
    from matplotlib.figure import Figure

    groups = list(dict.fromkeys(p.group for panel in panels for p in panel.points))
    columns = len(panels) if len(panels) <= 3 else 2
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(5.2 * columns, 4.2 * rows), layout="constrained")
    axes = list(figure.subplots(rows, columns, squeeze=False).flat)
    for axis in axes[len(panels) :]:
        axis.remove()
    axes = axes[: len(panels)]
    pending = [_draw(axis, panel, groups) for axis, panel in zip(axes, panels, strict=True)]
    if len(groups) > 1:
        handles, names = axes[0].get_legend_handles_labels()
        figure.legend(
            handles,
            names,
            loc="outside lower center",
            ncols=min(len(groups), 4 * columns),
            fontsize=8,
            frameon=False,
        )
    # Names are placed last, when limits and layout are known.
    figure.draw_without_rendering()
    for axis, marks in zip(axes, pending, strict=True):
        _place_names(axis, marks)
    return figure


def _draw(axis: Axes, panel: Panel, groups: Sequence[str]) -> list[tuple[Point, bool]]:
    """Points and the front of a panel; returns what there is to name."""
    best = front(panel.points)
    x, y = (np.array([getattr(p, c) for p in panel.points]) for c in "xy")
    order = np.flatnonzero(best)[np.argsort(x[best])]
    axis.set_xscale("log")
    axis.set_yscale("log")
    axis.plot(x[order], y[order], "-", color="0.6", lw=1, drawstyle="steps-post", zorder=1)
    for k, group in enumerate(groups):
        colour, marker = COLOURS[k % len(COLOURS)], MARKERS[k % len(MARKERS)]
        for i, p in enumerate(panel.points):
            if p.group != group:
                continue
            opacity = 1 if best[i] else DIM
            axis.plot(p.x, p.y, marker, color=colour, ms=6, alpha=opacity, mec="none", zorder=3)
            if p.low is not None and p.high is not None:
                axis.plot([p.x, p.x], [p.low, p.high], "-", color=colour, alpha=opacity, lw=1.2, zorder=2)
        axis.plot([], [], marker, color=colour, ms=6, mec="none", label=group or "all")
    axis.margins(0.12)
    name_ticks(axis.xaxis, x)
    name_ticks(axis.yaxis, y)
    axis.set(title=panel.title, xlabel=panel.x_label, ylabel=panel.y_label)
    axis.grid(alpha=0.25, which="both", lw=0.5)
    axis.set_axisbelow(True)
    return [(p, bool(b)) for p, b in zip(panel.points, best, strict=True)]


def name_ticks(axis: Axis, values: np.ndarray) -> None:
    """Plain numbers at 1, 2 and 5 where costs span less than two decades; powers of ten alone otherwise."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    if values.max() < 100 * values.min():
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _place_names(axis: Axes, marks: Sequence[tuple[Point, bool]]) -> None:
    """Write names beside their points, each at the first place where it covers nothing else."""
    frame = axis.get_window_extent()
    taken = [_around(axis, p) for p, _ in marks]
    # Names on the front choose first.
    for p, best in sorted(marks, key=lambda mark: not mark[1]):
        label = axis.annotate(
            p.name,
            (p.x, p.y),
            xytext=_PLACES[0],
            textcoords="offset points",
            fontsize=8,
            alpha=1 if best else max(DIM, 0.5),
            fontweight="bold" if best else "normal",
            zorder=4,
        )
        for place in _PLACES:
            label.xyann = place
            label.set_horizontalalignment("left" if place[0] > 0 else "right" if place[0] < 0 else "center")
            label.set_verticalalignment(
                "center" if abs(place[1]) < 1 else "bottom" if place[1] > 0 else "top"
            )
            box = label.get_window_extent()
            inside = frame.x0 <= box.x0 and box.x1 <= frame.x1 and frame.y0 <= box.y0 and box.y1 <= frame.y1
            own = _around(axis, p)
            others = [t for t in taken if not np.allclose(t.extents, own.extents)]
            if inside and not any(box.overlaps(other) for other in others):
                break
        taken.append(label.get_window_extent())


def _around(axis: Axes, point: Point, half: float = 4) -> Bbox:
    """The square on the page that a point covers."""
    from matplotlib.transforms import Bbox

    x, y = axis.transData.transform((point.x, point.y))
    return Bbox.from_extents(x - half, y - half, x + half, y + half)
