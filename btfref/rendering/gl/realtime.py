"""The real-time image of a scene: a regular sub-pixel grid of frames, added in float64.

The grid is that of :mod:`btfref.rendering.offline.reference`: n × n regular samples a pixel, box filter. Each sample is
one frame of a :class:`btfref.rendering.gl.renderer.Renderer` with a shifted projection.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from btfref import representations
from btfref.errors import GRID, BtfrefError, InputError, refuse_above
from btfref.rendering import RenderResult
from btfref.rendering.environment_light.lighting import lighting_of
from btfref.rendering.frames import interpolated, refuse_unknown, rounds_of
from btfref.rendering.gl import device
from btfref.rendering.gl.renderer import Renderer
from btfref.scene.demand import MARGIN, kept_maps, number_kept
from btfref.scene.description import SceneDescription, read_scene
from btfref.scene.mirrored import mirrored_meshes
from btfref.scene.shadows.occluders import has_occluders
from btfref.types import Progress, SceneLike

if TYPE_CHECKING:
    from btfref.rendering.environment_light.transfer import TransferSettings
    from btfref.representations.protocol import Representation
    from btfref.scene.loading import Kept


def realtime(
    scene: SceneLike | SceneDescription,
    *,
    parameters: Mapping[str, object] | None = None,
    grid: int = 4,
    size: tuple[int, int] | None = None,
    keep: str = "all",
    environment: str = "auto",
    lights: int | None = None,
    order: int | None = None,
    window: str | None = None,
    transfer: TransferSettings | None = None,
    shadows: bool | None = None,
    count_fetches: bool = False,
    interpolation: str | None = None,
    frames: int | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> RenderResult:
    """Render a scene with OpenGL.

    Parameters
    ----------
    scene : path-like, dict or SceneDescription
    parameters : dict of str to str, optional
        Values for ``$name`` in the file.
    grid : int
        n of the n × n sub-pixel samples, at (i + ½)/n.
    size : (int, int), optional
        Width and height in place of the scene's.
    keep : {"all", "needed"}
        "needed" keeps only the maps in memory that the camera's first hits need: views, lights, levels of detail,
        entries of codebooks; the picture is the same. Asks Mitsuba for the camera's rays; not for a `SceneDescription`.
    environment : str
        Way in which the scene's environment lights: see :class:`btfref.rendering.environment_light.lighting.Lighting`.
    lights : int, optional
        Directional lights that stand for the environment; by default as many as it needs for an estimated error of 1 %.
    order : int, optional
        Bands of spherical harmonics; default 5.
    window : {"none", "hanning", "lanczos"}, optional
        That damps their ringing.
    transfer : btfref.rendering.environment_light.transfer.TransferSettings, optional
        Of the way "transfer".
    shadows : bool, optional
        Shadows that shapes cast under all lights but an environment. By default where a shape can be in the way
        (:func:`btfref.scene.shadows.occluders.has_occluders`) and the scene has no environment, whose light casts none
        but by the way "transfer".
    count_fetches : bool
        Count the texels that the representations fetch: ``meta["fetches"]``, the mean over covered samples.
    interpolation : {"blended", "drawn"}, optional
        Of all BTFs between measured views, in place of the scene's: all neighbours of a lookup, or one, drawn for each
        pixel and frame by a hash of their numbers (:func:`btfref.numerics.draws.of_pixels`), for all lights alike.
    frames : int, optional
        Frames that are averaged where views are drawn: the regular grid again and again, a multiple of n². By default
        once. Two rounds or more give ``variance``, that of the mean.
    seed : int
        Of the draws.
    progress : callable, optional
        ``progress(done, total, label)``, after each frame.

    Returns
    -------
    RenderResult
        A sample's footprint, and so the level of detail of methods that have levels, is that of 1/n of a pixel.
        ``meta["mirrored"]`` names the shapes whose texture is mirrored; ``other_materials`` those whose material is
        drawn as its mean albedo, with its plugin (:mod:`btfref.scene.surfaces.materials`); ``frame_ms`` is the median
        time of one frame (one sample a pixel), GPU timer and wall clock whichever is longer; ``gl_vendor``,
        ``gl_renderer``, ``gl_version``; ``negative_fraction``, the share of channels below zero, and ``not_finite``,
        their number: nothing is clamped; ``kept``, how many maps were kept by file; ``shadows``, and with them
        ``shadow_maps``, the number of maps, ``shadow_traced``, that of the lights without one, and ``shadow_ms``, the
        time to draw maps, once for all frames; where views are drawn ``interpolation``, ``frames`` and ``seed``. With
        an environment ``environment_path``, the way taken, and what it says of itself, such as ``environment_lights``
        and their ``estimated_error``; by file where there are several.

    Raises
    ------
    InputError
        For a scene that cannot be read (see :func:`btfref.scene.description.read_scene`), without lights, or with a way
        to light by the environment that a method lacks.
    MissingDependencyError
        Without an OpenGL driver.
    """
    if grid < 1:
        raise InputError("the sub-pixel grid needs a sample", field="grid", got=grid, expected="≥ 1")
    refuse_above(GRID, grid, "grid")
    refuse_unknown(interpolation)
    if keep != "all" and isinstance(scene, SceneDescription):
        raise InputError("the maps that are needed follow from a scene file", field="keep", got=keep)
    needed: Kept = {}
    if not isinstance(scene, SceneDescription):
        file, scene = scene, read_scene(scene, parameters, size=size)
        needed = kept_maps(keep, file, parameters, description=scene, grid=grid, size=size, margin=MARGIN)

    scene = interpolated(scene, interpolation)
    rounds = rounds_of(scene, grid, frames)

    def load_needed(path: str) -> Representation:
        return representations.load(path, **needed[path])

    lighting = lighting_of(scene, environment, lights=lights, order=order, window=window, transfer=transfer)
    load_file = load_needed if needed else None
    if shadows is None:
        shadows = bool(scene.lights) and scene.environment is None and has_occluders(scene)
    given: dict[str, Any] = {"lighting": lighting, "shadows": shadows, "count_fetches": count_fetches}
    with Renderer(scene, load_file, **given) as renderer:
        offsets = [((i + 0.5) / grid, (j + 0.5) / grid) for j in range(grid) for i in range(grid)]
        shape = scene.camera.height, scene.camera.width, 3
        mean, squares = np.zeros(shape), np.zeros(shape)
        times, fetches = [], []
        for done in range(rounds):
            total = np.zeros(shape)
            for number, offset in enumerate(offsets, done * len(offsets)):
                if progress:
                    progress(number, rounds * len(offsets), "frames")
                times.append(renderer.draw(offset, share=1 / grid, frame=number, seed=seed))
                total += renderer.read()
                if count_fetches:
                    fetches.append(renderer.fetches())
            total /= len(offsets)
            # Welford: rounds differ by little, sums of squares would lose it. Values that are no numbers stay none.
            with np.errstate(invalid="ignore"):
                change = total - mean
                mean += change / (done + 1)
                squares += change * (total - mean)
        image = mean.astype(np.float32)
        variance = (squares / (rounds - 1) / rounds).astype(np.float32) if rounds > 1 else None
        meta = {
            "renderer": "realtime",
            "grid": grid,
            **({"interpolation": "drawn", "frames": len(times), "seed": seed} if renderer.draws else {}),
            # Transfer carries the environment's own shadows.
            "shadows": shadows or bool(renderer.transfers and transfer is not None and transfer.shadows),
            **renderer.shadow_facts,
            "frame_ms": float(np.median(times)),
            "negative_fraction": float((image < 0).mean()),
            "not_finite": int((~np.isfinite(image)).sum()),
            "triangles": sum(len(mesh.faces) for mesh in scene.meshes),
            "lights": len(scene.lights),
            "environment": scene.environment.name if scene.environment else None,
            "kept": number_kept(needed),
            "mirrored": mirrored_meshes(scene.meshes),
            "notes": list(scene.notes),
            "other_materials": {mesh.name: mesh.bsdf for mesh in scene.meshes if not mesh.shown.exact},
            **scene.facts,
            **renderer.environment_facts,
            **device.facts(renderer.ctx),
        }
        if count_fetches:
            counts = np.stack(fetches)
            meta["fetches"] = float(counts[counts >= 0].mean()) if (counts >= 0).any() else 0.0
    if needed and meta["not_finite"]:
        # Views that are not there give no number: such a picture is not handed out.
        raise BtfrefError(
            f"{meta['not_finite']} channels needed maps that were not kept; render with all maps"
        )
    return RenderResult(image, variance, meta)
