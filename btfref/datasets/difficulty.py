"""How hard a material is, in numbers, and how noisy its grids are."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from pathlib import Path

    from btfref.sampling.store.store import BTFStore
    from btfref.types import Facts

#: Most views, lights and texels along a side that are looked at.
_MOST, _SIDE = 81, 16

#: Relative error that the rank is for.
ERROR = 0.01

#: Share of the pixels that are left out at either end of the heights, and the quantile that counts as the peak.
_ENDS, _PEAK = 0.01, 0.999


def noise(store: BTFStore) -> float:
    """Root mean square of a grid's standard errors over that of its values."""
    total, square = 0.0, 0.0
    for view in range(len(store.views)):
        values, variance = store.read(views=view)
        assert variance is not None
        total += float(variance.sum(dtype=np.float64))
        square += float((values.astype(np.float64) ** 2).sum())
    return float(np.sqrt(total / max(square, 1e-300)))


def rank(store: BTFStore) -> int:
    """Smallest rank of (pairs of directions) × (texels and channels) with a relative error of 1 %, noise apart.

    Parameters
    ----------
    store : BTFStore

    Returns
    -------
    int
        Of at most 81² pairs and 16² texels, evenly chosen. What noise adds to the rest of the spectrum is allowed: the
        error is 1 % and the noise together.
    """

    def some(n: int, most: int) -> np.ndarray:
        return np.unique(np.linspace(0, n - 1, min(n, most)).round().astype(int))

    rows, columns = (some(n, _SIDE) for n in store.texels)
    values, variance = store.read(
        views=some(len(store.views), _MOST), lights=some(len(store.lights), _MOST), rows=rows, columns=columns
    )
    assert variance is not None
    table = values.astype(np.float64).reshape(values.shape[0] * values.shape[1], -1)
    power = np.linalg.eigvalsh(table.T @ table)[::-1]
    allowed = ERROR**2 * power.sum() + float(variance.sum(dtype=np.float64))
    left = power.sum() - np.cumsum(power)
    return int(np.argmax(left <= allowed)) + 1


def difficulty(maps: dict[str, np.ndarray], finest: Path, test: dict[str, np.ndarray]) -> Facts:
    """Numbers of a material.

    Parameters
    ----------
    maps : dict of ndarray
        Of `btfref.datasets.truth`.
    finest : Path
        Grid of the most directions.
    test : dict of ndarray
        Rows without a footprint.

    Returns
    -------
    dict
        ``rank_1_percent``; ``parallax``: how far (tiles) the highest and the lowest hundredth of the surface move
        against each other from 0 to 60 degrees; ``dynamic_range``: the 99.9 % quantile of B over its mean;
        ``indirect``: share of what is seen from above under all lights; ``hidden``: mean share of the hemisphere that
        geometry hides.
    """
    from btfref.sampling.store.store import open_store

    low, high = np.quantile(maps["height"], (_ENDS, 1 - _ENDS))
    direct, indirect = (float(maps[name].mean(dtype=np.float64)) for name in ("direct", "indirect"))
    b = test["B"].mean(-1, dtype=np.float64)
    return {
        "rank_1_percent": rank(open_store(finest)),
        "parallax": float((high - low) * np.tan(np.radians(60))),
        "dynamic_range": float(np.quantile(b, _PEAK) / b.mean()),
        "indirect": indirect / (direct + indirect),
        "hidden": float(1 - maps["visibility"].mean(dtype=np.float64)),
    }
