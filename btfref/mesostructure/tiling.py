"""Mesostructure as Mitsuba shapes: one tile as a shape group, its copies as instances."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from btfref.mesostructure.materials import load_bsdf
from btfref.mesostructure.vertex_texture import ATTRIBUTES
from btfref.numerics.device_arrays import to_device

if TYPE_CHECKING:
    from btfref.mesostructure.base import Mesostructure
    from btfref.types import Facts, JitArray


def tile_group(mesostructure: Mesostructure, bsdfs: Sequence[JitArray] | None = None) -> JitArray:
    """One tile as a Mitsuba shape group; set a JIT variant first.

    Parameters
    ----------
    mesostructure : Mesostructure
    bsdfs : list of mitsuba.BSDF, optional
        One per part; loaded from the parts when not given.

    Returns
    -------
    mitsuba.Object
        A ``shapegroup`` to be referred to by ``instance`` shapes.
    """
    import mitsuba as mi

    group = {"type": "shapegroup"}
    for index, part in enumerate(mesostructure.parts):
        properties = mi.Properties()
        properties["mesh_bsdf"] = load_bsdf(part) if bsdfs is None else bsdfs[index]
        mesh = mi.Mesh(
            f"{mesostructure.name}_{index}",
            len(part.vertices),
            len(part.faces),
            has_vertex_normals=part.normals is not None,
            has_vertex_texcoords=True,
            props=properties,
        )
        uv = part.vertices[:, :2] if part.uv is None else part.uv
        values = mi.traverse(mesh)
        values["vertex_positions"] = to_device(mi.Float, part.vertices)
        values["faces"] = to_device(mi.UInt32, part.faces)
        if part.normals is not None:
            values["vertex_normals"] = to_device(mi.Float, part.normals)
        values["vertex_texcoords"] = to_device(mi.Float, uv)
        values.update()
        for name, numbers in part.attributes.items():
            # Mitsuba hands attributes out in ones and threes.
            wide = np.pad(numbers, ((0, 0), (0, 1))) if numbers.shape[1] == 2 else numbers
            flat = np.ascontiguousarray(wide, np.float32).ravel()
            mesh.add_attribute(ATTRIBUTES + name, wide.shape[1], flat)
        group[f"part_{index}"] = mesh
    return mi.load_dict(group)


def tiled_shapes(
    mesostructure: Mesostructure,
    columns: Iterable[int],
    rows: Iterable[int],
    to_world: JitArray | None = None,
    bsdfs: Sequence[JitArray] | None = None,
) -> Facts:
    """Copies of the tile as a dict of shapes for ``mi.load_dict``.

    Parameters
    ----------
    mesostructure : Mesostructure
    columns, rows : iterable of int
        Tile offsets along x and along y; every pair becomes an instance.
    to_world : mitsuba.ScalarTransform4f, optional
        From tile coordinates to the world.
    bsdfs : list of mitsuba.BSDF, optional
        One per part; loaded from the parts when not given.

    Returns
    -------
    dict
    """
    import mitsuba as mi

    transform = mi.ScalarTransform4f() if to_world is None else to_world
    shapes = {"tile": tile_group(mesostructure, bsdfs)}
    for j in rows:
        for i in columns:
            shapes[f"copy_{i}_{j}".replace("-", "m")] = {
                "type": "instance",
                "to_world": transform @ mi.ScalarTransform4f().translate([int(i), int(j), 0]),
                "group": shapes["tile"],
            }
    return shapes
