"""A sampled BTF as people look at one: contact sheet, apparent BRDFs, albedo, noise."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from btfref.errors import InputError
from btfref.numerics.colour import encode_srgb
from btfref.outputs import new_file
from btfref.sampling.store.store import BTFStore, open_store
from btfref.types import PathLike

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import SubFigure
    from matplotlib.image import AxesImage

    from btfref.numerics.sphere.directions import DirectionSet

#: Most views and most lights of the contact sheet, lights of the apparent BRDFs, views that maps are averaged over.
SHEET, LOBES, AVERAGED = 7, 4, 12

#: Pixels along one side of a hemisphere, and of a picture on the contact sheet at most.
DISK, THUMBNAIL = 160, 96

#: Decades that the apparent BRDFs show below their maximum.
DECADES = 2.0


def plot_btf(path: PathLike, out: PathLike, *, texel: Sequence[int] | None = None) -> None:
    """Draw a sampled BTF.

    Parameters
    ----------
    path : path-like
        A store, complete or not: what is not there is grey.
    out : path-like
        PNG to write.
    texel : (int, int), optional
        Row and column of the texel whose apparent BRDF is shown; by default the middle one.

    Raises
    ------
    InputError
        Not a store, an empty one, or no such texel.
    """
    store = open_store(path)
    if not store.coverage.any():
        raise InputError("nothing is there yet", file=path, field="coverage")
    rows, columns = store.texels
    row, column = (rows // 2, columns // 2) if texel is None else texel
    if not (0 <= row < rows and 0 <= column < columns):
        raise InputError(
            "no such texel", file=path, field="texel", got=texel, expected=f"within {rows}, {columns}"
        )

    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15, 13), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    top, bottom = figure.subfigures(2, 1, squeeze=False, height_ratios=(1.9, 1.0)).flat
    sheet, maps = top.subfigures(1, 2, squeeze=False, width_ratios=(2.1, 1.0)).flat
    scale = _contact_sheet(sheet, store)
    _maps(maps, store, scale)
    _lobes(bottom, store, (row, column))
    name = store.attributes.get("parent", {}).get("name", store.path.name)
    figure.suptitle(
        f"{Path(path).name}: {name}, {rows} × {columns} texels, {len(store.views)} views × {len(store.lights)} lights",
        fontsize=13,
    )
    with new_file(out) as draft:
        figure.savefig(draft, format="png", dpi=100)


def _spread(directions: DirectionSet, count: int) -> list[int]:
    """Directions that show how a set varies: along the meridian of its first azimuth, then across."""
    theta, phi = directions.theta, directions.phi
    rings = np.unique(np.round(theta, 6))
    chosen = [int(np.lexsort((np.round(phi, 6), np.round(np.abs(theta - ring), 5)))[0]) for ring in rings]
    if len(chosen) > count:
        chosen = [chosen[k] for k in np.unique(np.round(np.linspace(0, len(chosen) - 1, count)).astype(int))]
    low = np.argmin(np.abs(theta - 0.75 * theta.max()))
    for turn in (np.pi / 2, np.pi, 3 * np.pi / 2):
        if len(chosen) < count:
            away = np.abs(theta - theta[low]) + 0.5 * np.abs(np.angle(np.exp(1j * (phi - turn))))
            if (best := int(np.argmin(away))) not in chosen:
                chosen.append(best)
    return chosen


def _label(directions: DirectionSet, k: int) -> str:
    return f"{np.degrees(directions.theta[k]):.0f}°, {np.degrees(directions.phi[k]):.0f}°"


def _image(store: BTFStore, view: int, light: int) -> np.ndarray:
    """Values of one pair, (rows, columns, 3) float64; NaN where they are not there."""
    image = np.full((*store.texels, 3), np.nan)
    covered = store.covered(view)[light]
    for row, column in np.argwhere(covered):
        place = [
            slice(k * t, min((k + 1) * t, n))
            for k, t, n in zip((row, column), store.tile, store.texels, strict=True)
        ]
        values, _ = store.read(views=view, lights=light, rows=place[0], columns=place[1], variance=False)
        image[place[0], place[1]] = values[0, 0]
    return image


def _shown(image: np.ndarray, scale: float) -> np.ndarray:
    """Display colours in [0, 1]; grey where there is nothing."""
    there = np.isfinite(image).all(-1, keepdims=True)
    linear = np.clip(np.nan_to_num(image) * scale, 0, 1)
    return np.where(there, encode_srgb(linear), 0.55)


def _contact_sheet(figure: SubFigure, store: BTFStore) -> float:
    """View × light; the scale that brings the brightest per cent of all to white."""
    views, lights = _spread(store.views, SHEET), _spread(store.lights, SHEET)
    pictures = np.stack([[_image(store, v, k) for k in lights] for v in views])
    lit = pictures[np.isfinite(pictures)]
    scale = 1.0 / max(float(np.quantile(lit, 0.99)), 1e-12) if lit.size else 1.0
    step = max(1, -(-max(store.texels) // THUMBNAIL))
    axes = figure.subplots(len(views), len(lights), squeeze=False)
    for i, v in enumerate(views):
        for j, k in enumerate(lights):
            axis = axes[i, j]
            axis.imshow(
                _shown(pictures[i, j][::step, ::step], scale), origin="lower", interpolation="nearest"
            )
            axis.set(xticks=[], yticks=[])
            if i == 0:
                axis.set_title(_label(store.lights, k), fontsize=8)
            if j == 0:
                axis.set_ylabel(_label(store.views, v), fontsize=8)
    figure.suptitle("view (rows: θ, φ) × light (columns: θ, φ); sRGB, one exposure", fontsize=10)
    return scale


def _covered_views(store: BTFStore) -> np.ndarray:
    """Views that are there for all lights and tiles, spread over the set."""
    there = np.flatnonzero(store.coverage.all(axis=(1, 2, 3)))
    if len(there) > AVERAGED:
        there = there[np.round(np.linspace(0, len(there) - 1, AVERAGED)).astype(int)]
    return there


def _maps(figure: SubFigure, store: BTFStore, scale: float) -> None:
    """Albedo seen along the normal, relative standard error, and samples where they differ."""
    samples = store.maps("samples")
    axes = figure.subplots(3 if samples is not None else 2, 1)
    there = _covered_views(store)
    if len(there):
        top = there[np.argmin(store.views.theta[there])]
        weights = store.lights.quadrature_weights
        values, _ = store.read(views=top, variance=False)
        albedo = np.einsum("l,lrcx->rcx", weights, values[0].astype(np.float64))
        axes[0].imshow(encode_srgb(np.clip(albedo, 0, 1)), origin="lower", interpolation="nearest")
        theta = np.degrees(store.views.theta[top])
        mean = ", ".join(f"{value:.3f}" for value in albedo.mean((0, 1)))
        axes[0].set_title(f"albedo for the view at θ = {theta:.0f}°; mean {mean}", fontsize=9)
    if len(there) and store.has_variance:
        total, variance = np.zeros(store.texels), np.zeros(store.texels)
        for view in there:
            values, spread = store.read(views=view)
            total += values[0].mean((0, -1), dtype=np.float64)
            assert spread is not None  # the store has a variance
            variance += spread[0].mean((0, -1), dtype=np.float64)
        error = np.sqrt(variance * len(there)) / np.maximum(total, 0.1 * total.mean() + 1e-12)
        picture = axes[1].imshow(100 * error, origin="lower", interpolation="nearest", cmap="magma", vmin=0)
        figure.colorbar(picture, ax=axes[1], shrink=0.8)
        whole = np.sqrt(variance.mean() / len(there)) / max(total.mean() / len(there), 1e-12)
        axes[1].set_title(
            f"relative standard error, % (of {len(there)} views); whole {whole:.2%}", fontsize=9
        )
    if samples is not None and len(there):
        counts = np.mean([samples[view] for view in there], axis=0)
        picture = axes[2].imshow(counts, origin="lower", interpolation="nearest", cmap="viridis")
        figure.colorbar(picture, ax=axes[2], shrink=0.8)
        axes[2].set_title(f"samples per texel and view, mean {counts.mean():.1f}", fontsize=9)
    for axis in axes:
        axis.set(xticks=[], yticks=[])
        if not axis.images:
            axis.text(0.5, 0.5, "no view is complete yet", ha="center", transform=axis.transAxes)


def _lobes(figure: SubFigure, store: BTFStore, texel: tuple[int, int]) -> None:
    """Apparent BRDF of one texel: what it sends to all views for a few lights, and takes from all lights."""
    axes = figure.subplots(2, LOBES, squeeze=False)
    lights, views = _spread(store.lights, LOBES), _spread(store.views, LOBES)
    tables = [
        [
            (
                store.views,
                _column(store, texel, light=k),
                f"light {_label(store.lights, k)}",
                store.lights.vectors[k],
            )
            for k in lights
        ],
        [
            (
                store.lights,
                _column(store, texel, view=v),
                f"view {_label(store.views, v)}",
                store.views.vectors[v],
            )
            for v in views
        ],
    ]
    every = [row[1].mean(-1) for table in tables for row in table]
    largest = max((np.nanmax(values) for values in every if np.isfinite(values).any()), default=1.0)
    picture = None
    for axis_row, table, over in zip(axes, tables, ("views", "lights"), strict=True):
        for axis in axis_row[len(table) :]:
            axis.axis("off")
        for axis, (directions, values, title, other) in zip(axis_row, table, strict=False):
            picture = _hemisphere(axis, directions, values.mean(-1), largest, other)
            axis.set_title(f"over all {over}, {title}", fontsize=8)
    if picture is not None:
        bar = figure.colorbar(picture, ax=axes, shrink=0.8)
        bar.set_label("log₁₀ of B in 1/sr, mean of RGB", fontsize=8)
    figure.suptitle(
        f"apparent BRDF of texel {texel[0]}, {texel[1]}: hemispheres seen from above, rings at θ = 30°, 60°, 90°; "
        "+ marks the other direction",
        fontsize=10,
    )


def _column(
    store: BTFStore, texel: tuple[int, int], *, view: int | None = None, light: int | None = None
) -> np.ndarray:
    """One texel for one light and all views, or one view and all lights: (n, 3), NaN where not there."""
    row, column = texel
    tile = row // store.tile[0], column // store.tile[1]
    covered = store.coverage[:, :, tile[0], tile[1]]
    there = np.flatnonzero(covered[:, light] if view is None else covered[view])
    result = np.full((len(store.views) if view is None else len(store.lights), 3), np.nan)
    if len(there):
        part = {"views": there, "lights": light} if view is None else {"views": view, "lights": there}
        values, _ = store.read(**part, rows=row, columns=column, variance=False)
        result[there] = values.reshape(-1, 3)
    return result


def hemisphere(directions: DirectionSet, values: np.ndarray) -> np.ndarray:
    """Values interpolated over a disk whose radius is θ, azimuth 0 to the right.

    Parameters
    ----------
    directions : DirectionSet
    values : ndarray (n,)
        NaN where not known.

    Returns
    -------
    ndarray (DISK, DISK)
        Row 0 at the bottom; NaN outside the disk and where a value is not known.
    """
    x, y = np.meshgrid(*[(np.arange(DISK) + 0.5) / DISK * 2 - 1] * 2)
    radius, phi = np.hypot(x, y), np.arctan2(y, x)
    theta = np.minimum(radius, 1) * np.pi / 2
    w = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    index, weights = directions.stencil(w.reshape(-1, 3))
    there = np.isfinite(values)
    image = (np.where(there, values, 0)[index] * weights).sum(-1)
    known = (there[index] | (weights == 0)).all(-1)
    return np.where((radius <= 1).ravel() & known, image, np.nan).reshape(DISK, DISK)


def _hemisphere(
    axis: Axes, directions: DirectionSet, values: np.ndarray, largest: float, other: np.ndarray
) -> AxesImage:
    """A hemisphere on a logarithmic scale, with the other direction marked."""
    shown = np.log10(np.maximum(hemisphere(directions, values), 1e-30))
    high = np.log10(max(largest, 1e-30))
    picture = axis.imshow(
        shown, origin="lower", extent=(-1, 1, -1, 1), cmap="viridis", vmin=high - DECADES, vmax=high
    )
    turn = np.linspace(0, 2 * np.pi, 181)
    for ring in (1 / 3, 2 / 3, 1):
        axis.plot(ring * np.cos(turn), ring * np.sin(turn), color="white" if ring < 1 else "black", lw=0.5)
    radius = np.arccos(np.clip(other[2], -1, 1)) / (np.pi / 2)
    across = np.hypot(other[0], other[1])
    place = radius * other[:2] / across if across > 0 else np.zeros(2)
    axis.plot(*place, "+", color="red", ms=8)
    axis.set(xticks=[], yticks=[], xlim=(-1.02, 1.02), ylim=(-1.02, 1.02), aspect="equal")
    axis.axis("off")
    return picture
