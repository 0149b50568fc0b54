"""Which shapes can hide a light, and where the borders of shadows are."""

import numpy as np
import pytest

from btfref.conventions import PixelClass
from btfref.gates import tolerance
from btfref.rendering.gl.shadows import light_views, occluder_table
from btfref.scene.description import Light, MeshDescription, read_scene
from btfref.scene.loading import loaded
from btfref.scene.pixel_classes import pixel_classes
from btfref.scene.shadows.occluders import casters, casts_shadows, has_occluders, in_one_plane

SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)


def square(centre=(0, 0, 0), size=1.0, rotation=None):
    """A flat mesh of two triangles."""
    positions = size * SQUARE @ (np.eye(3) if rotation is None else rotation).T + centre
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return MeshDescription("a", "ply", positions, None, SQUARE[:, :2], faces, False, None, "", np.eye(4))


def light(kind, *position):
    return Light(kind, np.array(position, float), np.ones(3))


def test_points_in_one_plane(rng):
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    flat = np.append(rng.normal(size=(50, 2)), np.full((50, 1), 3.0), 1) @ turn.T
    normal, offset = in_one_plane(flat.astype(np.float32))
    np.testing.assert_allclose(flat @ normal, offset, atol=tolerance("rendered.shadow.flat"))
    flat[7] += 1e-3 * normal
    assert in_one_plane(flat) is None


def test_a_floor_casts_no_shadow():
    floor, table = square(), square((0, 0, 0.5), 0.3)
    above, below, beside = light("point", 0, 0, 2), light("point", 0, 0, -2), light("point", 0, 0, 0.2)
    assert casters(above, [floor, table]) == [1]
    assert casters(below, [floor, table]) == [0]
    assert casters(beside, [floor, table]) == []
    assert casters(light("directional", 0, 0, 1), [floor, table]) == [1]
    assert casters(light("directional", 0, 0, -1), [floor, table]) == [0]
    assert casters(above, [floor]) == []


@pytest.mark.parametrize(
    ("shapes", "expected"),
    [
        ({"a": {"type": "rectangle"}}, False),
        ({"a": {"type": "rectangle"}, "b": {"type": "disk"}}, False),
        ({"a": {"type": "rectangle"}, "b": {"type": "sphere"}}, True),
        ({"a": {"type": "cube"}}, True),
        ({"a": {"type": "rectangle", "emitter": {"type": "area"}}}, False),
        ({"a": {"type": "instance", "of": {"type": "ref", "id": "group"}}}, True),
    ],
    ids=["rectangle", "one plane", "sphere", "cube", "shining", "instance"],
)
def test_both_renderers_know_whether_a_scene_has_occluders(llvm, shapes, expected):
    llvm.set_variant("scalar_rgb")
    turned = llvm.ScalarTransform4f().translate([1, 2, 3]).rotate([1, 2, -1], 40)
    # The second one beside the first.
    places = (turned, turned @ llvm.ScalarTransform4f().translate([3, -1, 0]))
    shapes = {
        name: {**shape, "to_world": place}
        for (name, shape), place in zip(shapes.items(), places, strict=False)
    }
    sun = {"sun": {"type": "directional", "direction": [0, 0.3, -1]}}
    group = {"group": {"type": "shapegroup", "of": {"type": "rectangle"}}}
    scene = {"type": "scene", "sensor": {"type": "perspective"}, **group, **shapes, **sun}
    assert has_occluders(read_scene(scene)) == expected
    with loaded(scene) as made:
        assert casts_shadows(made) == expected


@pytest.mark.parametrize(
    ("source", "count"),
    [
        (light("directional", 0, 0.6, 0.8), 1),
        (light("point", 0.2, 0.1, 4), 1),
        (light("point", 0, 0, 0.1), 6),
    ],
    ids=["direction", "cone", "cube"],
)
def test_tiles_show_all_that_casts_shadows(rng, source, count):
    points = rng.uniform(-1, 1, (500, 3))
    views = light_views(source, points)
    assert len(views) == count
    seen = np.zeros(len(points), int)
    for view in views:
        x, y, depth, w = view.matrix @ np.append(points, np.ones((500, 1)), 1).T
        inside = (w > 0) & (np.maximum(abs(x), abs(y)) <= w)
        seen += inside
        assert (depth[inside] > 0).all()
        assert (depth[inside] < 1).all()
        # What is farther from the light is deeper.
        away = points[inside] @ -source.position if source.kind == "directional" else w[inside]
        assert (np.argsort(away) == np.argsort(depth[inside])).all()
    assert (seen >= 1).all()


def test_neighbours_of_several_meshes_are_counted_through():
    table, spans = occluder_table([square(), square((0, 0, 1))])
    assert spans == [(0, 2), (2, 2)]
    assert table.shape == (4, 4, 4)
    np.testing.assert_array_equal(table[:, 3, :3], [[-1, 1, -1], [-1, -1, 0], [-1, 3, -1], [-1, -1, 2]])


def test_the_border_of_a_shadow_is_one_pixel_wide(llvm):
    """A half plane under the sun: its shadow ends in the middle of column 20, or of a sample's neighbourhood."""
    llvm.set_variant("scalar_rgb")
    transform = llvm.ScalarTransform4f
    pixel = 8 * np.tan(np.radians(15)) / 32
    # The screen itself is behind the camera.
    edge = (20.5 - 16) * pixel
    scene = {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "fov": 30,
            "to_world": transform().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 32, "height": 32},
        },
        "floor": {"type": "rectangle", "to_world": transform().scale(3)},
        "screen": {
            "type": "rectangle",
            "to_world": transform().translate([edge + 12, 0, 8]).scale([4, 9, 1]),
        },
        "sun": {"type": "directional", "direction": [-1, 0, -1]},
    }
    classes = pixel_classes(scene, grid=4, shadows=True)
    at = np.flatnonzero((classes == PixelClass.SHADOW_BORDER).all(0))
    assert at.tolist() == [20]
    assert (np.delete(classes, at, 1) == PixelClass.INTERIOR).all()
    assert (pixel_classes(scene, grid=4) == PixelClass.INTERIOR).all()
    # For a renderer with a coarser map the neighbours are near, too.
    coarse = pixel_classes(scene, grid=4, shadows=True, follows_rays=False)
    assert np.flatnonzero((coarse == PixelClass.SHADOW_BORDER).all(0)).tolist() == [19, 20, 21]
