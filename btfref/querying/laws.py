"""Laws that random queries follow, each with its density, so that any estimate can be reweighted to another law.

Directions: z = cos θ, z₀ the cosine of the largest θ that is asked for, densities per steradian.

=========== ================================================== ===================================================
law         how                                                density
=========== ================================================== ===================================================
uniform     z uniform                                          1 / (2π (1 − z₀))
cosine      z² uniform                                         z / (π (1 − z₀²))
grazing     √z uniform: half of the hemisphere's lie beyond    1 / (4π √z (1 − √z₀))
            75.5°
halfdiff    √θ_h, θ_d, φ_h and φ_d uniform (as MERL's tables   1 / (2π sin θ_h √(4 θ_m θ_h)) · 1 / (θ_x sin θ_d φ_x)
            step), where both directions are above z₀          · 1 / (4 cos θ_d), of the pair
a set       one of n directions                                1 / n, a probability
=========== ================================================== ===================================================

Light and view are independent of each other, but for ``halfdiff`` (Rusinkiewicz 1998), which is a law of the pair: θ_h
is at most θ_m = arccos z₀, θ_d at most θ_x = arccos(z₀ / cos θ_h), and φ_d lies in what both horizons leave, of length
φ_x; ω_v is ω_l mirrored at h, so that dω_v = 4 cos θ_d dω_h. Radii: see :class:`RadiusLaw`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from btfref.errors import DIRECTIONS, InputError, refuse_above
from btfref.numerics.sphere.directions import directions, spherical
from btfref.numerics.sphere.halfway import in_out

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

#: Laws of one direction: exponent k such that z^k is uniform.
POWERS = {"uniform": 1.0, "cosine": 2.0, "grazing": 0.5}

#: The law of both directions together.
HALFDIFF = "halfdiff"

#: Random numbers that a row takes: two for each direction, two for the place, two for the radius.
NUMBERS = 8


def draw(seed: int, stream: int, first: int, count: int) -> np.ndarray:
    """Random numbers of rows, the same whatever the rows are asked for with.

    Parameters
    ----------
    seed, stream : int
    first, count : int
        The rows.

    Returns
    -------
    ndarray, shape (count, NUMBERS)
        In [0, 1).
    """
    key = np.random.SeedSequence([seed, stream]).generate_state(2, np.uint64)
    # A step of Philox's counter gives four numbers.
    bits = np.random.Philox(key=key).advance(first * (NUMBERS // 4))
    return np.random.Generator(bits).random((count, NUMBERS))


@dataclass(frozen=True, eq=False)
class DirectionLaw:
    """The law of lights or of views.

    Parameters
    ----------
    name : str
        A key of :data:`POWERS`, or what the set is called.
    vectors : ndarray (n, 3) or None
        Of a set.
    """

    name: str
    vectors: np.ndarray | None = None

    @classmethod
    def of(cls, spec: str | ArrayLike, field: str) -> DirectionLaw:
        """A law from its name, from the name of a set ("ubo81", "10x5"), or of vectors.

        Raises
        ------
        InputError
        """
        if not isinstance(spec, str):
            return cls("custom", _unit(spec, field))
        if spec in POWERS:
            return cls(spec)
        try:
            found = directions(spec)
        except InputError as error:
            known = (
                f"{', '.join(POWERS)}, {HALFDIFF} (of both), ubo81, ubo151, a grid such as 10x5, or a file"
            )
            raise InputError(
                "unknown law of directions", field=field, got=repr(spec[:40]), expected=known
            ) from error
        return cls(found.name, found.vectors)

    def sample(self, u: np.ndarray, least_z: float) -> tuple[np.ndarray, np.ndarray]:
        """Directions and their density.

        Parameters
        ----------
        u : ndarray, shape (n, 2)
        least_z : float
            z₀; sets ignore it.

        Returns
        -------
        w : ndarray, shape (n, 3)
        density : ndarray, shape (n,)
        """
        if self.vectors is not None:
            n = len(self.vectors)
            return self.vectors[np.minimum((u[:, 0] * n).astype(int), n - 1)], np.full(len(u), 1 / n)
        power = POWERS[self.name]
        # 1 − u is never 0: no direction lies on the horizon.
        z = (least_z**power + (1 - u[:, 0]) * (1 - least_z**power)) ** (1 / power)
        r, phi = np.sqrt(np.maximum(1 - z * z, 0)), 2 * np.pi * u[:, 1]
        return np.stack([r * np.cos(phi), r * np.sin(phi), z], -1), self.density(z, least_z)

    def density(self, z: np.ndarray, least_z: float) -> np.ndarray:
        """Density per steradian of directions of a cosine z ≥ z₀; of a set, the probability of each."""
        if self.vectors is not None:
            return np.full(np.shape(z), 1 / len(self.vectors))
        power = POWERS[self.name]
        return power * z ** (power - 1) / (2 * np.pi * (1 - least_z**power))


def _unit(spec: ArrayLike, field: str) -> np.ndarray:
    """Unit vectors above the horizon; unlike those of a sampled BTF, they need not be interpolated between."""
    try:
        vectors = np.asarray(getattr(spec, "vectors", spec), float)
    except (TypeError, ValueError):
        vectors = np.zeros(0)
    length = np.linalg.norm(vectors, axis=-1, keepdims=True) if vectors.ndim == 2 else vectors
    good = vectors.ndim == 2 and vectors.shape[1] == 3 and len(vectors) > 0 and np.isfinite(vectors).all()
    if not good or not (length > 0).all() or not (vectors[:, 2] > 0).all():
        raise InputError("cannot use directions", field=field, expected="vectors with z > 0, shape (n, 3)")
    refuse_above(DIRECTIONS, len(vectors), field)
    return vectors / length


def sample_halfdiff(u: np.ndarray, least_z: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pairs of directions that follow ``halfdiff``.

    Parameters
    ----------
    u : ndarray, shape (n, 4)
    least_z : float

    Returns
    -------
    w_light, w_view : ndarray, shape (n, 3)
    density : ndarray, shape (n,)
        Of the pair, per steradian squared.
    """
    most = np.arccos(least_z)
    theta_h = most * (1 - u[:, 0]) ** 2
    theta_d, phi_d, spread, largest = _difference(theta_h, u[:, 1], u[:, 3], least_z)
    phi_h = 2 * np.pi * u[:, 2]
    # The frame of h is the surface's own, tilted: there the way down is at the azimuth of h.
    w_light, w_view = in_out(spherical(theta_h, phi_h), spherical(theta_d, phi_d + phi_h))
    # Rounding may take a direction below the horizon by the last bit.
    for w in (w_light, w_view):
        w[:, 2] = np.maximum(w[:, 2], np.finfo(np.float32).tiny)
    half = 2 * np.pi * np.sin(theta_h) * np.sqrt(4 * most * theta_h)
    difference = largest * np.sin(theta_d) * spread
    return w_light, w_view, 1 / np.maximum(half * difference * 4 * np.cos(theta_d), 1e-300)


def _difference(
    theta_h: np.ndarray, u: np.ndarray, v: np.ndarray, least_z: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """θ_d, φ_d, the length of φ_d's range and the largest θ_d."""
    largest = np.arccos(np.minimum(least_z / np.cos(theta_h), 1.0))
    theta_d = largest * (1 - u)
    room = np.cos(theta_d) * np.cos(theta_h) - least_z
    reach = np.minimum(room / np.maximum(np.sin(theta_d) * np.sin(theta_h), 1e-300), 1.0)
    # |cos φ_d| < reach: two arcs about ±π/2, each of 2 arcsin(reach).
    arc = 2 * np.arcsin(np.maximum(reach, 1e-12))
    side = v < 0.5
    inside = np.where(side, 2 * v, 2 * v - 1)
    phi_d = np.where(side, 0.5, 1.5) * np.pi + (inside - 0.5) * arc
    return theta_d, phi_d, 2 * arc, largest


@dataclass(frozen=True)
class RadiusLaw:
    """The law of the footprints' radii, tile units.

    ======================= ============================ =====================================
    text                    how                          density
    ======================= ============================ =====================================
    ``0``                   points                       1, a probability
    ``R``                   fixed                        1, a probability
    ``levels:R:S0,S1,…``    R · 2^k with the share S_k   S_k / ΣS, a probability
    ``log:R0:R1``           log-uniform from R0 to R1    1 / (r ln(R1 / R0)), per tile unit
    ======================= ============================ =====================================

    Attributes
    ----------
    text : str
    kind : {"fixed", "levels", "log"}
    numbers : tuple of float
        The radius; the first radius and the shares; both ends.
    """

    text: str
    kind: str
    numbers: tuple[float, ...]

    @classmethod
    def of(cls, text: str | float) -> RadiusLaw:
        """A law from its text.

        Raises
        ------
        InputError
        """
        words = str(text).split(":")
        try:
            numbers = [
                float(word) for group in words[words[0] in ("levels", "log") :] for word in group.split(",")
            ]
        except ValueError:
            numbers = []
        kind = words[0] if words[0] in ("levels", "log") else "fixed"
        good = bool(numbers) and all(0 <= number < np.inf for number in numbers)
        if kind == "levels":
            good &= len(words) == 3 and len(numbers) > 1 and numbers[0] > 0 and sum(numbers[1:]) > 0
        elif kind == "log":
            good &= len(words) == 3 and len(numbers) == 2 and 0 < numbers[0] < numbers[-1]
        else:
            good &= len(words) == 1 and len(numbers) == 1
        if not good:
            raise InputError(
                "unknown law of radii",
                field="radius",
                got=repr(str(text)[:60]),
                expected="0, R, levels:R:S0,S1,… or log:R0:R1, in tiles",
            )
        return cls(str(text), kind, tuple(numbers))

    def sample(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Radii and their density, from numbers of shape (n,)."""
        first, *rest = self.numbers
        if self.kind == "fixed":
            return np.full(len(u), first), np.ones(len(u))
        if self.kind == "levels":
            shares = np.array(rest) / np.sum(rest)
            level = np.minimum(np.searchsorted(np.cumsum(shares), u, side="right"), len(shares) - 1)
            return first * 2.0**level, shares[level]
        radius = first * (rest[0] / first) ** u
        return radius, 1 / (radius * np.log(rest[0] / first))


@dataclass(frozen=True, eq=False)
class Laws:
    """All laws of a set of queries.

    Attributes
    ----------
    light, view : DirectionLaw or None
        None for ``halfdiff``.
    radius : RadiusLaw
    least_z : float
        Cosine of the largest θ.
    picture : (int, int) or None
        Rows and columns of a picture whose texels share a pair of directions, one row a texel, v down the rows; None
        for a place of its own for every row, uniform on the tile.
    lights : int
        Rows in turn that share place, radius and view, each with a light of its own: those of one path.
    """

    light: DirectionLaw | None
    view: DirectionLaw | None
    radius: RadiusLaw
    least_z: float = 0.0
    picture: tuple[int, int] | None = None
    lights: int = 1

    def rows(self, seed: int, first: int, count: int) -> dict[str, np.ndarray]:
        """What some rows ask for.

        Parameters
        ----------
        seed : int
        first, count : int
            The same rows whichever others are asked for with them.

        Returns
        -------
        dict of str to ndarray of float32
            ``uv`` (n, 2), ``radius`` (n,), ``w_light``, ``w_view`` (n, 3), ``density`` (n,), the product of all laws'.
        """
        own = draw(seed, 0, first, count)
        shared = own
        if self.lights > 1:
            group = np.arange(first, first + count) // self.lights
            start = int(group[0]) if count else 0
            shared = draw(seed, 2, start, int(group[-1]) + 1 - start if count else 0)[group - start]
        if self.picture is None:
            pair, uv, density = np.hstack([own[:, :2], shared[:, 2:]]), shared[:, 4:6], np.ones(count)
        else:
            rows, columns = self.picture
            number, texel = np.divmod(np.arange(first, first + count), rows * columns)
            start = int(number[0]) if count else 0
            pairs = draw(seed, 1, start, int(number[-1]) + 1 - start if count else 0)
            pair = pairs[number - start]
            uv = np.stack([(texel % columns + 0.5) / columns, (texel // columns + 0.5) / rows], -1)
            # A probability: texels are gone through, not drawn.
            density = np.full(count, 1 / (rows * columns))
        if self.light is None or self.view is None:
            w_light, w_view, of_pair = sample_halfdiff(pair[:, :4], self.least_z)
        else:
            w_light, of_light = self.light.sample(pair[:, :2], self.least_z)
            w_view, of_view = self.view.sample(pair[:, 2:4], self.least_z)
            of_pair = of_light * of_view
        radius, of_radius = self.radius.sample(shared[:, 6])
        # A number just below 1 would be 1 in single precision, which is another tile's 0.
        uv = np.minimum(uv.astype(np.float32), np.float32(1 - 2.0**-24))
        found = {
            "uv": uv,
            "radius": radius,
            "w_light": w_light,
            "w_view": w_view,
            "density": np.minimum(density * of_pair * of_radius, np.finfo(np.float32).max),
        }
        return {name: np.ascontiguousarray(values, np.float32) for name, values in found.items()}

    def facts(self) -> dict[str, object]:
        """The laws by name, as files keep them."""
        both = self.light is None or self.view is None
        return {
            "light": HALFDIFF if both else self.light.name,  # type: ignore[union-attr]  # both says so
            "view": HALFDIFF if both else self.view.name,  # type: ignore[union-attr]  # likewise
            "radius": self.radius.text,
            "max_theta": float(np.degrees(np.arccos(self.least_z))),
            "picture": None if self.picture is None else list(self.picture),
        }


def laws(
    light: str | ArrayLike,
    view: str | ArrayLike,
    radius: str | float,
    *,
    max_theta: float = 90.0,
    picture: Sequence[int] | None = None,
    lights: int = 1,
) -> Laws:
    """Laws from their names; see the module.

    Parameters
    ----------
    light, view : str or array_like
        A law, a set of directions or vectors. ``halfdiff`` is a law of both.
    radius : str or float
    max_theta : float
        Largest polar angle of directions that follow a law, degrees, (0, 90].
    picture : (int, int), optional
    lights : int
        Rows in turn that share place, radius and view.

    Raises
    ------
    InputError
    """
    if not 0 < max_theta <= 90:
        raise InputError(
            "largest polar angle", field="max_theta", got=max_theta, expected="degrees in (0, 90]"
        )
    names = [isinstance(spec, str) and spec == HALFDIFF for spec in (light, view)]
    if any(names) and not all(names):
        raise InputError(
            "a law of both directions", field="light, view", got=HALFDIFF, expected="it for both"
        )
    both = all(names)
    if lights > 1 and (both or picture is not None):
        raise InputError(
            "lights that share a path need a law of their own and a place for all of them",
            field="lights_per_path",
            got=lights,
            expected=f"1 with {HALFDIFF if both else 'pictures'}",
        )
    least_z = 0.0 if max_theta == 90 else float(np.cos(np.radians(max_theta)))
    return Laws(
        None if both else DirectionLaw.of(light, "light"),
        None if both else DirectionLaw.of(view, "view"),
        RadiusLaw.of(radius),
        least_z,
        None if picture is None else (int(picture[0]), int(picture[1])),
        lights,
    )
