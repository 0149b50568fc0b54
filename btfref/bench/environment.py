"""Image-based light: prefiltered real-time pictures against the path tracer under the same environments.

The error is that of the approximation: Monte Carlo noise is taken out, and its interval is reported.
"""

from __future__ import annotations

import tempfile
import time
from importlib.resources import files
from pathlib import Path

from btfref.bench.timing import machine
from btfref.errors import InputError

#: Pictures are small: the noise of their references averages out over the sphere.
SIZE, GRID = (64, 64), 4

#: Samples a pixel of the references; doubled until their noise is a quarter of the gate's tolerance.
SPP = 512


def run(*, quick=False, progress=None, btf=None, only=None):
    """Noise-corrected relative RMSE of each method under each environment.

    Parameters
    ----------
    quick : bool
        Without the sun.
    progress : callable, optional
    btf : SampledBTF, optional
        Default: a checker of 32² texels.
    only : sequence of str, optional
        Some of the methods with a prefiltered path.

    Returns
    -------
    dict
        ``summary``: by method and environment ``rmse``, ``low``, ``high`` relative to the mean radiance, ``spp``,
        ``noise``, ``frame_ms``; ``raw``: seconds of the references; ``machine``.
    """
    from btfref.bench.data import checker
    from btfref.registry import methods
    from btfref.render import environment
    from btfref.representations import save

    keys = [k for k, row in methods().items() if row.image_light and (only is None or k in only)]
    if not keys:
        raise InputError("no such method with a prefiltered path", field="only", got=", ".join(only or ()))
    btf = btf or checker(texels=32, spp=8, progress=progress)
    sky = environment.sunsky(shape=(128, 256))
    # The same sky with its sun cut off: a smooth environment.
    skies = {"constant": None, "sky": sky.radiance.clip(max=1.0), "sun and sky": sky.radiance}
    if quick:
        del skies["sun and sky"]
    summary, raw = {}, {}
    with tempfile.TemporaryDirectory() as folder:
        for key in keys:
            path = Path(folder) / f"bench.{key}.exr"
            save(methods()[key].fit(btf), path)
            for name, radiance in skies.items():
                start = time.perf_counter()
                summary.setdefault(key, {})[name] = compared(path, radiance, Path(folder) / "sky.exr")
                raw.setdefault(key, {})[name] = time.perf_counter() - start
                if progress:
                    progress(len(raw[key]), len(skies), key)
    parameters = {"size": list(SIZE), "grid": GRID, "shape": list(btf.values.shape)}
    return {
        "suite": "environment",
        "parameters": parameters,
        "raw": raw,
        "summary": summary,
        "machine": machine(),
    }


def compared(path, radiance, picture):
    """One method on the shipped sphere under one environment; ``radiance`` None is constant."""
    import numpy as np

    from btfref.compare import save_image, significance
    from btfref.compare.tolerances import tolerance
    from btfref.render.classes import pixel_classes
    from btfref.render.realtime import realtime
    from btfref.render.reference import render

    scene = files("btfref.scenes").joinpath("sphere.xml")
    parameters = {"btf": str(path), "lights": "constant"}
    if radiance is not None:
        save_image(picture, radiance)
        parameters |= {"lights": "envmap", "environment": str(picture)}
    image = realtime(scene, parameters=parameters, grid=GRID, size=SIZE)
    classes = pixel_classes(scene, parameters=parameters, grid=GRID, size=SIZE)
    inside = classes == 1
    limit = tolerance("reference.standard_error.max_fraction") * tolerance("image.environment.relative_rmse")
    spp, noise = SPP, np.inf
    while noise > limit and spp < 1 << 15:
        spp *= 2
        reference = render(scene, parameters=parameters, spp=spp, seed=1, size=SIZE, with_variance=True)
        noise = float(np.sqrt(reference.variance[inside].mean()) / reference.image[inside].mean())
    difference = image.image[inside].astype(float) - reference.image[inside]
    mse = significance.mse_interval(difference, reference.variance[inside].astype(float), confidence=0.99)
    error = significance.rmse_interval(mse)
    scale = float(reference.image[inside].mean())
    return {
        "rmse": error.estimate / scale,
        "low": error.low / scale,
        "high": error.high / scale,
        "spp": spp,
        "noise": noise,
        "frame_ms": image.meta["frame_ms"],
    }


def table(result):
    """Rows for people: method, then the error and its 99 % interval by environment."""
    first = next(iter(result["summary"].values()))
    rows = []
    for key, cells in result["summary"].items():
        text = [
            f"{100 * c['rmse']:.2f} % ({100 * c['low']:.2f} … {100 * c['high']:.2f})" for c in cells.values()
        ]
        rows.append((key, *text))
    return ("relative RMSE", *first), rows
