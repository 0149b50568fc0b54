"""Queries in the two HDF5 layouts that public training code reads.

``records`` (of NeuMIP, Kuznetsov et al. 2021): random rows as pictures without a meaning, [item, row, column, channel].

========================== = =====================================================================================
ground_color               3 f = B / cos θ_light, 1/sr, **without** the cosine
ground_light               2 x, y of the direction in which light travels, −w_light
ground_camera_dir          2 x, y of the direction in which the camera looks, −w_view
ground_camera_target_loc   2 2u − 1, 2v − 1
ground_camera_query_radius 1 radius of the footprint, tiles
========================== = =====================================================================================

The attribute ``base_radius``, without which readers skip a file, is half a texel of the side that is asked for.

``product`` (of neural BTFs of measured pictures): a pair of directions for each picture.

================= =========== ==================================================================
ground_light      N, 2        x, y of w_light; z = √(1 − x² − y²)
ground_camera_dir N, 2        x, y of w_view
ground_color      N, H, W, 3  B in 1/sr, cosine included: the radiance under a light of irradiance
                              1 perpendicular to its direction
================= =========== ==================================================================
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from btfref.errors import InputError, MissingDependencyError

if TYPE_CHECKING:
    from types import ModuleType

    from btfref.querying.files.zarr_file import QueryFile

LAYOUTS = ("records", "product")

#: Largest side of an item of ``records``, and the texels that its base radius stands for where nothing says how many.
SIDE, TEXELS = 512, 512

#: Least cosine that B is divided by: what is nearer to the horizon than float32 tells is as dark as there.
LEAST_COSINE = 1e-6


def h5py() -> ModuleType:
    """The library.

    Raises
    ------
    MissingDependencyError
    """
    try:
        import h5py as found
    except ImportError:
        raise MissingDependencyError(
            "h5py is not installed, which HDF5 needs", "pip install 'btfref[datasets]'"
        ) from None
    return found


def item_side(n: int) -> int:
    """Side of the items of ``records``: the largest power of two up to `SIDE` whose square divides the rows."""
    return max(side for side in (2**k for k in range(int(math.log2(SIDE)) + 1)) if n % side**2 == 0)


def write_records(queries: QueryFile, out: Path, *, dtype: str = "float32", texels: int = TEXELS) -> None:
    """Write random records.

    Parameters
    ----------
    queries : QueryFile
    out : Path
    dtype : {"float32", "float16"}
    texels : int
        Along the side of the tile, of the texture to be trained: ``base_radius`` is 1 / (2 · texels).
    """
    side = item_side(queries.n)
    items, each = queries.n // side**2, side**2
    names = {
        "ground_color": 3,
        "ground_light": 2,
        "ground_camera_dir": 2,
        "ground_camera_target_loc": 2,
        "ground_camera_query_radius": 1,
    }
    # Whole items, and as many of them as a chunk of the store has rows.
    step = max(1, queries.chunk // each)
    with h5py().File(out, "w") as file:
        file.attrs["base_radius"] = 0.5 / texels
        _describe(file, queries)
        sets = {
            name: file.create_dataset(
                name,
                (items, side, side, width),
                dtype,
                chunks=(min(step, items) if side == 1 else 1, side, side, width),
            )
            for name, width in names.items()
        }
        for first in range(0, items, step):
            last = min(first + step, items)
            rows = queries.read(first * each, last * each)
            cosine = np.maximum(rows["w_light"][:, 2:], np.float32(LEAST_COSINE))
            found = {
                "ground_color": rows["B"] / cosine,
                "ground_light": -rows["w_light"][:, :2],
                "ground_camera_dir": -rows["w_view"][:, :2],
                "ground_camera_target_loc": 2 * rows["uv"] - 1,
                "ground_camera_query_radius": rows["radius"][:, None],
            }
            for name, values in found.items():
                sets[name][first:last] = _fitting(values, dtype).reshape(
                    last - first, side, side, names[name]
                )


def write_product(queries: QueryFile, out: Path, *, dtype: str = "float32") -> None:
    """Write pictures, each with its pair of directions.

    Raises
    ------
    InputError
        The rows are not of pictures.
    """
    picture = queries.attributes["settings"]["laws"]["picture"]
    if picture is None:
        raise InputError("rows that are no pictures", field="layout", got="product", expected="--picture HxW")
    height, width = picture
    each = height * width
    n = queries.n // each
    with h5py().File(out, "w") as file:
        _describe(file, queries)
        light, view = (
            file.create_dataset(name, (n, 2), "float32") for name in ("ground_light", "ground_camera_dir")
        )
        color = file.create_dataset(
            "ground_color", (n, height, width, 3), dtype, chunks=(1, height, width, 3)
        )
        step = max(1, queries.chunk // each)
        for first in range(0, n, step):
            last = min(first + step, n)
            rows = queries.read(first * each, last * each, ("w_light", "w_view", "B"))
            light[first:last] = rows["w_light"][::each, :2]
            view[first:last] = rows["w_view"][::each, :2]
            color[first:last] = _fitting(rows["B"], dtype).reshape(last - first, height, width, 3)


def _fitting(values: np.ndarray, dtype: str) -> np.ndarray:
    """Values within what the type holds."""
    return np.clip(values, -np.finfo(dtype).max, np.finfo(dtype).max).astype(dtype)


def _describe(file: object, queries: QueryFile) -> None:
    """Facts of the rows as an attribute."""
    import json

    keep = ("settings", "source", "versions", "colour_space", "units", "footprint")
    facts = {key: queries.attributes.get(key) for key in keep}
    file.attrs["btfref"] = json.dumps(facts)  # type: ignore[attr-defined]  # h5py has no types
