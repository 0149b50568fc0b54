"""Directional lights that stand for an environment.

Median-cut lights (P. Debevec, "A Median Cut Algorithm for Light Probe Sampling", SIGGRAPH 2006 posters) divide energy
alike; here regions are split where power times squared extent is largest, as in K. Viriyothai, P. Debevec, "Variance
Minimization Light Probe Sampling", SIGGRAPH 2009 posters, so that a small bright source costs one light. Lloyd's
iterations then move the lights to the least sum of power times squared distance: to second order, the error of any
smooth receiver.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from btfref.conventions import LUMINANCE
from btfref.errors import InputError

if TYPE_CHECKING:
    from btfref.scene.environment import Environment


#: Estimated relative error at which the search for a number of lights ends.
TARGET = 0.01

#: Most and fewest lights that the search tries.
FEWEST, MOST = 16, 4096

#: Lloyd's iterations after splitting; further ones change the sum by less than 1 %.
LLOYD = 8

#: Regions are split in rounds: all whose sum is within this factor of the largest, which is nearly one by one.
ROUND = 4.0

#: Receivers of the error estimate, and the exponent of their lobe: cos³² is about as wide as measured lights are apart.
RECEIVERS, EXPONENT = 256, 32


#: Where a symmetric matrix has the entries of its packed upper triangle.
SYMMETRIC = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])


@dataclass(frozen=True)
class LightSet:
    """Directional lights.

    Parameters
    ----------
    w : ndarray of float64, shape (n, 3)
        Unit vectors towards the lights, world space.
    power : ndarray of float64, shape (n, 3)
        Irradiance perpendicular to ``w`` in W/m², linear Rec. 709.
    error : float or None
        Estimated relative error, see :func:`estimated_error`; None where it is not estimated.
    """

    w: np.ndarray
    power: np.ndarray
    error: float | None

    def __len__(self) -> int:
        return len(self.w)

    def table(self) -> np.ndarray:
        """For ``shaders/lib/light/environment_lights.glsl``: direction, then power; float32 (n ≥ 1, 2, 4)."""
        table = np.zeros((max(len(self), 1), 2, 4), np.float32)
        table[: len(self), 0, :3], table[: len(self), 1, :3] = self.w, self.power
        return table


def light_set(environment: Environment, *, lights: int | None = None, target: float = TARGET) -> LightSet:
    """Lights that stand for an environment.

    Parameters
    ----------
    environment : btfref.scene.environment.Environment
    lights : int, optional
        Their number; fewer where fewer cells are lit. Default: the smallest power of two, 16 to 4096, whose estimated
        error is at most ``target``.
    target : float
        Relative error.

    Returns
    -------
    LightSet

    Raises
    ------
    InputError
        For fewer than one light.
    """
    if lights is not None and lights < 1:
        raise InputError("an environment needs a light", field="lights", got=lights, expected="≥ 1")
    w, power = environment.cells()
    lit = power.any(1)
    if not lit.any():
        return LightSet(np.array([[0.0, 0.0, 1.0]]), np.zeros((1, 3)), 0.0)
    w, power = w[lit], power[lit]
    n = FEWEST if lights is None else lights
    while True:
        directions, powers = divided(w, power, n)
        error = estimated_error(directions, powers, w, power)
        # More lights than lit cells do not exist.
        if lights is not None or error <= target or n >= MOST or len(directions) >= len(w):
            return LightSet(directions, powers, error)
        n *= 2


def divided(w: np.ndarray, power: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions and powers of at most ``n`` lights that stand for the cells (w, power), some of them lit."""
    weight = power @ LUMINANCE
    # What has colour has luminance; the floor keeps cells of faint blue.
    weight = np.maximum(weight, 1e-12 * weight.max())
    label, count = np.zeros(len(w), np.int64), 1
    products = np.stack([w[:, i] * w[:, j] for i, j in zip(*np.triu_indices(3), strict=True)], 1)
    while count < n:
        mass, first = np.bincount(label, weight, count), _sums(label, weight, w, count)
        centre = first / mass[:, None]
        packed = _sums(label, weight, products, count) / mass[:, None]
        spread = packed[:, SYMMETRIC] - centre[:, :, None] * centre[:, None]
        value, axis = np.linalg.eigh(spread)
        size = np.bincount(label, minlength=count)
        badness = np.where(size > 1, mass * np.maximum(value.sum(1), 0), 0)
        split = np.argsort(-badness, kind="stable")[: n - count]
        split = split[badness[split] > max(badness.max() / ROUND, 0)]
        if not len(split):
            break
        fresh = np.full(count, -1)
        fresh[split] = count + np.arange(len(split))
        beyond = np.einsum("ni,ni->n", w - centre[label], axis[label, :, 2]) > 0
        label = np.where((fresh[label] >= 0) & beyond, fresh[label], label)
        count = int(label.max()) + 1
    return _settled(w, power, weight, label, count)


def _settled(
    w: np.ndarray, power: np.ndarray, weight: np.ndarray, label: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Lloyd's iterations from a division; lights without cells are left out."""
    from scipy.spatial import cKDTree

    for iteration in range(LLOYD + 1):
        used, label = np.unique(label, return_inverse=True)
        count = len(used)
        centre = _sums(label, weight, w, count)
        length = np.linalg.norm(centre, axis=1, keepdims=True)
        # A region that surrounds the origin evenly has no direction: any will do, its first cell's is one.
        first = np.zeros((count, 3))
        first[label[::-1]] = w[::-1]
        none = length < 1e-9 * np.bincount(label, weight, count)[:, None]
        centre = np.where(none, first, centre / np.where(none, 1, length))
        if iteration < LLOYD and count > 1:
            label = cKDTree(centre).query(w)[1]
    return centre, _sums(label, np.ones(len(w)), power, count)


def _sums(label: np.ndarray, weight: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """Weighted sums of rows by label, shape (count, k)."""
    return np.stack([np.bincount(label, weight * column, count) for column in values.T], 1)


def estimated_error(w: np.ndarray, power: np.ndarray, cell_w: np.ndarray, cell_power: np.ndarray) -> float:
    """How differently receivers see the lights and the cells that they stand for.

    Parameters
    ----------
    w, power : ndarray, shape (n, 3)
        The lights.
    cell_w, cell_power : ndarray, shape (m, 3)
        See :meth:`btfref.scene.environment.Environment.cells`.

    Returns
    -------
    float
        Relative RMSE of luminance over random receivers whose normal and gloss point anywhere: half a Lambertian
        surface and half a lobe cos³² above its horizon.
    """
    rng = np.random.default_rng(0)
    normal, axis = rng.normal(size=(2, RECEIVERS, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    axis = axis / np.linalg.norm(axis, axis=1, keepdims=True)
    axis *= np.where(np.einsum("ni,ni->n", axis, normal) < 0, -1, 1)[:, None]

    def seen(w: np.ndarray, power: np.ndarray) -> np.ndarray:
        w, luminance = w.astype(np.float32), (power @ LUMINANCE).astype(np.float32)
        cosine = np.maximum(normal.astype(np.float32) @ w.T, 0)
        lobe = np.maximum(axis.astype(np.float32) @ w.T, 0)
        for _ in range(EXPONENT.bit_length() - 1):
            np.multiply(lobe, lobe, out=lobe)
        lobe *= (EXPONENT + 1) / 2 * np.minimum(1, 8 * cosine)
        return (cosine @ luminance + lobe @ luminance).astype(float)

    with np.errstate(under="ignore"):
        truth, found = seen(cell_w, cell_power), seen(w, power)
    return float(np.sqrt(np.mean((found - truth) ** 2)) / max(truth.mean(), 1e-300))
