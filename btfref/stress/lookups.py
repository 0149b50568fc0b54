"""Lookups that are hard to evaluate, in blocks that a seed and a number reproduce."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import DTypeLike

from btfref.numerics.sphere import interpolation
from btfref.representations.protocol import max_lod

if TYPE_CHECKING:
    from btfref.representations.protocol import Representation

#: Lookups of a block.
BLOCK = 4096

#: Ways to draw a direction; "not a direction" must give exactly 0.
DIRECTIONS = (
    "anywhere",
    "grazing",
    "pole",
    "sample",
    "between samples",
    "edge",
    "seam",
    "ring",
    "unnormalised",
    "denormal",
    "not a direction",
)

#: Ways to draw texture coordinates.
COORDINATES = ("anywhere", "negative", "far", "centre", "border", "wrap", "denormal", "not finite")

#: How a lookup's light relates to its view.
RELATIONS = ("apart", "equal", "mirrored")

_TINY = float(np.finfo(np.float32).smallest_subnormal)


@dataclass(frozen=True)
class Lookups:
    """Lookups in float32, and how each was drawn.

    Attributes
    ----------
    uv, w_light, w_view : ndarray of float32, shape (n, 2), (n, 3), (n, 3)
    lod : ndarray of float32, shape (n,)
    light, view, coordinate, relation : ndarray of uint8, shape (n,)
        Indices into ``DIRECTIONS``, ``DIRECTIONS``, ``COORDINATES``, ``RELATIONS``.
    """

    uv: np.ndarray
    w_light: np.ndarray
    w_view: np.ndarray
    lod: np.ndarray
    light: np.ndarray
    view: np.ndarray
    coordinate: np.ndarray
    relation: np.ndarray

    def __len__(self) -> int:
        return len(self.uv)

    def __getitem__(self, index: np.ndarray) -> Lookups:
        return Lookups(*(getattr(self, name)[index] for name in self.__dataclass_fields__))

    @property
    def points(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Arguments of ``evaluate`` without the level of detail."""
        return self.uv, self.w_light, self.w_view

    def where(self, i: int) -> str:
        """How lookup ``i`` was drawn, for people."""
        text = f"light: {DIRECTIONS[self.light[i]]}; view: {DIRECTIONS[self.view[i]]}"
        if self.relation[i]:
            text = f"directions: {RELATIONS[self.relation[i]]}, {DIRECTIONS[self.view[i]]}"
        return f"{text}; uv: {COORDINATES[self.coordinate[i]]}"


@dataclass(frozen=True)
class Mix:
    """What lookups are drawn from.

    Attributes
    ----------
    directions, coordinates : tuple of str
        Of ``DIRECTIONS`` and ``COORDINATES``, each as often as the others.
    plain : float
        Share that is drawn "anywhere" beside that.
    related : float
        Share of lookups whose directions depend on each other.
    broken : bool
        Whether levels of detail may be anything that a float can be; else they are those that there are.
    """

    directions: tuple[str, ...] = DIRECTIONS
    coordinates: tuple[str, ...] = COORDINATES
    plain: float = 0.0
    related: float = 1 / 3
    broken: bool = True


#: All that a port must survive.
EVERYTHING = Mix()

#: What a renderer asks for, the hard places among it: here a port meets the gates without excuse.
USUAL = Mix(
    ("anywhere", "grazing", "pole", "sample", "between samples", "edge", "seam", "ring"),
    ("anywhere", "negative", "centre", "border", "wrap"),
    plain=0.2,
    related=0.0,
    broken=False,
)


def block(representation: Representation, seed: int, number: int, n: int = BLOCK) -> Lookups:
    """Lookups of block ``number`` for a representation: its own directions, rings, edges and texels.

    Parameters
    ----------
    representation : Representation
    seed, number, n : int
        The same give the same lookups; fewer are not the first ones of more.

    Returns
    -------
    Lookups
    """
    return hard_lookups(np.random.default_rng([seed, number]), representation, n)


def hard_lookups(
    rng: np.random.Generator, representation: Representation, n: int, mix: Mix = EVERYTHING
) -> Lookups:
    """Random lookups at the hard places of a representation.

    Parameters
    ----------
    rng : numpy.random.Generator
    representation : Representation
    n : int
    mix : Mix

    Returns
    -------
    Lookups
    """
    arrays = representation.arrays()
    drawn, kinds = {}, {}
    for prefix in ("light", "view"):
        kinds[prefix] = _kinds(rng, mix.directions, DIRECTIONS, n, mix.plain)
        drawn[prefix] = _directions(rng, kinds[prefix], arrays, prefix)
    relation = np.where(rng.random(n) < mix.related, rng.integers(1, len(RELATIONS), n), 0).astype(np.uint8)
    related = relation > 0
    sign = np.where(relation == RELATIONS.index("mirrored"), -1, 1)[:, None] * [1, 1, 0] + [0, 0, 1]
    sign = np.where(relation[:, None] == RELATIONS.index("equal"), 1, sign)
    with np.errstate(invalid="ignore"):
        drawn["light"] = np.where(related[:, None], drawn["view"] * sign.astype(np.float32), drawn["light"])
    coordinate = _kinds(rng, mix.coordinates, COORDINATES, n, mix.plain)
    uv = _coordinates(rng, coordinate, representation.meta["texels"])
    lod = _levels(rng, n) if mix.broken else rng.uniform(0, max_lod(representation), n)
    return Lookups(
        uv=uv,
        w_light=drawn["light"],
        w_view=drawn["view"],
        lod=lod.astype(np.float32),
        **kinds,
        coordinate=coordinate,
        relation=relation,
    )


def _kinds(
    rng: np.random.Generator, chosen: tuple[str, ...], names: tuple[str, ...], n: int, plain: float
) -> np.ndarray:
    """Indices into ``names``, of the chosen ones alone, shape (n,)."""
    index = np.array([names.index(name) for name in chosen])
    kinds = index[rng.integers(0, len(chosen), n)]
    if plain:
        kinds = np.where(rng.random(n) < plain, names.index("anywhere"), kinds)
    return kinds.astype(np.uint8)


def _levels(rng: np.random.Generator, n: int) -> np.ndarray:
    """Levels of detail: the finest, others, levels that there are not, and what is no number; shape (n,)."""
    lod = np.where(rng.random(n) < 0.5, 0, rng.uniform(-1, 6, n))
    odd = rng.random(n) < 0.1
    return np.where(odd, rng.choice([-1e30, 1e30, np.inf, -np.inf, np.nan, 3.0, _TINY], n), lod)


def _directions(
    rng: np.random.Generator, kind: np.ndarray, arrays: Mapping[str, np.ndarray], prefix: str
) -> np.ndarray:
    """Directions of the kinds of ``DIRECTIONS``, rounded to float32."""
    n = len(kind)
    w = hemisphere(rng, n, float)
    samples = arrays[f"{prefix}_directions"].astype(float)
    some = rng.integers(0, len(samples), (2, n))

    def of(name: str) -> np.ndarray:
        return kind == DIRECTIONS.index(name)

    # Down to 1e-8 of a radian above the horizon, and as near to the pole.
    k = of("grazing")
    w[k, 2] = 10 ** rng.uniform(-8, -1, k.sum())
    k = of("pole")
    w[k] = np.concatenate(
        [unit(w[k, :2]) * 10 ** rng.uniform(-9, -2, (k.sum(), 1)), np.ones((k.sum(), 1))], 1
    )
    w[k, :2] *= rng.integers(0, 2, (k.sum(), 1))
    k = of("sample")
    w[k] = samples[some[0, k]]
    k = of("between samples")
    w[k] = samples[some[0, k]] + samples[some[1, k]] + 1e-3 * samples[some[0, k]]
    k = of("edge")
    w[k] = _on_edges(rng, k.sum(), arrays, prefix)
    k = of("seam")
    w[k, 1] = rng.choice([0.0, -0.0, 1e-9, -1e-9, _TINY, -_TINY], k.sum())
    k = of("ring")
    theta = np.arccos(np.clip(samples[some[0, k], 2], -1, 1))
    phi = rng.uniform(0, 2 * np.pi, k.sum())
    w[k] = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    w = np.maximum(unit(w), [-1, -1, 1e-9]).astype(np.float32)
    k = of("unnormalised")
    w[k] = np.nextafter(w[k], rng.choice([-2, 2], (k.sum(), 3)).astype(np.float32))
    w[k, 2] = np.maximum(w[k, 2], 1e-9)
    k = of("denormal")
    component = rng.integers(0, 2, k.sum())
    w[np.flatnonzero(k), component] = rng.choice([_TINY, -_TINY, 1e-39, -1e-39], k.sum())
    low = k & (rng.random(n) < 0.3)
    w[low, 2] = 1e-39
    w[k] = unit(w[k].astype(float))
    k = of("not a direction")
    w[k] = _NOT_DIRECTIONS[rng.integers(0, len(_NOT_DIRECTIONS), k.sum())]
    return w


_NOT_DIRECTIONS = np.array(
    [
        (np.nan, 0, 1),
        (0, np.nan, 1),
        (0, 0, np.nan),
        (np.nan,) * 3,
        (np.inf, 0, 1),
        (0, -np.inf, 1),
        (0, 0, np.inf),
        (0, 0, -np.inf),
        (np.inf, np.nan, -np.inf),
        (0, 0, 0),
        (0, 0, -1),
        (0.6, 0, -0.8),
        (1, 0, 0),
        (1, 0, -0.0),
        (0, 0, 2.5),
        (0, 0, 1e30),
        (0, 0, 1e-20),
        (0, 0, 0.3),
        (1, 0, -1e-9),
    ],
    np.float32,
)


#: See `_on_edges`.
PER_CAP = 4


def _on_edges(rng: np.random.Generator, n: int, arrays: Mapping[str, np.ndarray], prefix: str) -> np.ndarray:
    """Directions on borders between cells of the interpolation: edges of triangles, or azimuths of ring samples.

    Of rings without a pole, one in `PER_CAP` lies anywhere inside the first, where chords of all directions are cut.
    """
    table = interpolation.whole(interpolation.from_arrays(arrays, prefix))
    if isinstance(table, interpolation.TriangleInterpolation):
        triangle = np.asarray(table.triangles, float)[rng.integers(0, len(table.triangles), n)]
        t = rng.random((n, 1))
        return unit((1 - t) * triangle[:, 0:3] + t * triangle[:, 3:6])
    ring = np.asarray(table.rings, float)[rng.integers(0, len(table.rings), n)]
    theta = rng.uniform(0, np.pi / 2 - 1e-6, n)
    phi = ring[:, 1] + rng.integers(0, 64, n) * 2 * np.pi / ring[:, 2]
    if table.rings[0, 0] > 0:
        theta[::PER_CAP] = rng.uniform(0, table.rings[0, 0], len(theta[::PER_CAP]))
        phi[::PER_CAP] += rng.uniform(0, 2 * np.pi, len(theta[::PER_CAP]))
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)


def _coordinates(rng: np.random.Generator, kind: np.ndarray, shape: Sequence[int]) -> np.ndarray:
    n, size = len(kind), np.array(shape[::-1], float)
    uv = rng.uniform(0, 1, (n, 2))
    texel = np.floor(uv * size)
    cases = {
        "negative": -rng.uniform(0, 3, (n, 2)),
        "far": rng.choice([-1, 1], (n, 2)) * 10 ** rng.uniform(3, 6, (n, 2)),
        "centre": (texel + 0.5) / size,
        "border": texel / size,
        "wrap": np.round(uv) + rng.choice([0.0, -1e-8, 1e-8, -0.0], (n, 2)),
        "denormal": rng.choice([_TINY, -_TINY, 1e-39, -1e-39], (n, 2)),
        "not finite": rng.choice([np.nan, np.inf, -np.inf, 3e38, -3e38, 0.3], (n, 2)),
    }
    for name, values in cases.items():
        k = kind == COORDINATES.index(name)
        uv[k] = values[k]
    return uv.astype(np.float32)


def hemisphere(rng: np.random.Generator, n: int, dtype: DTypeLike = np.float32) -> np.ndarray:
    """Uniform directions on the upper hemisphere, rounded to ``dtype``, shape (n, 3)."""
    w = rng.normal(size=(n, 3))
    w[:, 2] = np.abs(w[:, 2])
    return unit(w).astype(dtype)


def unit(w: np.ndarray) -> np.ndarray:
    """Rows of length 1; zero rows stay."""
    length = np.linalg.norm(w, axis=-1, keepdims=True)
    return w / np.where(length > 0, length, 1)
