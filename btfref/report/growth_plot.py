"""How the cost of synthesis grows, as a figure."""

from __future__ import annotations

from collections.abc import Sequence

from btfref.types import Facts, PathLike


def plot_growth(rows: Sequence[Facts], path: PathLike) -> None:
    """Draw time and memory against each quantity that was varied.

    Parameters
    ----------
    rows : list of dict
        ``growth`` of the result of `btfref.bench.synth.run`.
    path : path-like
        Image to write.
    """
    import numpy as np
    from matplotlib.figure import Figure

    from btfref.report.pareto import name_ticks

    names = {"texels": "texels along a side", "n_directions": "views = lights", "max_depth": "depth"}
    figure = Figure(figsize=(9, 3), layout="constrained")
    for axis, (name, label) in zip(figure.subplots(1, len(names)), names.items(), strict=True):
        some = [row for row in rows if row["varied"] == name.removeprefix("n_")]
        x = [row[name] for row in some]
        axis.loglog(x, [row["seconds"] for row in some], "o-", label="time (s)")
        axis.loglog(x, [row["peak_bytes"] / 2**30 for row in some], "s--", label="peak memory (GiB)")
        axis.set_xticks(x, [str(value) for value in x])
        axis.minorticks_off()
        name_ticks(axis.yaxis, np.array([[row["seconds"], row["peak_bytes"] / 2**30] for row in some]))
        axis.set_xlabel(label)
        axis.grid(alpha=0.3, which="both")
    figure.axes[0].legend()
    figure.savefig(path, dpi=150)
