"""A g-BRDF straight from modelled geometry: what the model itself can show, without any error of a decomposition.

Heights are rays from above, materials the BSDFs of the parts; neither interreflection nor overhangs are in the model.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

from btfref.errors import InputError
from btfref.numerics.device_arrays import to_device
from btfref.numerics.heightfield import HeightField
from btfref.numerics.sphere.directions import directions

if TYPE_CHECKING:
    from btfref.mesostructure.base import Mesostructure, Part
    from btfref.numerics.sphere.directions import DirectionSet
    from btfref.representations.gbrdf.definition import Representation
    from btfref.sampling.sampled_btf import SampledBTF
    from btfref.types import JitArray, PathLike


#: Directions at which a part's BSDF is evaluated to find its distribution.
_DIRECTIONS = "ubo151"

#: The same for textured parts, whose colours differ from texel to texel.
_TEXTURED_DIRECTIONS = "10x5"


def from_mesostructure(
    mesostructure: PathLike | Mesostructure,
    *,
    texels: int = 64,
    ndf_size: int = 32,
    storage: str = "half",
    filter_type: str = "bilinear",
    **parameters: Any,
) -> Representation:
    """The g-BRDF of a mesostructure, without a BTF.

    Parameters
    ----------
    mesostructure : str, path-like or Mesostructure
        What `btfref.mesostructure.build` takes; what lies below something else is not seen.
    texels : int
        Rows and columns.
    ndf_size : int
        Texels per side of the distributions, a power of two.
    storage : {"half", "float"}
    filter_type : {"bilinear", "nearest"}
    **parameters
        Of the mesostructure.

    Returns
    -------
    btfref.representations.gbrdf.definition.Representation
        One material a part. Heights and frames are those under the texels' centres; c_d, r0 and p of each part are
        fitted to its BSDF by the decomposition's last step.

    Raises
    ------
    InputError
        Bad parameters, or a surface with holes.
    """
    from btfref.mesostructure import build
    from btfref.representations.gbrdf.build import from_maps
    from btfref.representations.lookup import positive_integer

    texels = positive_integer("texels", texels)
    made = build(mesostructure, **parameters)
    previous = _set_variant()
    try:
        surface = _seen_from_above(made, texels)
        materials = [
            _material(bsdf, part, surface.uv[surface.part == k], ndf_size)
            for k, (bsdf, part) in enumerate(zip(surface.bsdfs, made.parts, strict=True))
        ]
    finally:
        if previous is not None:
            import mitsuba as mi

            mi.set_variant(previous)
    diffuse, fresnel = np.zeros((texels * texels, 3)), np.zeros(texels * texels)
    for k, material in enumerate(materials):
        diffuse[surface.part == k], fresnel[surface.part == k] = material["diffuse"], material["fresnel"]
    low, high = float(surface.height.min()), float(surface.height.max())
    shape = (texels, texels)
    unit = (surface.height - low) / (high - low) if high > low else np.ones(len(surface.height))
    return from_maps(
        unit.reshape(shape),
        height_min=low,
        height_max=high,
        diffuse=diffuse.reshape(*shape, 3),
        fresnel=fresnel.reshape(shape),
        rotation=surface.rotation.reshape(shape),
        material=surface.part.reshape(shape),
        ndf=np.concatenate([material["ndf"] for material in materials]),
        specular=np.concatenate([material["specular"] for material in materials]),
        storage=storage,
        filter_type=filter_type,
        parameters={"texels": texels, "ndf_size": ndf_size},
        parent={"kind": "mesostructure", "name": made.name, "parameters": made.parameters},
    )


def _set_variant() -> str | None:
    """Mitsuba's LLVM variant; returns the one that was set before."""
    from btfref.platform import prepare_llvm

    prepare_llvm()
    import mitsuba as mi

    previous = mi.variant()
    mi.set_variant("llvm_ad_rgb")
    return previous


def _seen_from_above(made: Mesostructure, texels: int) -> SimpleNamespace:
    """Height, part, texture coordinates and rotation of the tangent under each texel's centre."""
    import mitsuba as mi

    from btfref.sampling.tiled_scene import TiledScene

    scene = TiledScene(made, np.array([[0.0, 0.0, 1.0]]))
    index = np.arange(texels * texels)
    x, y = (index % texels + 0.5) / texels, (index // texels + 0.5) / texels
    origin = mi.Point3f(to_device(mi.Float, x), to_device(mi.Float, y), 0.125)
    si = scene.intersect(origin, mi.Vector3f(0, 0, -1))
    hit = np.array(si.is_valid())
    if not hit.all():
        raise InputError(
            "the mesostructure has holes",
            field="mesostructure",
            got=f"{(~hit).sum()} texels",
            expected="none",
        )
    part = np.zeros(len(index), np.int64)
    for k, bsdf in enumerate(scene.bsdfs):
        part[np.array(si.bsdf() == mi.BSDFPtr(bsdf))] = k
    n, s = (np.array(v, float).T for v in (si.sh_frame.n, si.sh_frame.s))
    u = np.array([1.0, 0.0, 0.0]) - n * n[:, :1]
    v = np.cross(n, u)
    rotation = np.arctan2((s * v).sum(1), (s * u).sum(1)) / (2 * np.pi)
    return SimpleNamespace(
        height=np.minimum(np.array(si.p.z, float), 0),
        part=part,
        uv=np.array(si.uv, float).T,
        rotation=rotation,
        bsdfs=scene.bsdfs,
    )


def _material(bsdf: JitArray, part: Part, uv: np.ndarray, ndf_size: int) -> dict[str, np.ndarray]:
    """Parameters of a part's BSDF: those of a flat BTF made of it, a column of texels."""
    from btfref.representations.gbrdf.decomposition.reflectance import material_reflectance
    from btfref.representations.gbrdf.decomposition.samples import SurfaceSamples

    textured = bool(part.textures)
    uv = uv if textured and len(uv) else np.full((1, 2), 0.5)
    flat = _flat_btf(bsdf, uv, directions(_TEXTURED_DIRECTIONS if textured else _DIRECTIONS))
    surface = SurfaceSamples(flat, HeightField(np.zeros((len(uv), 1), np.float32)))
    labels = np.zeros(len(uv), np.int64)
    return material_reflectance(flat, surface, labels, 1, size=ndf_size)


def _flat_btf(bsdf: JitArray, uv: np.ndarray, w: DirectionSet) -> SampledBTF:
    """A plane of the BSDF as a sampled BTF in memory, one texel for each texture coordinate."""
    import drjit as dr
    import mitsuba as mi

    from btfref.sampling import SampledBTF

    n, k = len(uv), len(w)
    values = np.zeros((k, k, n, 1, 3), np.float32)
    light = np.repeat(w.vectors, n, 0)
    si = dr.zeros(mi.SurfaceInteraction3f, k * n)
    si.uv, w_light = to_device(mi.Point2f, np.tile(uv, (k, 1)).T), to_device(mi.Vector3f, light.T)
    for view in range(k):
        si.wi = mi.Vector3f(*(dr.opaque(mi.Float, float(c)) for c in w.vectors[view]))  # one kernel for all
        value = np.array(bsdf.eval(mi.BSDFContext(), si, w_light), np.float32)
        values[view] = value.T.reshape(k, n, 1, 3)
    return SampledBTF(values, w, w)
