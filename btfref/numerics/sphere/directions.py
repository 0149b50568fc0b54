"""Sets of directions on the upper hemisphere: the measured ones, regular grids and arbitrary ones."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from btfref.errors import DIRECTIONS, InputError, refuse_above
from btfref.numerics.sphere import interpolation
from btfref.numerics.sphere.quadrature import hemisphere_weights
from btfref.types import PathLike

#: Rings of the named sets: polar angle (degrees), number of samples, azimuth of the first sample (degrees).
#: "ubo81": UBO2003, ATRIUM and UTIA; "ubo151": UBO2014, Dome 1.
NAMED_RINGS: dict[str, tuple[tuple[float, int, float], ...]] = {
    "ubo81": ((0, 1, 0), (15, 6, 0), (30, 12, 0), (45, 18, 0), (60, 20, 0), (75, 24, 0)),
    "ubo151": (
        (0, 1, 0),
        (11, 6, 15),
        (23.5, 12, 0),
        (30, 12, 15),
        (37.5, 12, 0),
        (45, 18, 0),
        (52.5, 18, 7.5),
        (60, 24, 0),
        (67.5, 24, 7.5),
        (75, 24, 0),
    ),
}

#: Angular tolerance (radians) within which an arbitrary set is recognised as rings: above float32's rounding of a
#: direction, far below any spacing.
RING_TOLERANCE = 2e-6


@dataclass(frozen=True, eq=False)
class DirectionSet:
    """Directions of a sampled BTF; `DirectionSet.of` makes and checks one.

    Parameters
    ----------
    vectors : ndarray, shape (n, 3)
        Unit vectors with z ≥ 0, float64.
    name : str
        The specification that made it, or "custom".
    """

    vectors: np.ndarray
    name: str = "custom"

    @classmethod
    def of(cls, spec: DirectionSet | str | ArrayLike) -> DirectionSet:
        """A set by its name ("ubo81", "10x5", …) or of vectors: see :func:`directions`."""
        return directions(spec)

    def __len__(self) -> int:
        return len(self.vectors)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, DirectionSet) and np.array_equal(self.vectors, other.vectors)

    def __repr__(self) -> str:
        return f"<DirectionSet {self.name}: {len(self)} directions>"

    @property
    def facts(self) -> dict[str, int | str]:
        """``name`` and ``count``, as files keep them."""
        return {"name": self.name, "count": len(self)}

    @property
    def theta(self) -> np.ndarray:
        """Polar angles in radians, shape (n,)."""
        x, y, z = self.vectors.T
        return np.arctan2(np.hypot(x, y), z)

    @property
    def phi(self) -> np.ndarray:
        """Azimuths in radians in [0, 2π), shape (n,)."""
        return np.mod(np.arctan2(self.vectors[:, 1], self.vectors[:, 0]), 2 * np.pi)

    @cached_property
    def rings(self) -> np.ndarray | None:
        """Rings as (n_rings, 4) (see :class:`~btfref.numerics.sphere.interpolation.RingInterpolation`), or None."""
        return _find_rings(self.theta, self.phi)

    @cached_property
    def interpolation(self) -> interpolation.RingInterpolation | interpolation.TriangleInterpolation:
        """The interpolation over this set: on rings where it has them, else on triangles."""
        if self.rings is not None:
            return interpolation.RingInterpolation(self.rings)
        return interpolation.triangulate(self.vectors)

    def stencil(self, w: ArrayLike, *, hold: bool = True) -> tuple[np.ndarray, np.ndarray]:
        """Neighbouring samples and weights of ``w``; see :meth:`RingInterpolation.stencil`."""
        return self.interpolation.stencil(w, hold=hold)

    @cached_property
    def quadrature_weights(self) -> np.ndarray:
        """Solid-angle weights over the hemisphere in sr, shape (n,), positive, sum 2π."""
        return hemisphere_weights(self.vectors, self.interpolation.stencil)


def ring_directions(rings: Sequence[tuple[float, int, float]]) -> np.ndarray:
    """Unit vectors of ``(polar angle, count, first azimuth)`` rings in degrees, shape (n, 3)."""
    theta = np.concatenate([np.full(count, angle, float) for angle, count, _ in rings])
    phi = np.concatenate([first + np.arange(count) * (360 / count) for _, count, first in rings])
    return spherical(np.radians(theta), np.radians(phi))


def spherical(theta: ArrayLike, phi: ArrayLike) -> np.ndarray:
    """Unit vectors of polar angle and azimuth in radians, shape (...) -> (..., 3)."""
    theta, phi = np.broadcast_arrays(theta, phi)
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)


def directions(spec: str | DirectionSet | ArrayLike) -> DirectionSet:
    """A set of directions from its name, or from vectors.

    Parameters
    ----------
    spec : str, DirectionSet or array_like
        "ubo81", "ubo151", a regular grid "n_θ x n_φ" such as "10x5" (cell-centred: θ = (i + ½)·90°/n_θ,
        φ = j·360°/n_φ, φ fastest), a set, or an (n, 3) array of vectors, which are normalised.

    Returns
    -------
    DirectionSet

    Raises
    ------
    InputError
        For an unknown name, vectors that are not finite, lie below the horizon, or occur twice.
    """
    if isinstance(spec, DirectionSet):
        return spec
    if isinstance(spec, str):
        if spec in NAMED_RINGS:
            return DirectionSet(ring_directions(NAMED_RINGS[spec]), spec)
        grid = re.fullmatch(r"([1-9]\d{0,3})x([1-9]\d{0,3})", spec)
        if grid is None:
            raise InputError(
                "unknown set of directions",
                got=repr(spec[:40]),
                expected=f"{', '.join(NAMED_RINGS)} or a grid such as 10x5",
            )
        n_theta, n_phi = map(int, grid.groups())
        refuse_above(DIRECTIONS, n_theta * n_phi, "directions")
        rings = [((i + 0.5) * 90 / n_theta, n_phi, 0) for i in range(n_theta)]
        return checked(ring_directions(rings), spec)
    return checked(np.asarray(spec, float), "custom")


def checked(vectors: np.ndarray, name: str, *, file: PathLike | None = None) -> DirectionSet:
    """A :class:`DirectionSet` of ``vectors`` after the checks that :func:`directions` documents."""
    if vectors.ndim != 2 or vectors.shape[1] != 3 or len(vectors) == 0:
        raise InputError(
            "directions have the wrong shape", file=file, got=vectors.shape, expected="(n, 3) with n ≥ 1"
        )
    refuse_above(DIRECTIONS, len(vectors), "directions")
    if not np.isfinite(vectors).all():
        raise InputError("directions hold a value that is not finite", file=file)
    length = np.linalg.norm(vectors, axis=1)
    if (length < 1e-6).any():
        raise InputError("directions hold a zero vector", file=file)
    # Already unit vectors are kept bit for bit, so that a stored set reads back as the same set.
    unit = np.abs(length - 1) < 1e-12
    vectors = np.where(unit[:, None], vectors, vectors / length[:, None])
    if (vectors[:, 2] < -1e-9).any():
        raise InputError(
            "a direction lies below the horizon",
            file=file,
            got=f"z = {vectors[:, 2].min():.3g}",
            expected="z ≥ 0",
        )
    if len(np.unique(np.round(vectors, 9), axis=0)) < len(vectors):
        raise InputError("directions occur twice", file=file)
    result = DirectionSet(vectors, name)
    if result.rings is None and (len(vectors) < 3 or np.linalg.matrix_rank(vectors, tol=1e-6) < 3):
        raise InputError(
            "directions cannot be interpolated",
            file=file,
            got=f"{len(vectors)} on one great circle",
            expected="the pole alone, rings around it, or at least three that span space",
        )
    return result


def _find_rings(theta: np.ndarray, phi: np.ndarray) -> np.ndarray | None:
    """Ring table of rings of equal steps in index order, or None.

    The first is the pole, or every ring has three samples at least: otherwise any directions sorted by polar angle
    would be rings.
    """
    starts = np.flatnonzero(np.concatenate([[True], np.abs(np.diff(theta)) > RING_TOLERANCE]))
    counts = np.diff(np.append(starts, len(theta)))
    polar = np.array([theta[s : s + c].mean() for s, c in zip(starts, counts, strict=True)])
    at_pole = theta[0] <= RING_TOLERANCE
    if (counts[0] != 1 if at_pole else counts.min() < 3) or (np.diff(polar) <= 0).any():
        return None
    ring = np.repeat(np.arange(len(starts)), counts)
    expected = phi[starts][ring] + (np.arange(len(theta)) - starts[ring]) * (2 * np.pi / counts[ring])
    deviation = np.abs(np.mod(phi - expected + np.pi, 2 * np.pi) - np.pi)
    if (deviation * np.sin(theta) > RING_TOLERANCE).any():
        return None
    first_phi = np.where((np.arange(len(starts)) == 0) & at_pole, 0.0, phi[starts])
    return np.stack([np.where(polar < RING_TOLERANCE, 0, polar), first_phi, counts, starts], 1)
