"""Error of pictures against the order of the spherical harmonics that light them."""

from __future__ import annotations

from collections.abc import Sequence

from btfref.types import Facts, PathLike


def plot_orders(entries: Sequence[Facts], path: PathLike) -> None:
    """Error against the order of spherical harmonics, one line an environment.

    Parameters
    ----------
    entries : sequence of dict
        ``environment``, ``way`` ("order n"; others are left out), ``window``, ``rmse``; see
        :mod:`btfref.bench.experiments.env`.
    path : path-like
        ``.png``.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.subplots()
    entries = [e for e in entries if e["way"].startswith("order")]
    for number, environment in enumerate(dict.fromkeys(e["environment"] for e in entries)):
        for window, style in (("none", "-"), ("hanning", ":")):
            own = [e for e in entries if (e["environment"], e["window"]) == (environment, window)]
            label = environment if window == "none" else None
            orders = [int(e["way"].split()[1]) for e in own]
            axes.semilogy(
                orders, [e["rmse"] for e in own], style, marker="o", color=f"C{number}", label=label
            )
    axes.set_xlabel("order of spherical harmonics (dotted: Hanning window)")
    axes.set_ylabel("relative RMSE of the picture")
    axes.legend()
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=120)
