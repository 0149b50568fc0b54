"""g-BRDFs from maps, from one photograph, and from modelled geometry without fitting."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from btfref.conventions import FILTER_TYPES
from btfref.errors import InputError
from btfref.numerics.heightfield import HEIGHT_LIMIT
from btfref.numerics.microfacets import isotropic_ndf
from btfref.numerics.sphere.directions import DirectionSet, directions
from btfref.representations.gbrdf.definition import Representation, field_constants
from btfref.representations.lookup import direction_arrays, meta_for, stored

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, DTypeLike

    from btfref.types import Facts, PathLike


#: Turns are stored in steps of 1/1530: the fully saturated hues of an 8-bit picture, so that pictures lose nothing.
HUE_STEPS = 6 * 255

#: Texels per side of a distribution's table.
NDF_SIZE = 32


def from_maps(
    height: ArrayLike,
    *,
    diffuse: ArrayLike,
    height_min: float = -0.1,
    height_max: float = 0.0,
    rotation: ArrayLike = 0.0,
    fresnel: ArrayLike = 0.04,
    material: ArrayLike = 0,
    ndf: ArrayLike | None = None,
    specular: ArrayLike = 0.0,
    views: str | DirectionSet | ArrayLike = "ubo81",
    lights: str | DirectionSet | ArrayLike = "ubo81",
    filter_type: str = "bilinear",
    storage: str = "half",
    parameters: Facts | None = None,
    parent: Facts | None = None,
) -> Representation:
    """A g-BRDF from its maps.

    Parameters
    ----------
    height : array_like, shape (rows, columns)
        In [0, 1]; 0 stands for ``height_min``, 1 for ``height_max``.
    diffuse : array_like, shape (rows, columns, 3) or (3,)
        c_d, linear Rec. 709 in [0, 1].
    height_min, height_max : float
        Tile units in [−4, 4], not decreasing.
    rotation : array_like, shape (rows, columns) or ()
        Of the tangent about the normal, in turns; wrapped to [0, 1) and rounded to 1/1530, the steps of a hue.
    fresnel : array_like, shape (rows, columns) or ()
        r0 in [0, 1].
    material : array_like of int, shape (rows, columns) or ()
        Index of the distribution.
    ndf : array_like, shape (m, n, n) or (m, n, n, 3), optional
        Parabolic tables of p, finite and non-negative; default: one isotropic GGX distribution of roughness 0.3.
    specular : array_like, shape (m,) or ()
        c_s in [0, 1] of each material; each texel holds it below what conserves energy.
    views, lights
        Sets of directions that guide importance sampling; see `btfref.numerics.sphere.directions.directions`.
    filter_type : {"bilinear", "nearest"}
    storage : {"half", "float"}
        Type of colours and distributions; heights and rotations are float32.
    parameters, parent : dict, optional
        Recorded.

    Returns
    -------
    Representation

    Raises
    ------
    InputError
        Shapes that do not fit, values out of range.
    """
    height = np.asarray(height, float)
    if height.ndim != 2 or 0 in height.shape:
        raise InputError("shape of a map", field="height", got=height.shape, expected="(rows, columns)")
    shape = height.shape
    if filter_type not in FILTER_TYPES:
        raise InputError(
            "unknown filter", field="filter_type", got=filter_type, expected=" or ".join(FILTER_TYPES)
        )
    ends = [float(x) for x in (height_min, height_max)]
    if not (np.isfinite(ends).all() and -HEIGHT_LIMIT <= ends[0] <= ends[1] <= HEIGHT_LIMIT):
        expected = f"-{HEIGHT_LIMIT:g} ≤ height_min ≤ height_max ≤ {HEIGHT_LIMIT:g}"
        raise InputError("heights out of range", field="height_min, height_max", got=ends, expected=expected)
    ndf = isotropic_ndf(0.3, NDF_SIZE)[None] if ndf is None else np.asarray(ndf, float)
    if ndf.ndim == 3:
        ndf = np.repeat(ndf[..., None], 3, -1)
    if ndf.ndim != 4 or ndf.shape[1] != ndf.shape[2] or ndf.shape[3] != 3 or 0 in ndf.shape:
        raise InputError("shape of a map", field="ndf", got=ndf.shape, expected="(materials, n, n, 3)")
    n_materials = len(ndf)
    names = _broadcast("material", material, shape, None)
    if names.dtype.kind not in "iu" or names.min() < 0 or names.max() >= n_materials:
        got = f"{names.dtype} {names.min()} … {names.max()}"
        raise InputError("index map", field="material", got=got, expected=f"integers 0 … {n_materials - 1}")
    turns = _broadcast("rotation", rotation, shape)
    if not np.isfinite(turns).all():
        raise InputError("a map holds a value that is not finite", field="rotation")
    turns = (np.rint(np.mod(turns, 1) * HUE_STEPS) % HUE_STEPS / HUE_STEPS).astype(np.float32)
    colours = _unit("diffuse", _broadcast("diffuse", diffuse, (*shape, 3)))
    r0 = _unit("fresnel", _broadcast("fresnel", fresnel, shape))
    amounts = _unit("specular", _broadcast("specular", specular, (n_materials,)))
    maps = {
        "height": _unit("height", height)[..., None].astype(np.float32),
        "rotation": turns[..., None],
        "diffuse": stored("diffuse", colours, storage),
        "fresnel": stored("fresnel", r0, storage)[..., None],
        "material": names[..., None].astype(np.uint32),
        "ndf": stored("ndf", _unit("ndf", ndf, np.inf), storage),
        "specular": amounts[:, None].astype(np.float32),
    }
    views, lights = directions(views), directions(lights)
    meta = meta_for("gbrdf", shape, views, lights, parameters or {}, filter_type=filter_type, parent=parent)
    meta["constants"] = field_constants(maps, {"height_min": ends[0], "height_max": ends[1]})
    meta["index_bytes"] = {"material": 1 if n_materials <= 256 else 2}
    return Representation(maps | direction_arrays(views, lights), meta)


def _broadcast(
    name: str, value: ArrayLike, shape: tuple[int, ...], dtype: DTypeLike | None = float
) -> np.ndarray:
    try:
        return np.broadcast_to(np.asarray(value, dtype), shape)
    except ValueError:
        raise InputError("shape of a map", field=name, got=np.shape(value), expected=shape) from None


def _unit(name: str, values: ArrayLike, largest: float = 1.0) -> np.ndarray:
    """``values`` after the check that they are finite and in [0, largest]."""
    values = np.asarray(values, float)
    if not (np.isfinite(values).all() and values.min() >= 0 and values.max() <= largest):
        got = f"{values.min():.4g} … {values.max():.4g}"
        expected = "finite, ≥ 0" if np.isinf(largest) else f"0 … {largest:g}"
        raise InputError("a map is out of range", field=name, got=got, expected=expected)
    return values


def from_photograph(
    image: PathLike | np.ndarray,
    *,
    depth: float = 0.02,
    fresnel: float = 0.04,
    roughness: float = 0.3,
    specular: float = 0.2,
    rotation: float = 0.125,
    **parameters: Any,
) -> Representation:
    """A g-BRDF from one picture, as the last example of the paper (section 6, figure 13).

    The picture becomes the diffuse map, its luminance the height, and one distribution a minor highlight.

    Parameters
    ----------
    image : path-like or ndarray, shape (rows, columns, 3)
        PNG, JPEG… (sRGB) or OpenEXR; an array holds linear colours in [0, 1].
    depth : float
        Tile units between the darkest and the brightest texel.
    fresnel, roughness, specular : float
        r0, GGX α and c_s of the highlight.
    rotation : float
        Turns; the paper sets 45°.
    **parameters
        Of :func:`from_maps`.

    Returns
    -------
    Representation
    """
    from btfref.conventions import luminance
    from btfref.mesostructure.checks import number
    from btfref.mesostructure.materials import linear_colours, read_image

    if isinstance(image, np.ndarray):
        name, colours = None, image
    else:
        name, colours = str(image), np.clip(linear_colours(read_image(image)), 0, 1)
    if colours.ndim != 3 or colours.shape[-1] != 3:
        raise InputError(
            "shape of a picture", field="image", got=colours.shape, expected="(rows, columns, 3)"
        )
    depth = number("a photograph's g-BRDF", "depth", depth, 0.0, HEIGHT_LIMIT)
    roughness = number("a photograph's g-BRDF", "roughness", roughness, 0.01, 1.0)
    grey = luminance(colours.astype(float))
    low, high = float(grey.min()), float(grey.max())
    height = (grey - low) / (high - low) if high > low else np.ones_like(grey)
    settings = {"depth": depth, "fresnel": fresnel, "roughness": roughness, "specular": specular}
    return from_maps(
        height,
        diffuse=colours,
        height_min=-depth,
        height_max=0.0,
        rotation=rotation,
        fresnel=fresnel,
        ndf=isotropic_ndf(roughness, NDF_SIZE)[None],
        specular=specular,
        parameters={"photograph": name, **settings},
        **parameters,
    )
