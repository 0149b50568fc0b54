"""Chained matrix factorization: each texel's table as a product of maps of single directions.

Source: F. Suykens, K. vom Berge, A. Lagae, P. Dutré, "Interactive Rendering with Bidirectional Texture Functions",
Eurographics 2003, sections 4 and 5. Half-vector factor first: the mean over difference directions (three factors), or
the leading terms of the half/difference matrix (four factors). Then the data divided by it, element by element, in the
measured parameterization; the leading terms of that residue are the factors of light and view.

Differs from the paper: the product is refined as a whole, at the samples and at pairs of directions between them, where
the data are interpolated. Half vectors of measured pairs leave gaps (with 5 azimuths, no view sees the mirror image of
a light), and in a gap nothing else holds a factor: refined at the samples alone, products of coarse grids reach a
hundred times the data's maximum there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from btfref.numerics.solvers.factoring import (
    TINY,
    FactorOperators,
    PairOperators,
    Samples,
    map_operators,
    pair_map_operators,
    rank_terms,
    refine,
    sparse_operator,
)
from btfref.numerics.solvers.threads import reproducible
from btfref.numerics.sphere.directions import DirectionSet, ring_directions
from btfref.numerics.sphere.halfway import half_difference, in_out
from btfref.numerics.sphere.parabolic import texel_directions
from btfref.representations.factored.definition import Representation, light_fade, texel_parts
from btfref.representations.factored.fit import (
    Factors,
    checked_map_size,
    checked_ranges,
    factorized,
)
from btfref.representations.factored.storage import Storing, fitted
from btfref.representations.lookup import positive_integer
from btfref.representations.protocol import FitMemory

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

    from btfref.representations.factored.fit import PartFactors, Step
    from btfref.sampling.blocks import BTFBlocks
    from btfref.types import Progress


__all__ = ["FIT_MEMORY", "PRESETS", "Representation", "fit"]

#: See :mod:`btfref.representations.fit_memory`.
FIT_MEMORY = FitMemory(rows=12, texels=1, texel=83e3)

#: "paper": factors as the chain leaves them, all in 8 bits, scales from the normalisation alone.
PRESETS = {"paper": {"sweeps": 0, "rescale": False, "storage": "byte", "code": "linear"}}

#: Step of the difference directions in degrees: the paper's 8 polar angles.
DIFFERENCE_STEP = 11.25

#: Pairs between the samples for each half vector, with difference vectors drawn from all that lie above the horizon.
PAIRS_PER_HALF = 4

#: Their directions have at least this z.
HORIZON = 1e-6

#: Parts of the texels on which the resampling errors are measured.
N_PROBED_PARTS = 3


def ring_set(step: float, *, horizon: bool = True) -> DirectionSet:
    """Rings from the pole to the horizon, about ``step`` degrees apart and equally dense along each.

    Parameters
    ----------
    step : float
    horizon : bool
        With the ring on the horizon itself.
    """
    n = max(1, int(np.ceil(90 / step - 1e-9)))
    polar = (np.arange(1, n + 1) * (90 / n))[: n if horizon else n - 1]
    counts = np.maximum(6, np.round(np.sin(np.radians(polar)) * 360 / step)).astype(int)
    return DirectionSet(
        ring_directions([(0, 1, 0), *((float(p), int(c), 0) for p, c in zip(polar, counts, strict=True))]),
        "rings",
    )


class Resampling:
    """Linear operators between the parameterizations, the same for all texels and channels.

    Parameters
    ----------
    views, lights : DirectionSet
    half_step : float
        Degrees between samples of the half vector, [0.5, 90].
    map_size : int
    four : bool
        With the difference factor.
    """

    def __init__(
        self, views: DirectionSet, lights: DirectionSet, half_step: float, map_size: int, four: bool
    ) -> None:
        # No pair above the horizon has its half vector on it: samples there would be read, by the blend with the ring
        # above, but never held by a pair of their own.
        self.half_set = ring_set(half_step, horizon=False)
        self.difference_set = ring_set(DIFFERENCE_STEP)
        h, d = half_difference(lights.vectors[None], views.vectors[:, None])
        self.half_stencil = self.half_set.stencil(h.reshape(-1, 3))
        self.difference_stencil = self.difference_set.stencil(d.reshape(-1, 3))
        self.measured = FactorOperators(
            p=sparse_operator(np.arange(len(lights))[:, None], np.ones((len(lights), 1)), len(lights)),
            q=sparse_operator(*self.half_stencil, len(self.half_set)),
            r=sparse_operator(np.arange(len(views))[:, None], np.ones((len(views), 1)), len(views)),
            d=sparse_operator(*self.difference_stencil, len(self.difference_set)) if four else None,
        )
        self.to_half_difference, self.known = self._half_difference(views, lights)
        # Pairs that no one measured carry no weight in the mean over difference directions.
        share = self.known / np.maximum(self.known.sum(1, keepdims=True), 1)
        rows = np.repeat(np.arange(len(self.half_set)), len(self.difference_set))
        mean = sparse_operator(np.arange(share.size)[:, None], share.reshape(-1, 1), share.size)
        gather = sparse_operator(rows[:, None], np.ones((len(rows), 1)), len(self.half_set)).T
        self.to_half = (gather @ mean @ self.to_half_difference).tocsr()
        self.to_maps = self._parabolic(views, lights, map_size, four)
        maps = map_operators(views.vectors, lights.vectors, map_size, four)
        self.through_maps = FactorOperators(**self._through(maps))
        rows, w_light, w_view = self._between()
        self.to_between = self.to_half_difference[rows]
        self.between = PairOperators(**self._through(pair_map_operators(w_view, w_light, map_size, four)))

    def _through(self, maps: FactorOperators) -> dict[str, csr_matrix]:
        """How the factors' samples are read through their maps."""
        return {name: (getattr(maps, name) @ to).tocsr() for name, to in self.to_maps.items()}

    def _between(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pairs at which the refinement sees the interpolated data, the same in every fit.

        Returns
        -------
        rows : ndarray of int, shape (pair,)
            Of ``to_half_difference``.
        w_light, w_view : ndarray, shape (pair, 3)
        """
        w_light, w_view = in_out(self.half_set.vectors[:, None], self.difference_set.vectors[None])
        # On the horizon itself two directions may be opposite, and have no half vector.
        there = np.minimum(w_light[..., 2], w_view[..., 2]) > HORIZON
        order = np.random.default_rng(0).random(there.shape) - there
        picked = np.argsort(order, 1, kind="stable")[:, :PAIRS_PER_HALF]
        half = np.broadcast_to(np.arange(len(there))[:, None], picked.shape)
        at = half[there[half, picked]], picked[there[half, picked]]
        return at[0] * there.shape[1] + at[1], w_light[at], w_view[at]

    def _half_difference(self, views: DirectionSet, lights: DirectionSet) -> tuple[csr_matrix, np.ndarray]:
        """Operator (view, light) -> (half, difference), and where both directions are above the horizon."""
        w_light, w_view = in_out(self.half_set.vectors[:, None], self.difference_set.vectors[None])
        known = (w_light[..., 2] >= -1e-9) & (w_view[..., 2] >= -1e-9)
        up = np.array([0.0, 0.0, 1.0])
        light, light_weight = lights.stencil(np.where(known[..., None], w_light, up))
        view, view_weight = views.stencil(np.where(known[..., None], w_view, up))
        index = view[..., :, None] * len(lights) + light[..., None, :]
        weight = view_weight[..., :, None] * light_weight[..., None, :] * known[..., None, None]
        operator = sparse_operator(
            index.reshape(known.size, -1), weight.reshape(known.size, -1), len(views) * len(lights)
        )
        return operator, known.astype(np.float32)

    def _parabolic(
        self, views: DirectionSet, lights: DirectionSet, map_size: int, four: bool
    ) -> dict[str, csr_matrix]:
        """Operators from the factors' samples to the texels of their maps."""
        w = texel_directions(map_size).reshape(-1, 3)
        # Just above the horizon, where the weights and the fall to the horizon still have a quotient.
        above = w + np.array([0, 0, 1e-3])
        above /= np.linalg.norm(above, axis=1, keepdims=True)
        index, weight = lights.stencil(above, hold=False)
        # The part of the fall to the horizon that every evaluation applies is taken out of the map.
        weight = weight / light_fade(above, float(lights.vectors[:, 2].min()))[:, None]
        result = {
            "p": sparse_operator(index, weight, len(lights)),
            "q": sparse_operator(*self.half_set.stencil(w), len(self.half_set)),
            "r": sparse_operator(*views.stencil(w), len(views)),
        }
        if four:
            result["d"] = sparse_operator(*self.difference_set.stencil(w), len(self.difference_set))
        return result

    def errors(self, data: np.ndarray, factors: dict[str, np.ndarray]) -> dict[str, float]:
        """Relative RMS errors of going to another parameterization and back, for tables and their factors."""
        there = (self.to_half_difference @ data.reshape(-1, data.shape[-1])).reshape(*self.known.shape, -1)
        (h, h_weight), (d, d_weight) = self.half_stencil, self.difference_stencil
        back = np.zeros_like(data.reshape(-1, data.shape[-1]))
        for i in range(h.shape[1]):
            for j in range(d.shape[1]):
                back += (h_weight[:, i] * d_weight[:, j]).astype(np.float32)[:, None] * there[
                    h[:, i], d[:, j]
                ]

        def relative(test: np.ndarray, reference: np.ndarray) -> float:
            energy = float((reference.astype(float) ** 2).sum())
            return (
                float(np.sqrt(((test - reference).astype(float) ** 2).sum() / energy)) if energy > 0 else 0.0
            )

        result = {"half_difference": relative(back, data.reshape(back.shape))}
        for name, factor in factors.items():
            result[f"parabolic_{name}"] = relative(
                self.through_maps.read(name, factor), self.measured.read(name, factor)
            )
        return result


def chain(data: np.ndarray, resampling: Resampling, terms: int, floor: float) -> dict[str, np.ndarray]:
    """The chained factorization of tables.

    Parameters
    ----------
    data : ndarray of float32, shape (view, light, m)
        Non-negative.
    resampling : Resampling
    terms : int
        Terms of each matrix decomposition.
    floor : float
        The half-vector approximation, by which the data are divided, counts as at least this share of its mean.

    Returns
    -------
    dict of str to ndarray, shape (term, sample, m)
    """
    flat = data.reshape(-1, data.shape[-1])
    if resampling.measured.d is None:
        factors = {"q": (resampling.to_half @ flat)[None]}
    else:
        matrix = (resampling.to_half_difference @ flat).reshape(*resampling.known.shape, -1)
        q, d = rank_terms(matrix, resampling.known, terms)
        factors = {"q": q, "d": d}
    half = resampling.measured.half(factors)
    residue = data / np.maximum(half, np.maximum(floor * half.mean((0, 1)), TINY))
    factors["r"], factors["p"] = rank_terms(residue, None, terms)
    return factors


@reproducible()
def fit(
    btf: BTFBlocks,
    *,
    seed: int = 0,
    progress: Progress | None = None,
    difference: bool = False,
    terms: int = 1,
    sweeps: int = 8,
    exponent: float = 0.75,
    between: float = 0.3,
    floor: float = 1e-3,
    half_step: float = 5.0,
    map_size: int = 32,
    clusters: int | None = 256,
    storage: str = "half",
    scale_storage: str | None = None,
    code: str = "fourth",
    rescale: bool = True,
    filter_type: str = "bilinear",
) -> Representation:
    """Chained matrix factorization of ``btf``, clustered.

    Parameters
    ----------
    btf : BTFBlocks
        Negative values count as 0.
    seed : int
        Of the clustering.
    progress : callable, optional
        ``progress(done, total, label)``.
    difference, terms, sweeps, exponent, between, floor, half_step, map_size
        Of the factorization: see :func:`factorize`.
    clusters, storage, scale_storage, code, rescale, filter_type
        See :class:`btfref.representations.factored.storage.Storing`.

    Returns
    -------
    Representation
        ``meta["fit"]``: relative squared errors of the factors ("factors"), of the maps before clustering ("maps"),
        and of what is stored ("error"); "resampling": relative RMS errors of the changes of parameterization.

    Raises
    ------
    InputError
        For parameters out of range, or a value that is not finite.
    """
    storing = Storing(clusters, storage, scale_storage, code, rescale, filter_type)

    def factors(step: Step) -> Factors:
        return factorize(
            btf,
            step=step,
            difference=difference,
            terms=terms,
            sweeps=sweeps,
            exponent=exponent,
            between=between,
            floor=floor,
            half_step=half_step,
            map_size=map_size,
        )

    return fitted(btf, factors, storing, seed=seed, progress=progress, more_steps=5 + bool(difference))


def factorize(
    btf: BTFBlocks,
    *,
    step: Step = lambda label: None,
    difference: bool = False,
    terms: int = 1,
    sweeps: int = 8,
    exponent: float = 0.75,
    between: float = 0.3,
    floor: float = 1e-3,
    half_step: float = 5.0,
    map_size: int = 32,
) -> Factors:
    """Factors of every texel of ``btf``, not yet clustered.

    Parameters
    ----------
    btf : BTFBlocks
    step : callable
        ``step(label)``, called now and then.
    difference : bool
        Four factors: with one of the difference vector.
    terms : int
        Non-negative terms of each matrix decomposition, at least 1.
    sweeps : int
        Multiplicative updates of all factors after the chain, 0 to 1000, towards the least weighted squared error of
        the product as the maps give it. Differs from the paper, which stops after the chain (0): the residue's
        decomposition weighs every sample of the quotient alike, however small the product is there.
    exponent : float
        Squared errors of the updates and of the scales count (B / mean + 0.1)^−exponent, 0 to 2, B as approximated: 0
        favours highlights and the RMSE, 2 shadows and the relative error.
    between : float
        What pairs between the samples count together in the updates, 0 to 100, where the samples count 1. 0: the
        factors are free between the samples, and may rise there without bound.
    floor : float
        Share of its mean, [0, 1], below which the half-vector approximation is held when the data are divided by it.
    half_step : float
        Degrees between samples of the half vector, [0.5, 90].
    map_size : int
        Texels along a side of a parabolic map, at least 2.

    Returns
    -------
    btfref.representations.factored.fit.Factors
    """
    terms, map_size = positive_integer("terms", terms), checked_map_size(map_size)
    checked_ranges(
        floor=(floor, 0, 1),
        half_step=(half_step, 0.5, 90),
        sweeps=(sweeps, 0, 1000),
        exponent=(exponent, 0, 2),
        between=(between, 0, 100),
    )
    step("resampling")
    resampling = Resampling(btf.views, btf.lights, half_step, map_size, difference)
    # The mean over difference directions is one term, whatever the number of P and R.
    counts = {name: terms if difference or name != "q" else 1 for name in resampling.to_maps}
    n_parts = len(texel_parts(int(np.prod(btf.texels))))
    # A few parts from all over the texture.
    probed = set(np.linspace(0, n_parts - 1, min(N_PROBED_PARTS, n_parts)).round().astype(int).tolist())
    one_part = _Part(resampling, terms, floor, between, sweeps, exponent, frozenset(probed))
    maps, facts, measured = factorized(btf, counts, map_size, step, one_part)
    probes = [found for found in measured if found is not None]
    facts["resampling"] = {name: float(np.mean([p[name] for p in probes])) for name in probes[0]}
    parameters = {
        "difference": difference,
        "terms": terms,
        "sweeps": sweeps,
        "exponent": exponent,
        "between": between,
        "floor": floor,
        "half_step": half_step,
        "map_size": map_size,
    }
    return Factors("cmf", maps, exponent, parameters, facts)


@dataclass(frozen=True)
class _Part:
    """See :class:`btfref.representations.factored.fit.FactorizesPart`, and :func:`factorize` for the settings."""

    resampling: Resampling
    terms: int
    floor: float
    between: float
    sweeps: int
    exponent: float
    probed: frozenset[int]

    def __call__(self, index: int, data: np.ndarray) -> PartFactors:
        """Maps, approximations, and of some parts the errors of the changes of parameterization."""
        resampling = self.resampling
        factors = chain(data, resampling, self.terms, self.floor)
        models = {"factors": resampling.measured.product(factors)}
        probe = resampling.errors(data, factors) if index in self.probed else None
        samples = [Samples(data, resampling.through_maps)]
        if self.between > 0:
            interpolated = resampling.to_between @ data.reshape(-1, data.shape[-1])
            share = self.between * data.size / interpolated.size
            samples.append(Samples(interpolated, resampling.between, share))
        factors = refine(samples, factors, self.sweeps, self.exponent)
        models["maps"] = resampling.through_maps.product(factors)
        maps = {
            name: np.stack([resampling.to_maps[name] @ term for term in factors[name]]) for name in factors
        }
        return maps, models, probe
