"""The real-time picture in float64: the same approximation, at the same samples, by NumPy.

What GLSL shows differs from it by float32 rounding alone; what the path tracer shows differs from it by the
approximation's own error. Primary hits are Mitsuba's; everything behind them is the definition.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from btfref import representations
from btfref.errors import InputError
from btfref.numerics.draws import of_pixels
from btfref.numerics.footprint import ANISOTROPY, probe_weight
from btfref.rendering import RenderResult
from btfref.rendering.environment_light.lighting import lighting_of
from btfref.rendering.frames import interpolated, rounds_of
from btfref.representations.protocol import DrawsViews, HasLevels
from btfref.scene.description import read_scene
from btfref.scene.hits import Hits, surfaces
from btfref.scene.loading import loaded
from btfref.scene.reading.instances import drawn_shapes
from btfref.types import Facts, SceneLike

if TYPE_CHECKING:
    from btfref.rendering.environment_light.prepared import Prepared
    from btfref.representations.protocol import Representation
    from btfref.scene.description import SceneDescription
    from btfref.scene.shapes import MeshDescription


def approximate(
    scene: SceneLike,
    *,
    parameters: Mapping[str, object] | None = None,
    path: str = "auto",
    grid: int = 4,
    size: tuple[int, int] | None = None,
    load_file: Callable[[str], Representation] | None = None,
    pixels: np.ndarray | None = None,
    interpolation: str | None = None,
    frames: int | None = None,
    seed: int = 0,
    **options: Any,
) -> RenderResult:
    """What :func:`btfref.rendering.gl.realtime.realtime` approximates, evaluated in float64.

    Parameters
    ----------
    scene : path-like or dict
    parameters : dict of str to str, optional
        Values for ``$name`` in the file.
    path : str
        Way in which an environment lights, as ``environment`` of ``realtime``.
    grid : int
        n of the n × n sub-pixel samples, at (i + ½)/n.
    size : (int, int), optional
        Width and height in place of the scene's.
    load_file : callable, optional
        ``path -> Representation``; the default reads the files.
    pixels : ndarray of bool, shape (H, W), optional
        Those that are evaluated; the others stay black.
    interpolation, frames, seed
        As for ``realtime``: the same views are drawn, but under maps of an environment, where all are blended.
    **options
        ``lights``, ``order``, ``window`` and ``transfer`` as for ``realtime``.

    Returns
    -------
    RenderResult
        Without cast shadows, on black; with the variance of the mean where ``frames`` draw a place more than once.
        ``meta`` as of ``realtime``: ``environment_path`` and its facts.

    Raises
    ------
    InputError
        As ``realtime``.
    MissingDependencyError
        Without a usable LLVM.
    """
    if grid < 1:
        raise InputError("the sub-pixel grid needs a sample", field="grid", got=grid, expected="≥ 1")
    description = interpolated(read_scene(scene, parameters, size=size), interpolation)
    rounds = rounds_of(description, grid, frames)
    if not description.lights and description.environment is None:
        raise InputError("the scene has no light", file=description.source, field="emitter")
    lighting = lighting_of(description, path, **options)
    start, camera = time.perf_counter(), description.camera
    reps, prepared, total = {}, {}, np.zeros((camera.height * camera.width, 3))
    noise = np.zeros_like(total)
    wanted = np.full(len(total), True) if pixels is None else np.ravel(pixels)
    # A plain material is evaluated as a representation is.
    rep: Any
    # Asked for hits alone, whatever their materials do.
    with loaded(scene, parameters, size=size, plain=True) as made:
        shapes = drawn_shapes(made, [mesh.where for mesh in description.meshes])
        for place, surface in enumerate(surfaces(made, grid)):
            for number, (mesh, drawn) in enumerate(zip(description.meshes, shapes, strict=True)):
                seen = surface.sees(drawn) & wanted
                # Mitsuba's area light shines on the side of the shading normal.
                total[seen & (surface["wi"][:, 2] > 0)] += mesh.emission
                hits = Hits.of(surface, mesh.shown, np.flatnonzero(seen))
                if not len(hits.at):
                    continue
                if mesh.material is None and mesh.plain is not None:
                    rep = mesh.plain.representation
                    light = None if lighting is None else lighting.of_plain.prepared(rep)
                    total[hits.at] += radiance(rep, hits, mesh, description, grid, light)
                    continue
                name = mesh.btf.filename
                if name not in reps:
                    reps[name] = (load_file or representations.load)(name)
                rep = filtered(reps[name], mesh.btf.filter_type)
                light = None
                if lighting is not None:
                    key = (name, number) if lighting.per_mesh else name
                    if key not in prepared:
                        prepared[key] = lighting.prepared(rep, file=name, mesh=number)
                    light = prepared[key]
                settings = rep, hits, mesh, description, grid, light
                if mesh.btf.interpolation == "drawn" and isinstance(rep, DrawsViews):
                    numbers = [place + k * grid**2 for k in range(rounds)]
                    draws = [of_pixels(camera.height, camera.width, k, seed).ravel() for k in numbers]
                    values = np.stack([radiance(*settings, draw[hits.at]) for draw in draws])
                    value = values.mean(0)
                    if rounds > 1:
                        # Places draw apart from each other.
                        noise[hits.at] += mesh.btf.scale**2 * values.var(0, ddof=1) / rounds
                else:
                    value = radiance(*settings)
                total[hits.at] += mesh.btf.scale * value
    image = (total / grid**2).reshape(camera.height, camera.width, 3)
    facts = [{"environment_path": p.path, **p.facts} for p in prepared.values()]
    meta = {
        "renderer": "approximate",
        "grid": grid,
        "shadows": False,
        "environment": description.environment.name if description.environment else None,
        **description.facts,
        "seconds": time.perf_counter() - start,
    }
    if len(facts) == 1:
        meta |= facts[0]
    elif facts:
        meta["environment_path"] = dict(zip(map(str, prepared), facts, strict=True))
    variance = (noise / grid**4).reshape(image.shape).astype(np.float32) if rounds > 1 else None
    return RenderResult(image.astype(np.float32), variance, meta)


def filtered(representation: Representation, filter_type: str | None) -> Representation:
    """The representation with the material's texel filter."""
    if filter_type in (None, representation.meta["filter_type"]):
        return representation
    meta = {**representation.meta, "filter_type": filter_type}
    return type(representation).from_arrays(representation.arrays(), meta)


def radiance(
    representation: Representation,
    hits: Hits,
    mesh: MeshDescription,
    description: SceneDescription,
    grid: int,
    prepared: Prepared | None,
    draw: np.ndarray | None = None,
) -> np.ndarray:
    """Radiance towards the viewer without the material's factor, shape (N, 3); by a draw for each hit if there are."""
    levels, camera = isinstance(representation, HasLevels), description.camera
    texels = representation.meta["texels"]
    footprint = hits.footprint(camera.origin, camera.pixel_angle / grid, texels) if levels else ()

    def evaluate(uv: np.ndarray, w_light: np.ndarray, w_view: np.ndarray, at: np.ndarray) -> np.ndarray:
        drawn: Facts = {} if draw is None else {"draw": draw[at]}
        if not levels:
            return representation.evaluate(uv, w_light, w_view, **drawn)
        lod, step, ratio = (a[at] for a in footprint)
        value = np.zeros((len(uv), 3))
        reach = int((ANISOTROPY - 1) / 2)
        for j in range(-reach, reach + 1):
            share = probe_weight(j, ratio)
            some = np.flatnonzero(share > 0)
            if len(some):
                further = {name: value[some] for name, value in {"lod": lod, **drawn}.items()}
                found = representation.evaluate(
                    uv[some] + j * step[some], w_light[some], w_view[some], **further
                )
                value[some] += share[some, None] * found
        return value

    everywhere, total = np.arange(len(hits.at)), np.zeros((len(hits.at), 3))
    for light in description.lights:
        towards, power = light.incident(hits.position)
        w_light = np.einsum("ni,nij->nj", towards, hits.to_world)
        total += power * evaluate(hits.uv, w_light, hits.w_view, everywhere)
    if prepared is not None:
        total += prepared.radiance(
            hits.uv, hits.w_view, hits.to_world, evaluate=evaluate, place=lambda: hits.place(mesh)
        )
    return total
