"""Scenes and materials in which the plugin is timed, and what a user would take in its place."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from btfref.sampling import SampledBTF
    from btfref.types import Facts, JitArray, PathLike


#: What stands in for a BTF where none is at hand: one BRDF with a coloured texture.
BASELINE = "principled + bitmap"

#: Tiles of the texture along a side.
TILING = 4

#: Name -> (shape, where the camera stands, its field of view in degrees).
SHAPES = {"sphere": ((0, -4, 1), 30), "cloth": ((0.6, -2.6, 2.0), 45)}
LIGHTS = ("sky", "suns")


def names() -> list[str]:
    """All scenes: a bare sphere, where nothing but shading costs, and the shipped cloth, each under two lights."""
    return [f"{shape}, {light}" for shape in SHAPES for light in LIGHTS]


def scene(name: str, bsdf: Facts, *, size: int, integrator: Facts | None = None) -> Facts:
    """A scene as Mitsuba's dictionary.

    Parameters
    ----------
    name : str
        One of :func:`names`.
    bsdf : dict
    size : int
        Pixels along a side.
    integrator : dict, optional
        Default: paths of up to 6 segments.
    """
    import mitsuba as mi

    from btfref.scene.shipped import scene_file

    t = mi.ScalarTransform4f
    kind, light = name.split(", ")
    origin, fov = SHAPES[kind]
    if kind == "sphere":
        shape: Facts = {"type": "sphere", "bsdf": bsdf}
    else:
        # Mitsuba evaluates both sides of a ``twosided`` material: only where the back can be seen.
        mesh = scene_file("cloth").with_name("cloth.ply")
        shape = {"type": "ply", "filename": str(mesh), "bsdf": {"type": "twosided", "bsdf": bsdf}}
    emitters: Facts
    if light == "sky":
        emitters = {"sky": {"type": "constant"}}
    else:
        directions = ([0, 1, -1], [1, 0.5, -1], [-1, 0.3, -1])
        emitters = {f"sun{i}": {"type": "directional", "direction": d} for i, d in enumerate(directions)}
    film = {
        "type": "hdrfilm",
        "width": size,
        "height": size,
        "component_format": "float32",
        "rfilter": {"type": "box"},
    }
    return {
        "type": "scene",
        "integrator": integrator or {"type": "path", "max_depth": 6},
        "sensor": {
            "type": "perspective",
            "fov": fov,
            "to_world": t().look_at(list(origin), [0, 0, 0], [0, 0, 1]),
            "film": film,
        },
        "shape": shape,
        **emitters,
    }


def btf_material(path: PathLike, query: Mapping[str, object], **parameters: object) -> Facts:
    """The plugin with a file."""
    import mitsuba as mi

    to_uv = mi.ScalarTransform4f().scale([TILING, TILING, 1])
    return {"type": "btf", "filename": str(path), "to_uv": to_uv, **query, **parameters}


def plain_materials(btf: SampledBTF) -> dict[str, Facts]:
    """What a user would take instead: name -> dictionary, with the top view under the top light as an albedo.

    A texture of the same size and contrast as the BTF.
    """
    import mitsuba as mi

    albedo = np.clip(btf.values[0, 0].astype(np.float32) * np.pi, 0, 1)

    def bitmap() -> Facts:
        to_uv = mi.ScalarTransform4f().scale([TILING, TILING, 1])
        return {
            "type": "bitmap",
            "bitmap": mi.Bitmap(albedo),
            "raw": True,
            "format": "variant",
            "to_uv": to_uv,
        }

    return {
        BASELINE: {"type": "principled", "base_color": bitmap(), "roughness": 0.3, "specular": 0.5},
        "roughplastic + bitmap": {"type": "roughplastic", "diffuse_reflectance": bitmap(), "alpha": 0.3},
    }


def render_task(loaded: JitArray, spp: int) -> Callable[[], JitArray]:
    """A call that renders a loaded scene once more, with another seed, and returns the picture (H, W, 3)."""
    import drjit as dr
    import mitsuba as mi

    seeds = iter(range(1 << 30))

    def render() -> JitArray:
        # An opaque seed: a literal one would compile the kernel anew.
        image = mi.render(loaded, spp=spp, seed=dr.opaque(mi.UInt32, next(seeds)))
        dr.eval(image)
        dr.sync_thread()
        return image

    return render
