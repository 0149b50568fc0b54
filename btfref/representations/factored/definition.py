"""BTFs as products of parabolic maps of single directions: what ``cmf`` and ``hf`` have in common.

Source: F. Suykens, K. vom Berge, A. Lagae, P. Dutré, "Interactive Rendering with Bidirectional Texture Functions",
Eurographics 2003, sections 5 and 6: ``B(x, l, v) = S(x) P_{I.r(x)}(l) Q_{I.g(x)}(h) R_{I.b(x)}(v)``; in general
``Σ_k S_k P_k(l) R_k(v) · Σ_j T_j Q_j(h) D_j(d)``, each P, Q, R, D the map of a codebook that the texel's index names.
Maps hold [0, 1]. Differs from the paper: B holds the light's cosine, so that a host does not multiply by it; the four
texels around a lookup are evaluated and blended; maps are clustered at equal RMS and their prototypes then scaled to a
peak of 1; the scale is fitted again to the stored maps.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from btfref import conventions
from btfref.errors import InputError
from btfref.numerics.solvers.factoring import map_operators
from btfref.numerics.sphere.halfway import half_difference
from btfref.numerics.sphere.parabolic import bilinear_stencil
from btfref.precision import precision, real
from btfref.representations.file.schema import (
    CODES,
    FLOATS,
    INDICES,
    Constant,
    Edge,
    MapSchema,
    OneOf,
    Range,
    Schema,
)
from btfref.representations.guide import feature_views, group_means, spread_members, texel_groups
from btfref.representations.lookup import StoredMaps, evaluate_points

if TYPE_CHECKING:
    from collections.abc import Collection

    from numpy.typing import ArrayLike, DTypeLike

    from btfref.numerics.solvers.factoring import FactorOperators
    from btfref.types import Facts, JitArray


#: Factors in the order of the index map's channels; with one term each and no D these are the paper's r, g and b.
FACTORS = ("p", "q", "r", "d")

#: Terms of a product that a file may have.
MOST_TERMS = 64

#: Members of a group of texels from which its mean for importance sampling is taken.
GUIDE_MEMBERS = 16


class Representation(StoredMaps):
    """Codebooks and index maps.

    ``factor_p``, ``factor_q``, ``factor_r`` and, in the four-factor form, ``factor_d`` [prototype, n, n, 3];
    ``index`` [row, column, channel] uint32: a prototype for each term of P, then of Q, R and D; ``scale_map``
    [row, column, term, 3] in [0, 1] times ``scale_peak`` [term, 3]; ``half_scale`` [row, column, term, 3] with more
    than one term of Q · D. uint8 maps hold 255 times their numbers. The constants ``map_power`` and ``scale_power``
    are 1 or 4: what the numbers in the maps, and in the map of scales, are raised to.
    """

    @classmethod
    def schema(cls, meta: Facts, names: Collection[str]) -> Schema:
        """What its files hold; see :class:`btfref.representations.protocol.HasSchema`."""
        terms, half_terms = (_count_of_terms(meta, name) for name in ("n_terms", "n_half_terms"))
        factors = FACTORS if "factor_d" in names else FACTORS[:3]
        counts = dict(zip(FACTORS, (terms, half_terms, terms, half_terms), strict=True))
        channels = tuple(f"factor_{name}" for name in factors for _ in range(counts[name]))
        maps = {f"factor_{name}": _codes(f"prototypes_{name} side side 3") for name in factors}
        maps["index"] = MapSchema(f"rows columns {len(channels)}", INDICES, below=channels)
        maps["scale_map"] = _codes(f"rows columns {terms} 3")
        maps["scale_peak"] = MapSchema(f"{terms} 3", FLOATS, least=0)
        if half_terms > 1:
            maps["half_scale"] = _codes(f"rows columns {half_terms} 3")
        powers = OneOf((1, 4))
        constants: dict[str, Constant] = {
            "n_terms": OneOf((terms,)),
            "n_half_terms": OneOf((half_terms,)),
            "light_cos_last": Edge("light", floor=-1.0),
            "map_power": powers,
            "scale_power": powers,
        }
        return Schema(maps, constants)

    def evaluate(
        self, uv: ArrayLike, w_light: ArrayLike, w_view: ArrayLike, *, lod: ArrayLike = 0.0
    ) -> np.ndarray:
        """See :meth:`btfref.representations.protocol.Representation.evaluate`; ``lod`` is ignored.

        Never negative.
        """
        meta = self.meta
        n = self.maps["factor_p"].shape[1]
        index = self.maps["index"].reshape(-1, self.maps["index"].shape[-1])
        scale, half_scale = self._scales()
        tables = {name: self.maps[f"factor_{name}"].reshape(-1, n * n, 3) for name in self.names}
        slots, power = index_slots(meta["constants"]), meta["constants"]["map_power"]

        def lookup(uv: np.ndarray, w_light: np.ndarray, w_view: np.ndarray) -> np.ndarray:
            texel, weight = conventions.texel_stencil(uv, meta["texels"], meta["filter_type"])
            h, d = half_difference(w_light, w_view)
            stencils = {
                name: bilinear_stencil(w, n)
                for name, w in zip(FACTORS, (w_light, h, w_view, d), strict=True)
                if name in tables
            }

            def read(name: str, k: int) -> np.ndarray:
                texels, share = stencils[name]
                prototype = index[texel, slots[name].start + k]
                values = decoded(tables[name][prototype[:, :, None], texels[:, None, :]], power)
                return np.einsum("nxtc,nt->nxc", values, share)

            in_out = sum(
                scale[texel, k] * read("p", k) * read("r", k) for k in range(meta["constants"]["n_terms"])
            )
            half = sum(
                half_scale[texel, j] * read("q", j) * (read("d", j) if "d" in tables else 1)
                for j in range(meta["constants"]["n_half_terms"])
            )
            fade = light_fade(w_light, meta["constants"]["light_cos_last"])
            return np.einsum("nxc,nx->nc", in_out * half, weight) * fade[:, None]

        return evaluate_points(lookup, uv, w_light, w_view)

    @property
    def names(self) -> tuple[str, ...]:
        """The factors that there are, in order."""
        return tuple(name for name in FACTORS if f"factor_{name}" in self.maps)

    def _scales(self) -> tuple[np.ndarray, np.ndarray]:
        """Scales of the terms of P · R and of Q · D, shapes (texel, term, 3), as the definition computes."""
        constants = self.meta["constants"]
        scale = decoded(self.maps["scale_map"], constants["scale_power"]) * real(self.maps["scale_peak"])
        scale = scale.reshape(-1, *scale.shape[2:])
        if "half_scale" in self.maps:
            half = decoded(self.maps["half_scale"], constants["map_power"])
            return scale, half.reshape(-1, *half.shape[2:])
        return scale, np.ones((len(scale), 1, 3), scale.dtype)

    def factors(self, texels: np.ndarray) -> dict[str, np.ndarray]:
        """Factors of some texels with their scales, as `FactorOperators` reads them.

        Parameters
        ----------
        texels : ndarray of int, shape (k,)
            Flat indices.

        Returns
        -------
        dict of str to ndarray of float32, shape (term, n², k * 3)
        """
        index = self.maps["index"].reshape(-1, self.maps["index"].shape[-1])[texels]
        slots, power = index_slots(self.meta["constants"]), self.meta["constants"]["map_power"]
        scale, half_scale = self._scales()
        result = {}
        for name in self.names:
            table = self.maps[f"factor_{name}"]
            maps = decoded(table[index[:, slots[name]]], power, np.float32)  # texel, term, n, n, 3
            for amount, of in ((scale, "p"), (half_scale, "q")):
                if name == of:
                    maps = maps * amount[texels][:, :, None, None].astype(np.float32)
            result[name] = batch_last(maps)
        return result

    def tables(self, texels: np.ndarray, operators: FactorOperators) -> np.ndarray:
        """B of some texels at all measured pairs, shape (view, light, k, 3) float32."""
        product = operators.product(self.factors(texels))
        return product.reshape(*operators.shape, -1, 3)

    def sampling_tables(self) -> tuple[np.ndarray, np.ndarray]:
        """Groups of texels alike, and the means of some of their members."""
        n_texels = int(np.prod(self.meta["texels"]))
        views = self.maps["view_directions"].astype(float)
        lights = self.maps["light_directions"].astype(float)
        some = map_operators(
            views[feature_views(len(views))], lights, self.maps["factor_p"].shape[1], "d" in self.names
        )
        features = np.concatenate(
            [
                np.moveaxis(conventions.luminance(self.tables(part, some)), -1, 0).reshape(len(part), -1)
                for part in texel_parts(n_texels)
            ]
        )
        labels = texel_groups(features)
        members = spread_members(labels, GUIDE_MEMBERS)
        operators = map_operators(views, lights, self.maps["factor_p"].shape[1], "d" in self.names)
        tables = np.concatenate(
            [
                np.moveaxis(conventions.luminance(self.tables(part, operators)), -1, 0)
                for part in texel_parts(len(members), members)
            ]
        )
        return labels.reshape(self.meta["texels"]), group_means(labels[members], tables)


def _codes(axes: str) -> MapSchema:
    """A map of numbers in [0, 1] in any storage."""
    return MapSchema(axes, CODES, least=0, most=1)


def _count_of_terms(meta: Facts, name: str) -> int:
    """A number of terms, from the constants of a file."""
    found = meta["constants"].get(name)
    if type(found) is not int or not 1 <= found <= MOST_TERMS:
        expected = Range(1, MOST_TERMS, whole=True)
        raise InputError(
            "a constant is out of range", field=f"constants.{name}", got=found, expected=expected
        )
    return found


def index_slots(constants: Facts) -> dict[str, slice]:
    """Channels of the index map that hold each factor's terms, as slices."""
    terms, half_terms = constants["n_terms"], constants["n_half_terms"]
    result, start = {}, 0
    for name, count in zip(FACTORS, (terms, half_terms, terms, half_terms), strict=True):
        result[name] = slice(start, start + count)
        start += count
    return result


def light_fade(w_light: ArrayLike, cos_last: float) -> np.ndarray:
    """``min(1, cos θ / cos θ_last)``: P holds its last ring, B falls to zero at the horizon."""
    if cos_last <= 1e-6:
        return np.ones(np.shape(w_light)[:-1], precision())
    return np.minimum(real(w_light)[..., 2] / cos_last, 1)


def decoded(array: np.ndarray, power: int, dtype: DTypeLike | None = None) -> np.ndarray:
    """Values of a stored map: what is stored (of uint8 a 255th) to the ``power`` of 1 or 4."""
    values = array.astype(precision() if dtype is None else dtype)
    if array.dtype == np.uint8:
        values /= values.dtype.type(255)
    return raised(values, power)


def raised(values: JitArray, power: int) -> JitArray:
    """``values`` to the power of 1 or 4."""
    if power == 1:
        return values
    squares = values * values
    return squares * squares


def batch_last(maps: np.ndarray) -> np.ndarray:
    """Maps as factors: (texel, term, n, n, 3) -> (term, n², texel * 3)."""
    k, terms, n = maps.shape[:3]
    return np.ascontiguousarray(np.moveaxis(maps.reshape(k, terms, n * n, 3), 0, 2)).reshape(
        terms, n * n, k * 3
    )


def texel_parts(n_texels: int, texels: np.ndarray | None = None, size: int = 32) -> list[np.ndarray]:
    """Index arrays of at most ``size`` texels: small enough for their tables to stay in cache."""
    texels = np.arange(n_texels) if texels is None else texels
    return [texels[start : start + size] for start in range(0, n_texels, size)]
