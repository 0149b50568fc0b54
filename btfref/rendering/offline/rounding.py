"""How far the rounding of texture coordinates moves a picture: what two float32 renderers may differ by."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from btfref import representations
from btfref.rendering.environment_light.lighting import lighting_of
from btfref.rendering.offline.approximate import filtered, radiance
from btfref.scene.description import read_scene
from btfref.scene.hits import Hits, surfaces
from btfref.scene.loading import loaded
from btfref.scene.reading.instances import drawn_shapes
from btfref.types import SceneLike

#: Distance in texture coordinates within which two renderers may look up one sample: interpolated, they round by
#: about 1e-6 of their range, as "image.noise_free" has it.
ROUNDING = 1e-6

#: Cosine of the view below which the distance grows no further.
GRAZING = 0.1

#: Steps by which each sample is moved, in `ROUNDING`.
STEPS = np.array([(1, 0), (-1, 0), (0, 1), (0, -1)])


def uv_rounding(
    scene: SceneLike,
    pixels: np.ndarray,
    *,
    parameters: Mapping[str, object] | None = None,
    grid: int = 4,
    size: tuple[int, int] | None = None,
    path: str = "auto",
    **options: Any,
) -> np.ndarray:
    """The most that some pixels change by when texture coordinates round, by the definition in float64.

    Every sample of a pixel is moved for itself, along u and v in both directions; the largest of its four changes
    enters the mean, so that the sum is what all samples can do together. A ray that is off by a distance meets a
    surface off by that over the cosine of the view; steps are as long.

    Parameters
    ----------
    scene : path-like or dict
        Without cast shadows.
    pixels : ndarray of bool, shape (H, W)
        Those that are looked at.
    parameters : dict of str to str, optional
        Values for ``$name`` in the file.
    grid : int
        n of the n × n sub-pixel samples.
    size : (int, int), optional
        Width and height in place of the scene's.
    path, **options
        Of an environment, as for :func:`btfref.rendering.offline.approximate.approximate`.

    Returns
    -------
    ndarray of float64, shape (H, W, 3)
        Radiance; 0 elsewhere, and where a plain material is seen.
    """
    description = read_scene(scene, parameters, size=size)
    lighting = lighting_of(description, path, **options)
    total, loads, lights = np.zeros((pixels.size, 3)), {}, {}
    with loaded(scene, parameters, size=size, plain=True) as made:
        shapes = drawn_shapes(made, [mesh.where for mesh in description.meshes])
        for surface in surfaces(made, grid):
            for number, (mesh, drawn) in enumerate(zip(description.meshes, shapes, strict=True)):
                at = np.flatnonzero(surface.sees(drawn) & pixels.ravel())
                if mesh.material is None or not len(at):
                    continue
                name = mesh.btf.filename
                if name not in loads:
                    loads[name] = representations.load(name)
                representation = filtered(loads[name], mesh.btf.filter_type)
                if lighting is not None and number not in lights:
                    lights[number] = lighting.prepared(representation, file=name, mesh=number)
                settings = mesh, description, grid, lights.get(number)
                hits = Hits.of(surface, mesh.shown, at)
                there = radiance(representation, hits, *settings)
                far = ROUNDING / np.maximum(np.abs(hits.w_view[:, 2:]), GRAZING)
                beside = [radiance(representation, hits.moved(far * step), *settings) for step in STEPS]
                total[at] += mesh.btf.scale * np.abs(np.array(beside) - there).max(0)
    return (total / grid**2).reshape(*pixels.shape, 3)


def rounding_of(
    scene: SceneLike,
    *,
    parameters: Mapping[str, object] | None = None,
    grid: int = 4,
    size: tuple[int, int] | None = None,
    **options: Any,
) -> Callable[[np.ndarray], np.ndarray]:
    """`uv_rounding` of a scene for whatever pixels :func:`btfref.compare` asks for."""
    return lambda pixels: uv_rounding(scene, pixels, parameters=parameters, grid=grid, size=size, **options)
