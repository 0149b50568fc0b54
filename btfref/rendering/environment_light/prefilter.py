"""Prefiltered environments: what a lobe, or a polynomial, of the light sees of an environment in any direction.

Sources: Meseth, Müller, Klein 2004, section 5.2; J. Kautz, M. McCool, "Approximation of Glossy Reflection with
Prefiltered Environment Maps", GI 2000; maps after W. Heidrich, H.-P. Seidel, "Realistic, Hardware-Accelerated Shading
and Lighting", SIGGRAPH 1999.

A map over the sphere is a pair of parabolic maps, the second one of the mirrored lower hemisphere. The unit disc fills
all but half a texel of the square at its sides, and texels outside of it hold the other hemisphere's directions there,
so that bilinear lookups are continuous across the seam.
"""

from __future__ import annotations

import itertools
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from btfref.numerics.powers import FLOOR
from btfref.numerics.solvers.threads import in_parallel, reproducible
from btfref.numerics.sphere.parabolic import bilinear_stencil, square_to_hemisphere, texel_centres

if TYPE_CHECKING:
    from btfref.rendering.environment_light.split_light import Cells
    from btfref.scene.environment import Environment


#: Sampled exponents: 2^(i/2), i = 0 … 12. The paper's end at 32, which smears the glow about a sun.
SLICES = 13

#: Rows of the table of what the horizon leaves of a lobe, half octaves from 1 to 4096: fits reach it at grazing views,
#: and an error here is one under constant light too.
CLIPPED = 25

#: Texels a side of a parabolic map: 3.6 degrees at the pole, where the narrowest lobe, cos⁶⁴, is 17 degrees wide.
SIZE = 64

#: Texels a side of a tile that is filtered at a time: its products with the cells stay in the cache, and one side of
#: the sphere is nothing to it.
TILE = 8

#: What is added to powers of cosines: nothing beside any that counts, but its square is no subnormal number, which
#: would be slow.
NOTHING = np.float32(1.5e-19)

#: By how much heights in float32 may be off.
ROUNDING = 1e-5

#: By how much the variances of what is left of a lobe must differ for two lobes to stand for it: less is rounding.
UNEQUAL = 1e-3

#: Values of the axis' height above the horizon, from −1 to 1, in a table of clipped lobes.
HEIGHTS = 128

#: The square of what is smaller is no normal number: such numbers are slow, and NumPy calls them underflow.
SMALLEST = 1.5e-154


def exponents(slices: int = SLICES) -> np.ndarray:
    """The sampled exponents ``2^(i/2)``, shape (slices,)."""
    return 2.0 ** (np.arange(slices) / 2)


def map_directions(size: int = SIZE) -> np.ndarray:
    """Directions of the texels of a map over the sphere, shape (2, size, size, 3)."""
    upper = square_to_hemisphere(texel_centres(size) * (size / (size - 1)))
    return np.stack([upper, upper * [1, 1, -1]])


def lobe_maps(environment: Environment | Cells, *, size: int = SIZE, slices: int = SLICES) -> np.ndarray:
    """The environment as cosine lobes see it.

    Parameters
    ----------
    environment : btfref.scene.environment.Environment
    size : int
        Texels a side.
    slices : int
        Sampled exponents.

    Returns
    -------
    ndarray of float32, shape (2 slices, size, size, 3)
        For each exponent n, upper then lower hemisphere: the mean of the radiance with the weight ``max(a · l, 0)^n``,
        so that the lobe's integral is this times ``2π / (n + 1)``. The first one times π is the irradiance of a
        surface with normal a.
    """
    w, power = environment.cells()
    lit = power.any(1)
    w, power = w[lit].T.astype(np.float32), power[lit].astype(np.float32)
    axis = map_directions(size)
    result = np.zeros((slices, 2, size, size, 3), np.float32)

    def filtered(tile: tuple[int, slice, slice]) -> None:
        some = axis[tile].reshape(-1, 3)
        seen = _in_front(some, w)
        light = power[seen]
        # Every second exponent is twice the one before: squares, and one power for each parity.
        cosine = np.maximum(some.astype(np.float32) @ w[:, seen], 0) + NOTHING
        chain = [cosine, np.exp(np.float32(np.sqrt(2)) * np.log(cosine)) + NOTHING]
        for i in range(slices):
            result[i][tile] = (chain[i % 2] @ light).reshape(result[i][tile].shape)
            if i + 2 < slices:
                np.multiply(chain[i % 2], chain[i % 2], out=chain[i % 2])
                np.add(chain[i % 2], NOTHING, out=chain[i % 2])

    with reproducible():
        in_parallel(filtered, _tiles(size))
    result *= ((exponents(slices) + 1) / (2 * np.pi))[:, None, None, None, None].astype(np.float32)
    return result.reshape(2 * slices, size, size, 3)


def _tiles(size: int) -> list[tuple[int, slice, slice]]:
    """Tiles of both maps: map, rows, columns."""
    parts = [slice(first, min(first + TILE, size)) for first in range(0, size, TILE)]
    return list(itertools.product(range(2), parts, parts))


def _in_front(directions: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Lights that are in front of any of some directions near each other, by number; a few others with them."""
    centre = directions.mean(0)
    centre /= np.linalg.norm(centre)
    beside = np.sqrt(max(1 - (directions @ centre).min() ** 2, 0))
    return np.flatnonzero(centre.astype(np.float32) @ w > -beside - ROUNDING)


def moment_maps(environment: Environment | Cells, edge: float, *, size: int = SIZE) -> np.ndarray:
    """Moments of the light over the hemisphere about any normal, as a polynomial of the light needs them.

    Lights are held at the outermost measured cosine and fade below it, about that normal: see
    :func:`btfref.representations.analytic.light_functions.held`.

    Parameters
    ----------
    environment : btfref.scene.environment.Environment
    edge : float
        Smallest measured cosine; 0 holds nothing.
    size : int

    Returns
    -------
    ndarray of float32, shape (18, size, size, 3)
        Upper and lower hemisphere of ``∫ fade m(l') L dω`` for m = x², y², z², xy, xz, yz, x, y, z of the held light l'
        in world space.
    """
    w, power = environment.cells()
    lit = power.any(1)
    w, power = w[lit], power[lit]
    x, y, z = w.T
    # What multiplies the squares, the products with the normal, and the normal's own part of a held direction.
    square = np.stack([x * x, y * y, z * z, x * y, x * z, y * z], 1)
    features = [(m[:, :, None] * power[:, None]).reshape(len(w), -1) for m in (square, w)] + [power]
    features = [f.astype(np.float32) for f in features]
    lights, normal = w.T.astype(np.float32), map_directions(size)
    result = np.zeros((9, 2, size, size, 3))
    radius = np.sqrt(max(1 - edge * edge, 0))

    def filtered(tile: tuple[int, slice, slice]) -> None:
        n = normal[tile].reshape(-1, 3)
        seen = _in_front(n, lights)
        light = [f[seen] for f in features]
        height = n.astype(np.float32) @ lights[:, seen]
        below = height < edge
        # l' = α l + β n: unchanged above the edge; there the horizontal part grows to the ring's radius.
        horizontal = np.sqrt(np.maximum(1 - height * height, 1e-12))
        a = np.where(below, radius / horizontal, 1).astype(np.float32)
        b = np.where(below, edge - a * height, 0).astype(np.float32)
        fade = np.where(below, np.maximum(height, 0) / max(edge, 1e-30), 1).astype(np.float32)
        aa, ab, bb = (
            (fade * k).astype(np.float32) @ f for k, f in zip((a * a, a * b, b * b), light, strict=True)
        )
        va, vb = (fade * a) @ light[1], (fade * b) @ light[2]
        aa, ab, va = aa.reshape(-1, 6, 3), ab.reshape(-1, 3, 3), va.reshape(-1, 3, 3)
        shape = result[0][tile].shape
        for k, (i, j) in enumerate(((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))):
            mixed = ab[:, i] * n[:, j, None] + ab[:, j] * n[:, i, None]
            result[k][tile] = (aa[:, k] + mixed + bb * (n[:, i] * n[:, j])[:, None]).reshape(shape)
        for k in range(3):
            result[6 + k][tile] = (va[:, k] + vb * n[:, k, None]).reshape(shape)

    with reproducible():
        in_parallel(filtered, _tiles(size))
    return result.reshape(18, size, size, 3).astype(np.float32)


@lru_cache(maxsize=8)
def clipped_lobes(edge: float, *, cosine: bool, slices: int = CLIPPED, heights: int = HEIGHTS) -> np.ndarray:
    """The cosine lobes that stand for lobes cut by the horizon, where lights near it fade.

    A lobe about an axis ``a`` loses what is below the surface's horizon. What is left is wider along the horizon than
    across it: two equal whole lobes stand for it, to both sides of its centroid by an angle δ. They have its integral,
    its first moment, and the difference of its two variances about the centroid. A whole lobe of exponent m has a
    centroid of length ``(m + 1) / (m + 2)`` and a variance of ``1 / (m + 3)`` across its axis, so that

        R = (m + 1) / (m + 2) · cos δ,    v₂ − v₁ = m sin² δ / (m + 3)

    give m and δ. So constant environments come out exactly, and those that are linear in the direction too.

    Parameters
    ----------
    edge : float
        Smallest measured cosine; see :func:`moment_maps`.
    cosine : bool
        Whether the lobe multiplies the light's cosine (Lafortune) or stands for itself (reflectance fields).
    slices, heights : int

    Returns
    -------
    ndarray of float32, shape (slices, heights, 4)
        By exponent and height ``a_z`` of the axis, from −1 to 1: the integral over the hemisphere, held and faded, over
        that of the lobe over the sphere; the height of the centroid's direction; the position of the new exponent,
        ``2 log2 m``, at least 0; sin δ.
    """
    # Gauss–Legendre on both sides of the edge, in the angle: the narrowest lobe is 0.9 degrees wide everywhere. Equal
    # steps in the azimuth.
    border = np.arccos(edge)
    pieces = [(0.0, border, 128), (border, np.pi / 2, 32)] if edge > 0 else [(0.0, np.pi / 2, 160)]
    angles, shares = [], []
    for low, high, count in pieces:
        nodes, weights = np.polynomial.legendre.leggauss(count)
        angles.append(low + (high - low) * (nodes + 1) / 2)
        shares.append((high - low) / 2 * weights)
    theta, weight = np.concatenate(angles), np.concatenate(shares)
    z, weight = np.cos(theta), weight * np.sin(theta)
    phi = (np.arange(256) + 0.5) * (np.pi / 256)
    held = np.maximum(z, edge)
    radius = np.sqrt(1 - held * held)
    weight = weight * np.where(z < edge, z / max(edge, 1e-30), 1) * (held if cosine else 1)
    a = np.linspace(-1, 1, heights)[:, None, None]
    product = radius[:, None] * np.sqrt(1 - a * a) * np.cos(phi) + held[:, None] * a
    # Means over the azimuth of a lobe, and of it times cos φ and sin² φ.
    means = np.stack([np.ones_like(phi), np.cos(phi), np.sin(phi) ** 2], 1) / len(phi)
    # Every second exponent is twice the one before: squares, and one power for each parity.
    product = np.where(product > FLOOR, product, 0)
    chain = [product, product ** np.sqrt(2)]
    horizontal, sine = np.sqrt(1 - a.ravel() ** 2), np.sqrt(1 - z * z)
    result = np.zeros((slices, heights, 4))
    for i, n in enumerate(exponents(slices)):
        total, along, beside = np.moveaxis(chain[i % 2] @ means, -1, 0)
        if i + 2 < slices:
            np.multiply(chain[i % 2], chain[i % 2] >= SMALLEST, out=chain[i % 2])
            np.multiply(chain[i % 2], chain[i % 2], out=chain[i % 2])
        integral = total @ weight
        up, across = total @ (weight * z), along @ (weight * sine)
        length = np.hypot(up, across)
        # A lobe that points straight down has nothing left: it takes its neighbour's centroid.
        there = np.clip(np.arange(heights), np.argmax(length * horizontal > 0), None)
        over = integral[there]
        r, height, out = length[there] / over, up[there] / length[there], across[there] / length[there]
        # Second moments: along the horizon, across and up; about the centroid, the first two by their axes.
        yy, zz, xz = (
            (f @ (weight * g))[there] / over
            for f, g in ((beside, sine**2), (total, z * z), (along, sine * z))
        )
        v1 = height**2 * (1 - yy - zz) - 2 * height * out * xz + out**2 * zz
        m, sideways = _pair(r, np.where(yy > (1 + UNEQUAL) * v1, yy - v1, 0))
        result[i] = np.stack([integral * (n + 1), height, 2 * np.log2(m), sideways], -1)
    result = result.astype(np.float32)
    result.flags.writeable = False  # remembered
    return result


def _pair(r: np.ndarray, difference: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Exponent m, from 1 on, and sin δ of two lobes with a centroid of length ``r`` and a difference of variances."""

    def sine2(m: np.ndarray) -> np.ndarray:
        return np.minimum(difference * (m + 3) / m, 1)

    # The centroid's length grows with m. Rounding takes that of narrow lobes to 1.
    low, high = np.ones_like(r), np.full_like(r, 1e9)
    for _ in range(64):
        m = np.sqrt(low * high)
        short = ((m + 1) / (m + 2)) ** 2 * (1 - sine2(m)) < r * r
        low, high = np.where(short, m, low), np.where(short, high, m)
    return low, np.sqrt(sine2(low))


def map_lookup(maps: np.ndarray, index: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Bilinear lookup in one of several maps over the sphere, as ``shaders/lib/light/sphere_maps.glsl`` does it.

    Parameters
    ----------
    maps : ndarray, shape (2 k, size, size, channels)
    index : ndarray of int, shape (...)
        Which of the k maps.
    w : ndarray, shape (..., 3)
        Directions of any length.

    Returns
    -------
    ndarray of float64, shape (..., channels)
    """
    size = maps.shape[1]
    scale = np.linalg.norm(w, axis=-1) + np.abs(w[..., 2])
    scale = (size - 1) / (size * np.where(scale > 0, scale, 1))
    at, weight = bilinear_stencil(square_to_hemisphere(w[..., :2] * scale[..., None]), size)
    flat = maps.reshape(len(maps), size * size, -1)
    half = 2 * np.asarray(index) + (w[..., 2] < 0)
    return np.einsum("...k,...kc->...c", weight, flat[half[..., None], at].astype(float))


def lobe_lookup(
    maps: np.ndarray, clipped: np.ndarray, axis: np.ndarray, to_world: np.ndarray, exponent: np.ndarray
) -> np.ndarray:
    """Integral of ``max(a · l, 0)^n`` times the environment over the hemisphere of a surface.

    Parameters
    ----------
    maps : ndarray, shape (2 slices, size, size, channels)
        See :func:`lobe_maps`.
    clipped : ndarray, shape (slices, heights, 4)
        See :func:`clipped_lobes`.
    axis : ndarray, shape (..., 3)
        Unit vectors in the surface's frame.
    to_world : ndarray, shape (..., 3, 3)
        Columns: the frame's axes in world space.
    exponent : ndarray, shape (...)
        Everything is linear in its logarithm between the sampled ones; beyond the largest, that one's mean radiance
        is taken.

    Returns
    -------
    ndarray of float64, shape (..., channels)
    """
    share, axes, position = stand_ins(clipped, axis, exponent)
    low, f = between(position, len(maps) // 2)
    f = f[..., None]
    mean = np.zeros((*np.shape(share), maps.shape[-1]))
    for one in axes:
        world = np.einsum("...ij,...j->...i", to_world, one)
        mean += ((1 - f) * map_lookup(maps, low, world) + f * map_lookup(maps, low + 1, world)) / len(axes)
    return (2 * np.pi / (exponent + 1) * share)[..., None] * mean


def stand_ins(
    clipped: np.ndarray, axis: np.ndarray, exponent: np.ndarray
) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray], np.ndarray]:
    """The two lobes that stand for one that the horizon cuts: :func:`clipped_lobes`.

    Parameters
    ----------
    clipped : ndarray, shape (slices, heights, 4)
    axis : ndarray, shape (..., 3)
        Unit vectors in the surface's frame.
    exponent : ndarray, shape (...)

    Returns
    -------
    share : ndarray, shape (...)
        What is left of the integral.
    axes : tuple of two ndarray, shape (..., 3)
        In the surface's frame.
    position : ndarray, shape (...)
        Of their exponent, among those sampled.
    """
    low, f = between(2 * np.log2(np.maximum(exponent, 1)), len(clipped))
    f, height = f[..., None], axis[..., 2]
    columns = (1 - f) * clipped_lookup(clipped, low, height) + f * clipped_lookup(clipped, low + 1, height)
    share, z, position, sideways = np.moveaxis(columns, -1, 0)
    outwards = axis[..., :2] / np.maximum(np.linalg.norm(axis[..., :2], axis=-1), FLOOR)[..., None]
    centre = np.concatenate([outwards * np.sqrt(1 - z * z)[..., None], z[..., None]], -1)
    centre *= np.sqrt(1 - sideways * sideways)[..., None]
    aside = np.stack([-outwards[..., 1], outwards[..., 0], np.zeros_like(z)], -1) * sideways[..., None]
    return share, (centre + aside, centre - aside), position


def clipped_lookup(clipped: np.ndarray, index: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Linear lookup in a row of a table of :func:`clipped_lobes`, shape (...) -> (..., 4)."""
    low, f = between((height + 1) * ((clipped.shape[1] - 1) / 2), clipped.shape[1])
    f = f[..., None]
    return (1 - f) * clipped[index, low].astype(float) + f * clipped[index, low + 1].astype(float)


def between(position: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The lower of two of ``count`` samples about a position, held at the ends, and the share of the upper one."""
    position = np.clip(position, 0, count - 1)
    low = np.minimum(position.astype(np.int64), count - 2)
    return low, position - low
