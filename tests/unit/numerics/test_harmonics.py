"""Spherical harmonics: orthonormal, rotated stably, projected from direction sets and pictures."""

import numpy as np
import pytest

from btfref.errors import InputError
from btfref.gates.tolerances import tolerance
from btfref.numerics.sphere import harmonics
from btfref.numerics.sphere.directions import directions
from btfref.numerics.sphere.quadrature import gauss_hemisphere

EXACT = tolerance("harmonics.exact")


def rotations(rng, n, *, mirrored=False):
    r = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
    r[:, :, 2] *= np.linalg.det(r)[:, None] * (-1 if mirrored else 1)
    return r


@pytest.mark.parametrize("order", [1, 2, 5, 10, 16])
def test_orthonormal(order):
    w, weight = harmonics.sphere_rule(order)
    y = harmonics.values(w, order)
    np.testing.assert_allclose(y.T @ (y * weight[:, None]), np.eye(order**2), atol=EXACT)


def test_known_values(rng):
    """The first bands as polynomials."""
    w = rotations(rng, 20)[:, 0]
    x, y, z = w.T
    a, b = np.sqrt(3 / (4 * np.pi)), np.sqrt(15 / (4 * np.pi))
    expected = [np.full_like(x, np.sqrt(1 / (4 * np.pi))), a * y, a * z, a * x, b * x * y, b * y * z]
    expected += [np.sqrt(5 / (16 * np.pi)) * (3 * z * z - 1), b * x * z, b / 2 * (x * x - y * y)]
    np.testing.assert_allclose(harmonics.values(w, 3), np.stack(expected, -1), atol=EXACT)


def test_against_scipy(rng):
    from scipy.special import sph_harm_y

    w = rotations(rng, 30)[:, 0]
    theta, phi = np.arccos(w[:, 2]), np.arctan2(w[:, 1], w[:, 0])
    found = harmonics.values(w, 11)
    for band in range(11):
        for m in range(-band, band + 1):
            complex_value = (-1) ** abs(m) * sph_harm_y(band, abs(m), theta, phi)
            part = complex_value.real if m >= 0 else complex_value.imag
            expected = part * (np.sqrt(2) if m else 1)
            np.testing.assert_allclose(found[:, band * (band + 1) + m], expected, atol=EXACT)


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("order", [3, 10, 16])
def test_rotations_are_exact_and_orthogonal(rng, order, mirrored):
    r = rotations(rng, 40, mirrored=mirrored)
    m = harmonics.rotation_matrix(r, order)
    np.testing.assert_allclose(m @ m.swapaxes(1, 2), np.broadcast_to(np.eye(order**2), m.shape), atol=EXACT)
    w, a = rotations(rng, 40)[:, 0], rng.normal(size=(order**2, 3))
    there = harmonics.values(np.einsum("nij,nj->ni", r, w), order) @ a
    here = np.einsum("nk,nkc->nc", harmonics.values(w, order), harmonics.rotate(a, r, order))
    np.testing.assert_allclose(here, there, atol=order**2 * EXACT)


def test_rotations_about_the_axis_and_close_to_it(rng):
    """Where Euler angles are not unique."""
    order, a = 10, rng.normal(size=100)
    w = rotations(rng, 1)[0, 0]
    for tilt in (0.0, 1e-300, 1e-17, 1e-12, 1e-6, np.pi, np.pi - 1e-12):
        c, s = np.cos(tilt), np.sin(tilt)
        turn = np.array([[np.cos(0.7), -np.sin(0.7), 0], [np.sin(0.7), np.cos(0.7), 0], [0, 0, 1]])
        r = turn @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        there = harmonics.values(r @ w, order) @ a
        here = harmonics.values(w, order) @ harmonics.rotate(a, r, order)
        np.testing.assert_allclose(here, there, atol=order**2 * EXACT)


def test_composition(rng):
    """L(R S w) is first R, then S."""
    r, s = rotations(rng, 2)
    product = harmonics.rotation_matrix(s, 6) @ harmonics.rotation_matrix(r, 6)
    np.testing.assert_allclose(harmonics.rotation_matrix(r @ s, 6), product, atol=EXACT)


def test_projection_of_a_direction_set():
    """The clamped cosine over the measured hemisphere: π, 2π/3 and π/4 over the norms of the first bands."""
    lights = directions("ubo81")
    found = harmonics.project(lights.vectors[:, 2], lights.vectors, lights.quadrature_weights, 2)
    dense = harmonics.project(gauss_hemisphere(64, 128)[0][:, 2], *gauss_hemisphere(64, 128), 3)
    known = np.zeros(9)
    known[[0, 2]] = np.sqrt(np.pi / 4), np.sqrt(np.pi / 3)
    known[6] = np.sqrt(5 * np.pi / 64)
    np.testing.assert_allclose(dense, known, atol=EXACT)
    np.testing.assert_allclose(found, known[:4], atol=tolerance("harmonics.directions"))


def test_windows_and_ringing():
    order = 8
    delta = harmonics.values([0.0, 0.0, 1.0], order)
    plain = harmonics.ringing(delta, order)
    for name in ("hanning", "lanczos"):
        factor = harmonics.window(name, order)
        assert factor[0] == 1
        assert (np.diff(factor) <= 0).all()
        assert harmonics.ringing(factor * delta, order) < tolerance("harmonics.window.ringing") * plain
    assert (harmonics.window(None, order) == 1).all()
    assert harmonics.ringing([1.0], 1) == 0
    with pytest.raises(InputError, match="window"):
        harmonics.window("boxcar", 3)
    with pytest.raises(InputError, match="order"):
        harmonics.values([0, 0, 1], 0)
