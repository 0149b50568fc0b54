"""The meshes of the shipped scenes; ``python -m btfref.scene.shipped.meshes`` writes them again.

Each is a smooth surface sampled on a regular grid of its parameters, with exact normals and with texture
coordinates that are continuous inside the mesh. z is up; textures are placed so that one unit of uv is one
unit of length where the surface is not stretched.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from btfref.types import PathLike

#: Step of the central differences that give the normals: balances truncation and rounding in float64.
_STEP = 1e-6


def sphere(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Unit sphere; u ∈ [0, 2] around z, v ∈ [0, 1] from the south to the north pole; (...) -> (..., 3).

    One tile of v spans the meridian; two tiles of u span the equator, so that texels are square there. At the
    poles u is degenerate, as on every globe.
    """
    azimuth, polar = np.pi * u, np.pi * (1 - v)
    return np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], -1)


def cloth(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Square cloth, u and v ∈ [0, 1], that hangs in soft folds from a round table; (...) -> (..., 3)."""
    x, y = 2 * u - 1, 2 * v - 1
    square = x**2 + y**2
    # Flat on the table, falling off around radius 0.7: a bell with a flat top.
    height = 0.75 / (1 + (square / 0.5) ** 2)
    # Folds grow with the square of the distance, so that the middle stays smooth: r⁶ cos 6φ is a polynomial.
    folds = ((x + 1j * y) ** 6).real / (0.25 + square**3)
    return np.stack([x, y, height + 0.085 * square / (0.35 + square) * folds], -1)


def bowl(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Square bowl, u and v ∈ [0, 1], deep enough that its walls hide much of the sky; (...) -> (..., 3)."""
    x, y = 2 * u - 1, 2 * v - 1
    # The square of the radius, flattened towards the corners so that they do not stick out.
    square = x**2 + y**2
    return np.stack([x, y, 1.6 * square / (0.6 + 0.4 * square) - 0.9], -1)


#: Name: surface, extent of u and v, segments.
SURFACES = {
    "sphere": (sphere, (2.0, 1.0), (96, 48)),
    "cloth": (cloth, (1.0, 1.0), (64, 64)),
    "bowl": (bowl, (1.0, 1.0), (40, 40)),
}


def surface_mesh(name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A shipped mesh.

    Parameters
    ----------
    name : {"sphere", "cloth", "bowl"}

    Returns
    -------
    positions, normals : ndarray of float64, shape (n, 3)
        Vertices at a seam or a pole are repeated, each with its own texture coordinates.
    uv : ndarray of float64, shape (n, 2)
    faces : ndarray of int, shape (m, 3)
        Counter-clockwise from outside (above).
    """
    surface, extent, segments = SURFACES[name]
    u, v = (np.linspace(0, extent[i], segments[i] + 1) for i in (0, 1))
    uv = np.stack(np.meshgrid(u, v), -1)
    positions = surface(uv[..., 0], uv[..., 1])
    # A pole has no tangents: its normal is taken a little beside it, which is as exact as float32.
    inside = np.clip(uv, 1e-5, np.array(extent) - 1e-5)
    tangents = []
    for axis in np.eye(2) * _STEP:
        ahead, behind = inside + axis, inside - axis
        tangents.append(surface(ahead[..., 0], ahead[..., 1]) - surface(behind[..., 0], behind[..., 1]))
    normals = np.cross(*tangents)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    index = np.arange(uv.shape[0] * uv.shape[1]).reshape(uv.shape[:2])
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    positions, normals, uv = positions.reshape(-1, 3), normals.reshape(-1, 3), uv.reshape(-1, 2)
    corners = positions[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return positions, normals, uv, faces[area > 1e-9]


def write(directory: PathLike) -> None:
    """Write all meshes as binary PLY files ``NAME.ply`` into ``directory``."""
    import trimesh

    for name in SURFACES:
        positions, normals, uv, faces = surface_mesh(name)
        mesh = trimesh.Trimesh(positions, faces, vertex_normals=normals, process=False)
        mesh.vertex_attributes["u"], mesh.vertex_attributes["v"] = uv.astype(np.float32).T
        content = trimesh.exchange.ply.export_ply(mesh, vertex_normal=True)
        (Path(directory) / f"{name}.ply").write_bytes(content)


if __name__ == "__main__":
    write(Path(__file__).resolve().parent)
