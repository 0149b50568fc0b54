"""Geometry and materials of a mesostructure as files that other programs read: PLY, and Mitsuba's dictionaries."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from btfref.outputs import new_file

if TYPE_CHECKING:
    from btfref.mesostructure.base import Mesostructure, Part


def write_geometry(mesostructure: Mesostructure, folder: Path) -> None:
    """Write ``part_K.ply`` and ``materials.json``, the parts' BSDFs as for ``mitsuba.load_dict``.

    Parameters
    ----------
    mesostructure : Mesostructure
        Without textures.
    folder : Path
        Is there.
    """
    for number, part in enumerate(mesostructure.parts):
        with new_file(folder / f"part_{number}.ply") as draft:
            draft.write_bytes(ply(part))
    facts = {
        "units": "tile: the parts repeat with period 1 along x and y",
        "parts": [
            {"file": f"part_{number}.ply", "bsdf": part.bsdf}
            for number, part in enumerate(mesostructure.parts)
        ],
    }
    with new_file(folder / "materials.json") as draft:
        draft.write_text(json.dumps(facts, indent=1) + "\n", "utf-8")


def ply(part: Part) -> bytes:
    """A part as a binary little-endian PLY: positions, normals where it has any, texture coordinates.

    Parameters
    ----------
    part : Part

    Returns
    -------
    bytes
    """
    uv = part.vertices[:, :2] if part.uv is None else part.uv
    columns = [("xyz", part.vertices), ("uv", uv)]
    names = ["x", "y", "z", "u", "v"]
    if part.normals is not None:
        columns.insert(1, ("normal", part.normals))
        names[3:3] = ["nx", "ny", "nz"]
    table = np.concatenate([values for _, values in columns], 1).astype("<f4")
    faces = np.zeros(len(part.faces), [("n", "u1"), ("index", "<i4", 3)])
    faces["n"], faces["index"] = 3, part.faces
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(table)}",
        *(f"property float {name}" for name in names),
        f"element face {len(faces)}",
        "property list uchar int vertex_index",
        "end_header",
        "",
    ]
    return "\n".join(lines).encode() + table.tobytes() + faces.tobytes()
