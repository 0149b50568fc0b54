"""Pictures by the float64 definition: the same camera rays and lights as the reference, evaluated in NumPy.

Between this picture and the reference's lies the port alone (float32, the order of sums); between this one of a
compressed BTF and this one of the table that it was made from lies the fit alone.
"""

from __future__ import annotations

import time

import numpy as np

from btfref.numerics.footprint import ANISOTROPY, probe_weight
from btfref.numerics.threads import one_blas_thread
from btfref.render import hits
from btfref.render.reference import grid_offsets, loaded, tell_camera
from btfref.render.result import RenderResult


def render_definition(scene, *, parameters=None, representations=None, grid=4, size=None, progress=None):
    """Render delta lights without shadows by ``evaluate()``.

    Parameters
    ----------
    scene : path-like or dict
        All shapes show one ``btf`` material of scale 1.
    parameters : dict of str to str, optional
        Values for ``$name`` in the file.
    representations : dict of str to Representation, optional
        What to show in place of the material's file, each at the same rays; by default the file alone, as "".
        Levels of detail are those of the file's plugin, and are only asked for when the file itself is shown.
    grid : int
        n of the n × n sub-pixel samples, at (i + ½)/n.
    size : (int, int), optional
        Width and height in place of the scene's.
    progress : callable, optional
        Called as ``progress(done, total, label)``.

    Returns
    -------
    RenderResult, or dict of str to RenderResult when `representations` is given
        float32 of float64 sums; without variance.

    Raises
    ------
    InputError
        For scenes that cannot be read, with several materials, or lit by anything but delta lights.
    """
    from btfref.representations import load

    description, material = hits.single_material(scene, parameters, size=size)
    shown = representations or {"": load(material.filename)}
    height, width = description.camera.height, description.camera.width
    sums = {name: np.zeros((height * width, 3)) for name in shown}
    seconds = dict.fromkeys(shown, 0.0)
    report = progress or (lambda *_: None)
    with loaded(scene, parameters, size=size) as made:
        tell_camera(made, 1 / grid)
        detail = None if representations else _detail(made, material)
        offsets = grid_offsets(grid)
        for done, offset in enumerate(offsets):
            report(done, len(offsets), "float64 definition")
            found = hits.intersect(made, material, offset)
            levels = {} if detail is None else _as_numbers(detail(found[0]), np.array(found[0].is_valid()))
            arrays = hits.as_arrays(*found)
            for name, representation in shown.items():
                start = time.perf_counter()
                with one_blas_thread():
                    sums[name][arrays.pixel] += _radiance(_filtered(representation, material), arrays, levels)
                seconds[name] += time.perf_counter() - start
    report(len(offsets), len(offsets), "float64 definition")
    results = {
        name: RenderResult(
            (total / len(offsets)).astype(np.float32).reshape(height, width, 3),
            None,
            {"renderer": "definition", "grid": grid, "shadows": False, "seconds": seconds[name]},
        )
        for name, total in sums.items()
    }
    return results if representations else results[""]


def _filtered(representation, material):
    """The representation with the scene's texel filter."""
    import dataclasses

    if material.filter_type in (None, representation.meta["filter_type"]):
        return representation
    return dataclasses.replace(
        representation, meta=representation.meta | {"filter_type": material.filter_type}
    )


def _radiance(representation, found, levels):
    """Σ over lights of power × B, float64 (N, 3); lookups along the footprint where there are levels."""
    total = np.zeros((len(found.pixel), 3))
    lod = levels.get("lod", 0.0)
    for w_light, power in zip(found.w_light, found.power, strict=True):
        if "ratio" not in levels:
            total += power * representation.evaluate(found.uv, w_light, found.w_view, lod=lod)
            continue
        reach = int(np.ceil(0.5 * ANISOTROPY - 0.5))
        for j in range(-reach, reach + 1):
            weight = probe_weight(j, levels["ratio"])
            used = weight > 0
            if used.any():
                uv = found.uv[used] + j * levels["step"][used]
                value = representation.evaluate(uv, w_light[used], found.w_view[used], lod=lod[used])
                total[used] += weight[used, None] * power[used] * value
    return total


def _detail(scene, material):
    """What chooses the level of detail, ``si -> dict`` of the plugin, or None for methods without levels."""
    import mitsuba as mi

    values = mi.traverse(scene)
    keys = [key for key in values.keys() if key.split(".")[-1] == "pixel_angle"]
    (a, b, c), (d, e, f) = material.to_uv.tolist()
    to_uv = mi.ScalarTransform4f([[a, b, 0, c], [d, e, 0, f], [0, 0, 1, 0], [0, 0, 0, 1]])
    settings = {"lod": material.lod, "lod_bias": material.lod_bias, "lod_unit": material.lod_unit}
    if keys:
        settings["pixel_angle"] = float(values[keys[0]][0])
        camera = values[keys[0].removesuffix("pixel_angle") + "camera"]
        settings["camera"] = mi.ScalarPoint3f(*(float(x[0]) for x in camera))
    return mi.load_dict({"type": "btf", "filename": material.filename, "to_uv": to_uv, **settings}).detail


def _as_numbers(levels, valid):
    """λ, step and ratio of the rays that hit, as float64."""
    numbers = {}
    for name, value in levels.items():
        array = np.array(value, float)
        array = np.broadcast_to(array.T if array.ndim == 2 else array, (len(valid), *array.shape[:-1]))
        numbers[name] = array[valid]
    return numbers
