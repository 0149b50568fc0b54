"""Light from environments: what each approximation costs in accuracy, memory and time.

Errors are of pictures: prefiltered maps and spherical harmonics against the path tracer, whose noise is taken out;
clusters, components and codes of the transfer against spherical harmonics per pixel, which they compress.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from btfref.bench.options import Options
from btfref.bench.timing import machine
from btfref.conventions import PixelClass
from btfref.scene.shipped import scene_file

if TYPE_CHECKING:
    from btfref.rendering import RenderResult
    from btfref.types import Facts, PathLike


#: Pictures are small: the noise of their references averages out over the sphere.
SIZE, GRID = (32, 32), 2

ENVIRONMENTS = ("harmonics", "studio", "sky", "bright-texel")

ORDERS = range(2, 11)

CLUSTERS, COMPONENTS, MAP_SIZES = (4, 8, 16, 32, 64), (1, 2, 4, 8, 16), (8, 32)

#: Rounds of the timings; the first one, which allocates, is apart.
ROUNDS = 9

#: Frames of this size are timed.
FRAME = (800, 800)


def run(options: Options) -> Facts:
    """Error against order, clusters, components and bits; time of the products and of frames.

    Parameters
    ----------
    options : Options
        ``quick``: every other order, two environments, smaller frames. ``btf``: default: a checker of 32² texels.
        ``only``: some of "prefiltered", "order", "transfer", "time".

    Returns
    -------
    dict
        ``summary``: by table, rows of numbers; ``raw``: times; ``machine``.

    Raises
    ------
    InputError
        For a name in ``only`` that there is not.
    """
    from btfref.bench.data import checker
    from btfref.registry import methods
    from btfref.representations import save

    parts = {"prefiltered": _prefiltered, "order": _order, "transfer": _transfer, "time": _time}
    options.demand(parts)
    btf = options.btf or checker(texels=32, spp=8, progress=options.progress)
    summary, raw = {}, {}
    with tempfile.TemporaryDirectory() as folder:

        def fitted(key: str) -> Path:
            path = Path(folder) / f"bench.{key}.exr"
            if not path.exists():
                save(methods()[key].fit(btf), path)
            return path

        for done, (name, part) in enumerate(parts.items()):
            options.tell(done, len(parts), name)
            if options.wants(name):
                summary[name], raw[name] = part(fitted, options.quick)
    parameters = {"size": list(SIZE), "grid": GRID, "shape": list(btf.values.shape)}
    return {"suite": "env", "parameters": parameters, "raw": raw, "summary": summary, "machine": machine()}


def _scene(path: PathLike, scene: str, environment: str) -> tuple[Path, Facts]:
    parameters = {"btf": str(path), "lights": "envmap", "environment": environment}
    return scene_file(scene), {"parameters": parameters, "size": SIZE, "grid": GRID}


def _inside(file: PathLike, settings: Facts) -> np.ndarray:
    from btfref.scene.pixel_classes import pixel_classes

    return pixel_classes(file, **settings) == PixelClass.INTERIOR


def _error(image: RenderResult, reference: RenderResult, inside: np.ndarray) -> dict[str, float]:
    """Noise-corrected relative RMSE with its 99 % interval."""
    from btfref.comparison import significance

    difference = image.image[inside].astype(float) - reference.image[inside]
    assert reference.variance is not None
    mse = significance.mse_interval(difference, reference.variance[inside].astype(float), confidence=0.99)
    found, scale = significance.rmse_interval(mse), float(reference.image[inside].mean())
    return {"rmse": found.estimate / scale, "low": found.low / scale, "high": found.high / scale}


def _prefiltered(fitted: Callable[[str], Path], quick: bool) -> tuple[list[Facts], list[float]]:
    """Every method with prefiltered maps, on a sphere."""
    from btfref.registry import methods
    from btfref.rendering.gl.realtime import realtime
    from btfref.rendering.offline.converged import converged

    rows, raw = [], []
    for key in [k for k, row in methods().items() if row.image_light]:
        for environment in ENVIRONMENTS[: 2 if quick else None]:
            start = time.perf_counter()
            file, settings = _scene(fitted(key), "sphere", environment)
            inside = _inside(file, settings)
            reference = converged(file, inside, gate="image.environment", shadows=False, **settings)
            image = realtime(file, environment="prefiltered", **settings)
            found = _error(image, reference, inside)
            facts = {"spp": reference.meta["spp"], "noise": reference.meta["noise"]}
            rows.append({"method": key, "environment": environment, **found, **facts})
            raw.append(time.perf_counter() - start)
    return rows, raw


def _order(fitted: Callable[[str], Path], quick: bool) -> tuple[list[Facts], list[float]]:
    """Spherical harmonics of each order on a sphere, with and without a window, and lights for comparison."""
    from btfref.rendering.gl.realtime import realtime
    from btfref.rendering.offline.converged import converged

    rows, raw = [], []
    for environment in ENVIRONMENTS[: 2 if quick else None]:
        file, settings = _scene(fitted("lpca"), "sphere", environment)
        inside = _inside(file, settings)
        start = time.perf_counter()
        reference = converged(file, inside, gate="image.environment_lights", shadows=False, **settings)
        raw.append(time.perf_counter() - start)
        lit = realtime(file, environment="lights", **settings)
        way = f"{lit.meta['environment_lights']} lights"
        found = _error(lit, reference, inside) | {"estimated": lit.meta["estimated_error"]}
        rows.append({"environment": environment, "way": way, **found})
        for order in list(ORDERS)[:: 2 if quick else 1]:
            for window in ("none", "hanning"):
                image = realtime(file, environment="sh", order=order, window=window, **settings)
                rows.append({"environment": environment, "way": f"order {order}", "window": window})
                rows[-1] |= _error(image, reference, inside)
                rows[-1] |= {"ringing": image.meta["ringing"], "estimated": image.meta["estimated_error"]}
    return rows, raw


def _transfer(fitted: Callable[[str], Path], quick: bool) -> tuple[list[Facts], list[float]]:
    """Compression of the transfer in a bowl: relative RMSE to spherical harmonics per pixel."""
    from btfref.rendering.environment_light.transfer import TransferSettings
    from btfref.rendering.gl.realtime import realtime

    file, settings = _scene(fitted("lpca"), "bowl", "studio")
    inside, rows, raw = _inside(file, settings), [], []
    exact = realtime(file, environment="sh", **settings).image[inside]
    settings_of: list[Facts] = [{"clusters": k} for k in CLUSTERS] + [{"components": c} for c in COMPONENTS]
    settings_of += [{"map_size": n} for n in MAP_SIZES] + [{"bits": 8}, {"bits": 8, "components": 4}]
    for given in settings_of[:: 2 if quick else 1]:
        start = time.perf_counter()
        image = realtime(file, environment="transfer", transfer=TransferSettings(**given), **settings)
        raw.append(time.perf_counter() - start)
        error = float(np.sqrt(np.mean((image.image[inside] - exact) ** 2)) / exact.mean())
        facts = ("matrix_clusters", "matrix_components", "map_size", "bits", "matrix_error", "table_bytes")
        rows.append({**{k: image.meta[k] for k in facts}, "rmse": error})
    return rows, raw


def _time(fitted: Callable[[str], Path], quick: bool) -> tuple[list[Facts], dict[str, list[float]]]:
    """Milliseconds of the products at the paper's setting, and of frames."""
    from btfref.rendering.environment_light import transfer_light
    from btfref.rendering.environment_light.lighting import lighting_of
    from btfref.rendering.environment_light.transfer import TransferSettings
    from btfref.rendering.gl.renderer import Renderer
    from btfref.scene.description import read_scene

    raw: dict[str, list[float]] = {}
    file, settings = _scene(fitted("lpca"), "bowl", "studio")
    size = (200, 200) if quick else FRAME
    scene = read_scene(file, settings["parameters"], size=size)
    lighting = lighting_of(scene, "transfer", transfer=TransferSettings())
    assert lighting is not None  # the scene has an environment
    with Renderer(scene, lighting=lighting) as renderer:
        light = renderer.transfers[0]
        full = light.table
        tasks = {
            "products, 32 × 8 × 16 × 4": lambda: light.relight(lighting.coefficients),
            "products while moving, 4 and 1": lambda: light.relight(lighting.coefficients, moving=True),
            "8-bit codes of them": lambda: transfer_light.encoded(full),
        }
        for name, task in tasks.items():
            task()
            raw[name] = []
            for _ in range(ROUNDS):
                start = time.perf_counter()
                task()
                raw[name].append(1e3 * (time.perf_counter() - start))
        light.relight(lighting.coefficients)
        name = f"frame {size[0]}×{size[1]}, transfer"
        raw[name] = [renderer.draw() for _ in range(3)]
    with Renderer(scene, lighting=lighting_of(scene, "sh")) as renderer:
        renderer.draw()
        raw[f"frame {size[0]}×{size[1]}, order 5 per pixel"] = [renderer.draw() for _ in range(3)]
    rows = [{"what": name, "median_ms": statistics.median(times)} for name, times in raw.items()]
    return rows, raw


def table(result: Facts) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Rows for people: table, setting, error."""
    rows: list[tuple[str, ...]] = []
    for entry in result["summary"].get("prefiltered", ()):
        rows.append((f"prefiltered, {entry['method']}", entry["environment"], _percent(entry)))
    for entry in result["summary"].get("order", ()):
        window = "" if entry.get("window", "none") == "none" else f", {entry['window']}"
        ringing = f", ringing {100 * entry['ringing']:.0f} %" if "ringing" in entry else ""
        rows.append((f"lpca, {entry['way']}{window}", entry["environment"], _percent(entry) + ringing))
    for entry in result["summary"].get("transfer", ()):
        setting = f"{entry['matrix_clusters']} × {entry['matrix_components']}, maps of {entry['map_size']}²"
        setting += f", {entry['bits']} bits"
        rows.append((f"transfer {setting}", f"{entry['table_bytes']} bytes", f"{100 * entry['rmse']:.3f} %"))
    for entry in result["summary"].get("time", ()):
        rows.append((entry["what"], "", f"{entry['median_ms']:.1f} ms"))
    return ("what", "where", "relative RMSE (99 %), or time"), rows


def _percent(entry: Facts) -> str:
    return f"{100 * entry['rmse']:.2f} % ({100 * entry['low']:.2f} … {100 * entry['high']:.2f})"


def plot(result: Facts, path: PathLike) -> None:
    """Error against the order of spherical harmonics: see :func:`btfref.report.order_plot.plot_orders`."""
    from btfref.report.order_plot import plot_orders

    plot_orders(result["summary"].get("order", ()), path)
