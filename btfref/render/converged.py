"""References that are good enough to decide: samples are added until their noise is a share of a gate's tolerance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from btfref.compare.tolerances import tolerance
from btfref.render.camera import tell_camera
from btfref.render.loading import loaded
from btfref.render.reference import BATCHES, traced

#: Samples a pixel of the first round, and most of all rounds.
FIRST, MOST = 256, 1 << 16

#: Samples grow by this power of the noise that is to be taken away: quasi-random ones do better than 2.
RATE = 1.4


def converged(
    scene,
    mask,
    *,
    gate,
    parameters=None,
    size=None,
    seed=1,
    shadows=True,
    grid=None,
    most=MOST,
    progress=None,
):
    """Path trace until the noise decides nothing.

    Parameters
    ----------
    scene : path-like or dict
    mask : ndarray of bool, shape (H, W)
        Pixels that the gate looks at.
    gate : str
        Key of ``tolerances.toml`` with ``relative_rmse``.
    parameters : dict of str to str, optional
    size : (int, int), optional
    seed : int
    shadows, grid
        As of :func:`btfref.render.reference.render`.
    most : int
        Samples a pixel at which the search ends, whatever the noise: the gate is then inconclusive at worst.
    progress : callable, optional
        ``progress(done, total, label)``.

    Returns
    -------
    RenderResult
        ``meta["noise"]``, the root mean variance over the mask relative to the mean radiance; ``meta["noise_limit"]``,
        a quarter of the gate's tolerance; ``meta["spp"]``. With ``grid`` four independent ``pictures``.
    """
    limit = tolerance("reference.standard_error.max_fraction") * tolerance(f"{gate}.relative_rmse")
    seeds = np.random.SeedSequence(seed).generate_state(32)
    mean = squared = total = 0.0
    done, count = 0, FIRST
    with loaded(scene, parameters, size=size) as made:
        # One footprint for all rounds.
        tell_camera(made, 1 / (grid or most**0.5))
        for number in seeds:
            found = traced(made, spp=count, seed=int(number), shadows=shadows, grid=grid, with_variance=True)
            done += found.meta["spp"]
            # Rounds are weighted by what their noise says: a long round is better than as many short ones.
            noise = float(found.variance[mask].mean()) if mask.any() else 0.0
            weight = 1 / max(noise, 1e-30)
            pictures = (found.pictures if grid else found.image[None]).astype(float)
            share = weight / (total + weight)
            mean = mean + share * (pictures - mean)
            squared = (1 - share) ** 2 * squared + share**2 * found.variance.astype(float)
            total += weight
            image = mean.mean(0)
            scale = float(np.abs(image[mask]).mean()) if mask.any() else 0.0
            noise = float(np.sqrt(squared[mask].mean())) / scale if scale > 0 else 0.0
            if progress:
                progress(min(done, most), most, f"reference, noise {noise:.2g} of {limit:.2g}")
            if noise <= limit or done >= most:
                break
            # As many as the noise asks for, a tenth more because it is itself an estimate.
            wanted = 1.1 * done * (noise / limit) ** (RATE if grid else 2)
            count = int(np.clip(wanted, BATCHES, max(BATCHES, min(most - done, 16 * done))))
    meta = {**found.meta, "spp": done, "noise": noise, "noise_limit": limit}
    return replace(
        found,
        image=image.astype(np.float32),
        variance=squared.astype(np.float32),
        meta=meta,
        pictures=mean.astype(np.float32) if grid else None,
    )
