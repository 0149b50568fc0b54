"""References that are good enough to decide: samples are added until their noise is a share of a gate's tolerance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from btfref.comparison import significance
from btfref.gates.tolerances import gate_table, tolerance
from btfref.rendering.offline.reference import BATCHES, traced
from btfref.scene.camera import tell_camera
from btfref.scene.loading import loaded
from btfref.types import Progress, SceneLike

if TYPE_CHECKING:
    from btfref.rendering import RenderResult


#: Samples a pixel of the first round, and most of all rounds.
FIRST, MOST = 256, 1 << 16

#: Samples grow by this power of the noise that is to be taken away: quasi-random ones do better than 2.
RATE = 1.4


def converged(
    scene: SceneLike,
    mask: np.ndarray,
    *,
    gate: str | Sequence[str],
    parameters: Mapping[str, object] | None = None,
    size: tuple[int, int] | None = None,
    seed: int = 1,
    shadows: bool = True,
    grid: int | None = None,
    most: int = MOST,
    progress: Progress | None = None,
) -> RenderResult:
    """Path trace until the noise decides nothing.

    Parameters
    ----------
    scene : path-like or dict
    mask : ndarray of bool, shape (H, W)
        Pixels that the gate looks at.
    gate : str or sequence of str
        Keys of ``tolerances.toml``; their ``relative_rmse`` and ``relative_tile_bias`` count.
    parameters : dict of str to str, optional
    size : (int, int), optional
    seed : int
    shadows, grid
        As of :func:`btfref.rendering.offline.reference.render`.
    most : int
        Samples a pixel at which the search ends, whatever the noise: the gate is then inconclusive at worst.
    progress : callable, optional
        ``progress(done, total, label)``.

    Returns
    -------
    RenderResult
        ``meta["noise"]``, the root mean variance over the mask relative to the mean radiance; ``meta["noise_ratio"]``,
        the largest noise over what a gate admits: a quarter of its ``relative_rmse``, and for tiles an interval whose
        half width is half of the ``relative_tile_bias``; ``meta["spp"]``. With ``grid`` four independent ``pictures``.
    """
    limits = [gate_table(key) for key in ([gate] if isinstance(gate, str) else gate)]
    seeds = np.random.SeedSequence(seed).generate_state(32)
    mean = squared = np.zeros((1, 1, 1, 3))
    total = 0.0
    done, count = 0, FIRST
    with loaded(scene, parameters, size=size) as made:
        # One footprint for all rounds.
        tell_camera(made, 1 / (grid or most**0.5))
        for number in seeds:
            found = traced(made, spp=count, seed=int(number), shadows=shadows, grid=grid, with_variance=True)
            done += found.meta["spp"]
            # Rounds are weighted by what their noise says: a long round is better than as many short ones.
            assert found.variance is not None
            noise = float(found.variance[mask].mean()) if mask.any() else 0.0
            weight = 1 / max(noise, 1e-30)
            pictures = (found.image[None] if found.pictures is None else found.pictures).astype(float)
            share = weight / (total + weight)
            mean = mean + share * (pictures - mean)
            squared = (1 - share) ** 2 * squared + share**2 * found.variance.astype(float)[None]
            total += weight
            image = mean.mean(0)
            scale = float(np.abs(image[mask]).mean()) if mask.any() else 0.0
            noise = float(np.sqrt(squared[0][mask].mean())) / scale if scale > 0 else 0.0
            ratio = _ratio(noise, squared[0] / scale**2, mask, limits) if scale > 0 else 0.0
            if progress:
                progress(min(done, most), most, f"reference, {ratio:.2g} of the noise that is allowed")
            if ratio <= 1 or done >= most:
                break
            # As many as the noise asks for, a tenth more because it is itself an estimate.
            wanted = 1.1 * done * ratio ** (RATE if grid else 2)
            count = int(np.clip(wanted, BATCHES, max(BATCHES, min(most - done, 16 * done))))
    meta = {**found.meta, "spp": done, "noise": noise, "noise_ratio": ratio}
    return replace(
        found,
        image=image.astype(np.float32),
        variance=squared[0].astype(np.float32),
        meta=meta,
        pictures=mean.astype(np.float32) if grid else None,
    )


def _ratio(
    noise: float, variance: np.ndarray, mask: np.ndarray, limits: Sequence[Mapping[str, Any]]
) -> float:
    """The largest noise over what one of the gates admits; ``variance`` is relative."""
    pixel, tile = (
        tolerance(f"reference.{name}.max_fraction") for name in ("standard_error", "tile_half_width")
    )
    found = [noise / (pixel * entry["relative_rmse"]) for entry in limits if "relative_rmse" in entry]
    for entry in limits:
        if "relative_tile_bias" in entry:
            half = significance.tile_half_widths(variance, mask, significance=entry["significance"])
            found.append(half.max(initial=0.0) / (tile * entry["relative_tile_bias"]))
    return float(max(found))
