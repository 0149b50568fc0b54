"""Pixel classes at edges between triangles of one smooth surface."""

import numpy as np
import pytest

from btfref.conventions import PixelClass
from btfref.scene.pixel_classes import pixel_classes

#: A square in two triangles, larger than the picture; its diagonal runs through the picture's corners.
CORNERS = ((-2, -2), (2, -2), (2, 2), (-2, 2))


def write_square(path, uv):
    vertices = "\n".join(f"{x} {y} 0 {u} {v}" for (x, y), (u, v) in zip(CORNERS, uv, strict=True))
    names = "\n".join(f"property float {name}" for name in ("x", "y", "z", "u", "v"))
    path.write_text(
        f"ply\nformat ascii 1.0\nelement vertex 4\n{names}\nelement face 2\n"
        f"property list uchar int vertex_indices\nend_header\n{vertices}\n3 0 1 2\n3 0 2 3\n"
    )


def classes_of(mi, path, size=16, **shape):
    view = mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": size, "height": size}
    scene = {
        "type": "scene",
        "sensor": {"type": "perspective", "fov": 30, "to_world": view, "film": film},
        "square": {"type": "ply", "filename": str(path), **shape},
        "light": {"type": "point", "position": [0, 0, 3]},
    }
    return pixel_classes(scene, grid=2)


@pytest.mark.parametrize(
    ("fourth", "turned"),
    [((0, 1), False), ((0, 0.5), True)],
    ids=["one tangent frame", "two tangent frames"],
)
def test_samples_on_an_edge_between_tangent_frames_are_ambiguous(fourth, turned, llvm, tmp_path):
    """Rationale: ∂p/∂u is constant on a triangle, and a rasterizer may give such a sample to either."""
    llvm.set_variant("scalar_rgb")
    write_square(tmp_path / "square.ply", [(0, 0), (1, 0), (1, 1), fourth])
    classes = classes_of(llvm, tmp_path / "square.ply")
    # World x and y run to the left and up, so that the diagonal y = x falls from left to right.
    diagonal = (
        np.eye(16, dtype=bool)[:, ::-1] if classes[0, -1] == PixelClass.SILHOUETTE else np.eye(16, dtype=bool)
    )
    assert (classes[~diagonal] == PixelClass.INTERIOR).all()
    assert (classes[diagonal] == (PixelClass.SILHOUETTE if turned else PixelClass.INTERIOR)).all()


def test_an_edge_is_judged_strictly_but_where_a_sample_lies_on_it(llvm, tmp_path):
    """The left and right borders of a square run through samples, or between them."""
    llvm.set_variant("scalar_rgb")
    write_square(tmp_path / "square.ply", [(0, 0), (1, 0), (1, 1), (0, 1)])
    # At a distance of 4, 16 pixels show 2 · 4 · tan 15°; samples lie at quarters of pixels.
    pixel = 8 * np.tan(np.radians(15)) / 16
    for columns, expected in ((8.5, PixelClass.SILHOUETTE), (8.0, PixelClass.EDGE)):
        scale = columns * pixel / 4
        classes = classes_of(
            llvm, tmp_path / "square.ply", to_world=llvm.ScalarTransform4f().scale([scale, 1, 1])
        )
        left, right = (int(side) for side in (8 - columns / 2, 8 + columns / 2 - 1e-3))
        assert (classes[:, [left, right]] == expected).all()
        assert (classes[:, left + 3 : right - 2] == PixelClass.INTERIOR).all()
        assert (classes[:, : left - 1] == PixelClass.BACKGROUND).all()
