"""All modelled mesostructures: closed over the seam, turned the right way, nothing meets anything."""

import dataclasses
import functools

import numpy as np
import pytest

from btfref.errors import InputError
from btfref.mesostructure import FROM_FILES, MESOSTRUCTURES, Mesostructure, build
from btfref.mesostructure.bodies import mail
from btfref.mesostructure.bodies.scattering import disjoint_radii, distances, scattered
from btfref.mesostructure.cloth import knit, weave
from btfref.mesostructure.relief.surface import random_waves
from btfref.mesostructure.solids import bodies, meetings, open_edges

MODELLED = sorted(set(MESOSTRUCTURES) - set(FROM_FILES) - {"flat"})

#: Bodies of the tile where it is not one field.
BODIES = {
    "blisters": 12,
    "flakes": 40,
    "knit": 5,
    "mail": 27,
    "pebbles": 22,
    "pile": 240,
    "rings": 3,
    "satin": 10,
    "specks": 78,
    "tissue": 8,
    "twill": 8,
}


@functools.cache
def built(name):
    """Each once, at most as fine as the check needs."""
    fine = {
        "brushed": {"resolution": 64},
        "hammered": {"resolution": 64},
        "leather": {"resolution": 64},
        "plaster": {"resolution": 64},
        "mail": {"segments": 32, "sides": 12},
        "satin": {"count": 5},
        "twill": {"count": 4},
        "tissue": {"segments": 48},
        "knit": {"segments": 32, "sides": 12},
    }
    return build(name, **fine.get(name, {}))


@pytest.mark.parametrize("name", MODELLED)
def test_surfaces_close_over_the_seam_and_no_bodies_meet(name):
    tile = built(name)
    assert open_edges(tile) == 0
    assert meetings(tile) == 0
    assert bodies(tile).max() + 1 == BODIES.get(name, 1)


def _changed(tile, index, **changes):
    parts = list(tile.parts)
    parts[index] = dataclasses.replace(parts[index], **changes)
    return Mesostructure(tile.name, tile.parameters, tuple(parts))


def test_faults_of_geometry_are_found():
    """Rationale: a check that finds nothing says nothing. Expected: a hole, a yarn that is moved into others, and a
    surface that is turned inside out are each seen.
    """
    tile = build("twill", count=4)
    warp = tile.parts[0]
    assert open_edges(_changed(tile, 0, faces=warp.faces[1:])) == 3
    moved = warp.vertices - [0, 0, 0.5 * tile.parameters["thickness"]]
    assert meetings(_changed(tile, 0, vertices=moved)) > 0
    assert meetings(_changed(tile, 0, faces=warp.faces[:, ::-1])) > 0
    plane = tile.parts[-1]
    raised = plane.vertices - [0, 0, 0.9 * plane.vertices[0, 2]]
    low = _changed(tile, 2, vertices=raised)
    # What lies above the lowest thing is no ground any more: an open surface.
    assert open_edges(low) + meetings(low) > 0


@pytest.mark.long
@pytest.mark.parametrize("name", MODELLED)
def test_surfaces_close_as_they_are_by_default(name):
    tile = build(name)
    assert open_edges(tile) == 0
    assert meetings(tile) == 0


@pytest.mark.parametrize("name", MODELLED)
def test_shading_normals_agree_with_the_facets(name):
    for part in built(name).parts:
        if part.normals is None:
            continue
        a, b, c = (part.vertices[part.faces[:, k]] for k in range(3))
        facet = np.cross(b - a, c - a)
        assert (np.linalg.norm(facet, axis=1) > 0).all()
        mean = part.normals[part.faces].sum(1)
        assert (np.einsum("fx,fx->f", facet, mean) > 0).all()


@pytest.mark.parametrize(
    ("name", "parameters", "field"),
    [
        ("brushed", {"material": 1}, "material"),
        ("brushed", {"along": 0}, "along"),
        ("blisters", {"transmission": 3}, "transmission"),
        ("blisters", {"count": 1}, "count"),
        ("flakes", {"radius": 0.3}, "radius"),
        ("flakes", {"tilt": 90}, "tilt"),
        ("hammered", {"resolution": 4096}, "resolution"),
        ("hammered", {"softness": float("nan")}, "softness"),
        ("knit", {"thickness": 0.3}, "thickness"),
        ("knit", {"columns": 1.5}, "columns"),
        ("leather", {"albedo": (2, 0, 0)}, "albedo"),
        ("mail", {"wire": 0.2}, "wire"),
        ("mail", {"standing": 0.1}, "standing"),
        ("pebbles", {"flatness": 1}, "flatness"),
        ("pile", {"thickness": 0.1}, "thickness"),
        ("pile", {"transmission": 3}, "transmission"),
        ("plaster", {"lowest": 30}, "highest"),
        ("satin", {"count": 8}, "count"),
        ("specks", {"metal": None}, "metal"),
        ("twill", {"count": 6}, "count"),
        ("twill", {"amplitude": 0.01}, "amplitude"),
    ],
)
def test_bad_parameters_are_named(name, parameters, field):
    with pytest.raises(InputError) as error:
        build(name, **parameters)
    assert error.value.field == field


def test_yarns_of_a_weave_follow_its_pattern():
    """Rationale: a twill is one by its floats. Expected: the yarn that the pattern names is on top."""
    over = np.array([[True, True, False, False], [False, True, True, False]])
    height, slope = weave.crossing_heights(over, 0.1, 8)
    at = height[:, 4::8]
    assert np.array_equal(at > 0, over)
    assert np.array_equal(height[:, 0], height[:, -1])
    # Flat at crossings and along floats, and the derivative of the height in between.
    assert (slope[:, 4::8] == 0).all()
    rise = np.diff(height) * 32
    assert (np.abs(rise - 0.5 * (slope[:, 1:] + slope[:, :-1])) <= np.abs(slope).max() / 8).all()


def test_satin_binds_no_two_neighbours():
    tile = build("satin", count=5)
    warp = tile.parts[0].vertices.reshape(5, -1, tile.parameters["sides"], 3)
    under = warp[..., 2].mean(-1)[:, 6::12].argmin(1)
    assert sorted(under) == list(range(5))
    assert all((under[k] - under[k - 1]) % 5 in (2, 3) for k in range(5))


def test_clearances_shrink_to_nothing():
    """Rationale: what refuses yarns and rings that would meet. Expected: known distances."""
    # Lying rings of neighbouring cells are nearest to each other: 1 − 2R.
    assert abs(mail.clearance(0.45, 0.25) - (1 - 2 * 0.45)) < np.finfo(np.float32).eps
    # Without depth all courses lie in one plane and cross.
    assert knit.clearance(0.24, 0.7, 1e-9, 0.8) < knit.clearance(0.24, 0.7, 0.2, 0.8) / 10


def test_places_keep_apart_around_the_seam():
    places = scattered(np.random.default_rng(0), 40)
    apart = distances(places)
    radii = disjoint_radii(places, 0.01)
    assert (radii > 0).all()
    slack = apart - radii[:, None] - radii[None]
    slack[np.diag_indices(40)] = 1 - 2 * radii
    assert slack.min() >= 0
    moved = distances((places + 0.37) % 1)
    assert np.array_equal(apart < apart.mean(), moved < apart.mean())


def test_random_waves_are_the_same_field_on_every_grid():
    fine, coarse = (random_waves(np.random.default_rng(1), n, 2, 7, 1.0) for n in (64, 32))
    assert np.abs(fine[::2, ::2] - coarse).max() < np.finfo(np.float32).eps
    power = np.abs(np.fft.fft2(fine)) ** 2
    k = np.abs(np.fft.fftfreq(64, 1 / 64))
    size = np.hypot(k[:, None], k[None])
    within = (size >= 2) & (size <= 7)
    assert power[~within].sum() < power.sum() * np.finfo(np.float32).eps
