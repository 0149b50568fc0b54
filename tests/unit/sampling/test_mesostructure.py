"""Mesostructures: periodic, touching the sampling plane, with checked parameters."""

import numpy as np
import pytest

from btfref.errors import InputError
from btfref.mesostructure import FROM_FILES, MESOSTRUCTURES, Mesostructure, Part, build, names
from btfref.mesostructure.checker import checker_height

#: Those that need no file.
MODELLED = sorted(set(MESOSTRUCTURES) - set(FROM_FILES))


@pytest.mark.parametrize("name", MODELLED)
def test_top_touches_the_sampling_plane(name):
    low, high = build(name).height
    assert high == 0.0
    assert low <= 0.0


@pytest.mark.parametrize("name", MODELLED)
def test_parameters_rebuild_the_same_geometry(name):
    first = build(name)
    second = build(name, **first.parameters)
    assert first.parameters == second.parameters
    for a, b in zip(first.parts, second.parts, strict=True):
        assert np.array_equal(a.vertices, b.vertices)
        assert np.array_equal(a.faces, b.faces)
        assert a.bsdf == b.bsdf


def _border(mesostructure, axis, side):
    """Vertices on one side of the tile: coordinate along the side → height and normal."""
    found = {}
    for part in mesostructure.parts:
        for vertex, normal in zip(part.vertices, part.normals, strict=True):
            if vertex[axis] == side:
                found[vertex[1 - axis]] = (vertex[2], *normal)
    return found


@pytest.mark.parametrize("cells", [2, 4])
@pytest.mark.parametrize("axis", [0, 1])
def test_checker_closes_bit_for_bit(cells, axis):
    tile = build("checker", cells=cells, resolution=32)
    near, far = _border(tile, axis, 0.0), _border(tile, axis, 1.0)
    assert len(near) == 33
    assert near == far


def test_checker_height_is_periodic_and_smooth():
    x, y = np.random.default_rng(3).uniform(-2, 2, (2, 1000))
    options = {"cells": 4, "amplitude": 0.2, "smoothness": 0.4}
    height, slope_x, slope_y = checker_height(x, y, **options)
    # Multiples of 1/8 shift without rounding.
    x8, y8 = np.round(x * 2**20) / 2**20, np.round(y * 2**20) / 2**20
    for moved in ((x8 + 1, y8), (x8, y8 - 2)):
        for a, b in zip(checker_height(x8, y8, **options), checker_height(*moved, **options), strict=True):
            assert np.array_equal(a, b)
    step = 2.0**-20
    numeric = (checker_height(x + step, y, **options)[0] - checker_height(x - step, y, **options)[0]) / (
        2 * step
    )
    from btfref.gates.tolerances import tolerance

    assert np.abs(numeric - slope_x).max() <= tolerance("mesostructure.slope")
    numeric = (checker_height(x, y + step, **options)[0] - checker_height(x, y - step, **options)[0]) / (
        2 * step
    )
    assert np.abs(numeric - slope_y).max() <= tolerance("mesostructure.slope")
    assert height.min() >= -options["amplitude"]
    assert height.max() <= 0


def test_checker_covers_the_tile_once_and_faces_up():
    tile = build("checker", resolution=32)
    area = 0.0
    for part in tile.parts:
        a, b, c = (part.vertices[part.faces[:, k], :2] for k in range(3))
        cross = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
        assert (cross > 0).all()
        area += cross.sum() / 2
    assert area == 1.0


def test_checker_raised_part_is_pink_and_more_specular():
    raised, low = build("checker").parts
    assert raised.vertices[:, 2].mean() > low.vertices[:, 2].mean()
    pink, blue = (np.array(p.bsdf["diffuse_reflectance"]["value"]) for p in (raised, low))
    assert pink.argmax() == 0
    assert blue.argmax() == 2
    assert raised.bsdf["alpha"] < low.bsdf["alpha"]


@pytest.mark.parametrize(
    ("name", "parameters", "field"),
    [
        ("chekcer", {}, "mesostructure"),
        ("checker", {"cells": 3}, "cells"),
        ("checker", {"cells": 0}, "cells"),
        ("checker", {"amplitude": -0.1}, "amplitude"),
        ("checker", {"amplitude": float("nan")}, "amplitude"),
        ("checker", {"smoothness": 0}, "smoothness"),
        ("checker", {"resolution": 30, "cells": 4}, "resolution"),
        ("checker", {"low_colour": (0.1, 0.2)}, "low_colour"),
        ("checker", {"raised_roughness": 2}, "raised_roughness"),
        ("checker", {"colour": 1}, "colour"),
        ("flat", {"reflectance": 1.5}, "reflectance"),
        ("flat", {"reflectance": (0.1, 0.2)}, "reflectance"),
        ("rings", {"count": 0}, "count"),
        ("rings", {"count": 2.5}, "count"),
        ("rings", {"count": 5, "thickness": 0.1}, "thickness"),
        ("rings", {"gap": 0}, "gap"),
        ("rings", {"segments": 30}, "segments"),
        ("rings", {"material": 3}, "material"),
        ("rings", {"base_colour": (0.1, 0.2)}, "base_colour"),
        ("tissue", {"count": 3}, "count"),
        ("tissue", {"amplitude": 0.03}, "amplitude"),
        ("tissue", {"width": 0.95}, "amplitude"),
        ("tissue", {"segments": 90}, "segments"),
        ("tissue", {"roughness": 2}, "roughness"),
        ("tissue", {"weft_colour": (0.1, 2, 0)}, "weft_colour"),
    ],
)
def test_bad_parameters_are_named(name, parameters, field):
    with pytest.raises(InputError) as error:
        build(name, **parameters)
    assert error.value.field == field
    assert "\n" not in str(error.value)


def test_names_list_the_registry():
    assert set(MESOSTRUCTURES) <= set(names())


def test_a_part_off_the_plane_is_refused():
    triangle = np.array([[0.0, 0, -1], [1, 0, -1], [0, 1, -1]])
    part = Part(triangle, [[0, 1, 2]], {"type": "diffuse"})
    with pytest.raises(InputError, match="sampling plane"):
        Mesostructure("low", {}, (part,))
    with pytest.raises(InputError, match="faces"):
        Part(triangle, [[0, 1, 3]], {"type": "diffuse"})


def test_overhang_is_measured():
    triangle = np.array([[-0.25, 0, 0], [1, 0, -1], [0, 1.5, -1]])
    assert Mesostructure("over", {}, (Part(triangle, [[0, 1, 2]], {"type": "diffuse"}),)).overhang == 0.5
