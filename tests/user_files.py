"""Small meshes and pictures as a user has them, for the tests of user geometry."""

import numpy as np
from PIL import Image

SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
FACES = np.array([[0, 1, 2], [0, 2, 3]])


def texture(n=8):
    """An image without any symmetry: row and column are in its colours."""
    row, column = np.mgrid[0:n, 0:n]
    return np.stack([30 + 25 * row, 30 + 25 * column, np.full_like(row, 60)], -1).astype(np.uint8)


def grid(n, height):
    """Vertices (tile units) and faces of a height field over the closed unit square."""
    x, y = np.meshgrid(np.arange(n + 1) / n, np.arange(n + 1) / n)
    corner = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    quads = np.stack([corner, corner + 1, corner + n + 2, corner + n + 1], 1)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return np.stack([x, y, height(x, y)], -1).reshape(-1, 3), faces


def write_obj(folder, name="m.obj", kd="1 1 1", vertices=SQUARE, faces=FACES, uv=None):
    Image.fromarray(texture()).save(folder / "t.png")
    (folder / "m.mtl").write_text(f"newmtl a\nKd {kd}\nmap_Kd t.png\n")
    uv = vertices[:, :2] if uv is None else uv
    lines = ["mtllib m.mtl", *(f"v {x} {y} {z}" for x, y, z in vertices), *(f"vt {u} {v}" for u, v in uv)]
    lines += ["usemtl a", *("f " + " ".join(f"{k + 1}/{k + 1}" for k in face) for face in faces)]
    (folder / name).write_text("\n".join(lines) + "\n")
    return folder / name
