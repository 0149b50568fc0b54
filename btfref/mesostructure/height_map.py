"""A user's height map: a periodic surface through the pixels of an image."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from btfref.errors import InputError
from btfref.mesostructure.base import Mesostructure, Part
from btfref.mesostructure.checks import grid_faces, number
from btfref.mesostructure.materials import (
    as_numbers,
    bsdf_from_xml,
    linear_colours,
    read_image,
    texture,
)
from btfref.mesostructure.seams import map_seams, refuse

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from btfref.types import Facts, PathLike

#: Most pixels along one side: 2048² pixels are eight million triangles.
LARGEST = 2048


def height_map(
    *,
    file: PathLike,
    amplitude: float = 0.1,
    albedo: str | Sequence[float] = (0.5, 0.5, 0.5),
    roughness: str | float | None = None,
    bsdf: PathLike | None = None,
    allow_seams: bool = False,
) -> Mesostructure:
    """A surface whose heights are the pixels of an image, repeated without end.

    Pixel ``[row, column]`` is the height at v = (row + ½)/rows, u = (column + ½)/columns, as for texels. The
    surface runs through all of them and on to the first ones of the next tile, so that it is periodic to the
    last bit; shading normals are central differences across the border as well.

    Parameters
    ----------
    file : str
        PNG or TIFF of 8 or 16 bits (0 … 1), or OpenEXR (heights as they are); its first channel.
    amplitude : float
        Height in tile units of one unit of the map; the top is moved to the sampling plane.
    albedo : str or sequence of 3 floats
        Image (8 and 16 bits: sRGB; OpenEXR: linear Rec. 709) or one linear colour, in [0, 1].
    roughness : str or float, optional
        Image (its numbers as they are) or one number in [0, 1], the ``roughness`` of Mitsuba's
        ``principled``, whose GGX α is its square; None makes the surface Lambertian.
    bsdf : str, optional
        Mitsuba XML file with one BSDF, in place of albedo and roughness; u and v are the tile's.
    allow_seams : bool
        Take maps whose borders do not continue each other.

    Returns
    -------
    Mesostructure

    Raises
    ------
    InputError
        A file that cannot be read, a value out of range, or a map with a seam.
    """
    amplitude = number("the height map", "amplitude", amplitude, 0.0, 4.0)
    image = read_image(file)
    heights = as_numbers(image)[..., 0]
    check_heights(heights, file, allow_seams)
    textures: dict[str, np.ndarray] = {}
    if bsdf is not None:
        material, textures = bsdf_from_xml(bsdf)
    else:
        material = _material(albedo, roughness, textures, allow_seams)
    part = surface(amplitude * (heights - heights.max()), material, textures)
    parameters = {
        "file": str(file),
        "amplitude": amplitude,
        "albedo": albedo if isinstance(albedo, str) else [float(value) for value in albedo],
        "roughness": roughness,
        "bsdf": None if bsdf is None else str(bsdf),
        "allow_seams": bool(allow_seams),
    }
    return Mesostructure("height_map", parameters, (part,))


def _material(
    albedo: str | Sequence[float],
    roughness: str | float | None,
    textures: dict[str, np.ndarray],
    allow_seams: bool,
) -> Facts:
    """Lambertian, or Mitsuba's ``principled``, with what is given as images in ``textures``."""
    colour = _map("albedo", albedo, textures, linear_colours, 3, allow_seams)
    if roughness is None:
        return {"type": "diffuse", "reflectance": colour}
    return {
        "type": "principled",
        "base_color": colour,
        "roughness": _map("roughness", roughness, textures, as_numbers, 1, allow_seams),
        "specular": 0.5,
    }


def _map(
    name: str,
    value: PathLike | ArrayLike,
    textures: dict[str, np.ndarray],
    convert: Callable[[np.ndarray], np.ndarray],
    n_channels: int,
    allow_seams: bool,
) -> Facts | float:
    """A parameter of the BSDF: an image's texture, a colour or a number, in [0, 1]."""
    if isinstance(value, str | Path):
        image = convert(read_image(value, field=name))[..., :n_channels].astype(np.float32)
        if image.min() < 0 or image.max() > 1:
            got = f"{image.min():.4g} … {image.max():.4g}"
            raise InputError("map out of range", file=value, field=name, got=got, expected="0 … 1")
        refuse(map_seams(image, name), file=value, field=name, allow=allow_seams)
        textures[name] = image
        return texture(name)
    values = np.asarray(value, np.float64)
    if values.size != n_channels or not ((values >= 0) & (values <= 1)).all():
        expected = f"an image, or {n_channels} in [0, 1]"
        raise InputError("parameter of the height map", field=name, got=value, expected=expected)
    if n_channels == 1:
        return float(values.item())
    return {"type": "rgb", "value": values.tolist()}


def check_heights(heights: np.ndarray, file: PathLike, allow_seams: bool) -> None:
    """InputError for heights (rows, columns) of a size that cannot be taken, or with a seam."""
    if min(heights.shape) < 2 or max(heights.shape) > LARGEST:
        size = " x ".join(map(str, heights.shape))
        raise InputError("size of a height map", file=file, got=size, expected=f"2 to {LARGEST} a side")
    refuse(map_seams(heights[..., None], "heights"), file=file, allow=allow_seams)


def surface(heights: np.ndarray, material: Facts, textures: dict[str, np.ndarray]) -> Part:
    """The part through pixel centres and on to the next tile's first ones.

    Parameters
    ----------
    heights : ndarray (rows, columns)
        Tile units, at most 0.
    material : dict
    textures : dict of str to ndarray

    Returns
    -------
    Part
    """
    rows, columns = heights.shape
    row, column = (index.ravel() for index in np.mgrid[0 : rows + 1, 0 : columns + 1])
    x, y = (column + 0.5) / columns, (row + 0.5) / rows
    slope_x = 0.5 * columns * (np.roll(heights, -1, 1) - np.roll(heights, 1, 1))
    slope_y = 0.5 * rows * (np.roll(heights, -1, 0) - np.roll(heights, 1, 0))
    # The last row and column are the first ones of the next tile, bit for bit.
    place = (row % rows) * columns + column % columns
    vertices = np.stack([x, y, heights.ravel()[place]], 1)
    normals = np.stack([-slope_x.ravel()[place], -slope_y.ravel()[place], np.ones(len(place))], 1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    faces = np.concatenate(grid_faces(rows, columns))
    return Part(vertices, faces, material, normals=normals, textures=textures)
