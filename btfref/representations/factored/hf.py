"""Homomorphic factorization: factors of light, half vector and view from a linear system of their logarithms.

Sources: M. McCool, J. Ang, A. Ahmad, "Homomorphic Factorization of BRDFs for High-Performance Rendering",
SIGGRAPH 2001; F. Suykens, K. vom Berge, A. Lagae, P. Dutré, "Interactive Rendering with Bidirectional Texture
Functions", Eurographics 2003, section 4.3: ``log f = P̃(l) + Q̃(h) + R̃(v)``, one row of bilinear weights per sample,
with smoothing rows ``λ L x̃ = 0``. The matrix depends on directions alone, so it is factored once for all texels and
channels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from btfref.numerics.solvers.factoring import map_operators
from btfref.numerics.solvers.threads import reproducible
from btfref.numerics.sphere.parabolic import texel_centres
from btfref.representations.factored.definition import Representation
from btfref.representations.factored.fit import (
    Factors,
    checked_map_size,
    checked_ranges,
    factorized,
    unit_tables,
)
from btfref.representations.factored.storage import Storing, fitted
from btfref.representations.protocol import FitMemory

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

    from btfref.numerics.solvers.factoring import FactorOperators
    from btfref.numerics.sphere.directions import DirectionSet
    from btfref.representations.factored.fit import PartFactors, Step
    from btfref.sampling.blocks import BTFBlocks
    from btfref.types import Facts, Progress


__all__ = ["FIT_MEMORY", "PRESETS", "Representation", "fit"]

#: See :mod:`btfref.representations.fit_memory`.
FIT_MEMORY = FitMemory(rows=12, texels=1, texel=83e3)

#: "paper": factors as the system leaves them, all in 8 bits, scales from the normalisation alone.
PRESETS = {
    "paper": {
        "floor": 1e-3,
        "bounded": False,
        "rescale": False,
        "storage": "byte",
        "code": "linear",
    }
}

#: Candidates for λ where none is given.
SMOOTHNESS = (0.3, 1.0, 3.0, 10.0)

#: Texels and share of the samples that judge the candidates.
N_JUDGED, HELD_OUT = 48, 0.2

#: How errors weigh when the scales are fitted; see :func:`btfref.numerics.solvers.factoring.sample_weights`.
EXPONENT = 0.75

#: Weight of x̃ = 0 in the normal equations: constants can move between the factors freely, and this picks the smallest.
RIDGE = 1e-6

#: Least weight with which a sample reaches a texel of a map.
REACHED = 1e-3

#: Logarithms of the factors are clipped here, so that their products stay finite floats; unsupported texels with little
#: smoothing reach it.
LOG_LIMIT = 25.0


class LogSystem:
    """The linear system of the logarithms.

    Parameters
    ----------
    views, lights : DirectionSet
    map_size : int
    """

    def __init__(self, views: DirectionSet, lights: DirectionSet, map_size: int) -> None:
        from scipy import sparse

        self.map_size = map_size
        radius = np.linalg.norm(texel_centres(map_size).reshape(-1, 2), axis=1)
        # Texels that a bilinear lookup of the hemisphere can reach.
        self.used = np.flatnonzero(radius <= 1 + np.sqrt(2) * 2 / map_size)
        operators = map_operators(views.vectors, lights.vectors, map_size, False)
        n_views, n_lights = operators.shape
        light, view = np.tile(np.arange(n_lights), n_views), np.repeat(np.arange(n_views), n_lights)
        blocks = (operators.p[light], operators.q, operators.r[view])
        self.rows = sparse.hstack([block.tocsc()[:, self.used] for block in blocks]).tocsr().astype(float)
        self.laplacian = sparse.block_diag([self._laplacian()] * 3).tocsr()

    def _laplacian(self) -> csr_matrix:
        """Graph Laplacian of the texels in use: second differences inside, flat across the border."""
        from scipy import sparse

        n = self.map_size
        number = np.full(n * n, -1)
        number[self.used] = np.arange(len(self.used))
        grid = number.reshape(n, n)
        pairs = np.concatenate(
            [
                np.stack([grid[:, :-1], grid[:, 1:]], -1).reshape(-1, 2),
                np.stack([grid[:-1], grid[1:]], -1).reshape(-1, 2),
            ]
        )
        pairs = pairs[(pairs >= 0).all(1)]
        size = len(self.used)
        links = sparse.coo_matrix((np.ones(len(pairs)), pairs.T), shape=(size, size))
        links = (links + links.T).tocsr()
        return sparse.diags(np.asarray(links.sum(1)).ravel()) - links

    def factorize(self, smoothness: float, rows: np.ndarray | None = None) -> tuple[np.ndarray, bool]:
        """Cholesky factor of the normal equations; ``rows`` selects samples."""
        from scipy.linalg import cho_factor

        matrix = self.rows if rows is None else self.rows[rows]
        normal = (matrix.T @ matrix + smoothness**2 * (self.laplacian.T @ self.laplacian)).toarray()
        normal[np.diag_indices_from(normal)] += RIDGE
        return cho_factor(normal, lower=True, overwrite_a=True, check_finite=False)

    def solve(
        self, factor: tuple[np.ndarray, bool], logarithms: np.ndarray, rows: np.ndarray | None = None
    ) -> np.ndarray:
        """Logarithms of the factors in use, shape (3 * used, m), for samples (pairs, m)."""
        from scipy.linalg import cho_solve

        matrix = self.rows if rows is None else self.rows[rows]
        return cho_solve(factor, matrix.T @ logarithms, check_finite=False)

    def choose_smoothness(
        self, logarithms: np.ndarray, rng: np.random.Generator
    ) -> tuple[float, list[float]]:
        """The candidate that predicts held-out samples best, by squared error of the logarithm."""
        held = rng.permutation(len(logarithms)) < HELD_OUT * len(logarithms)
        errors = []
        for candidate in SMOOTHNESS:
            solution = self.solve(self.factorize(candidate, ~held), logarithms[~held], ~held)
            errors.append(float(((self.rows[held] @ solution - logarithms[held]) ** 2).mean()))
        return SMOOTHNESS[int(np.argmin(errors))], errors

    def maps(self, solution: np.ndarray) -> dict[str, np.ndarray]:
        """Maps of the three factors: dict of (n², m), the unused corners black."""
        result = {}
        for name, block in zip("pqr", np.split(solution, 3), strict=True):
            values = np.zeros((self.map_size**2, solution.shape[1]), np.float32)
            # The mean of the logarithm goes to the scale, which is common to the factors anyway.
            values[self.used] = np.exp(np.clip(block, -LOG_LIMIT, LOG_LIMIT))
            result[name] = values
        return result


def logarithms(tables: np.ndarray, floor: float) -> np.ndarray:
    """Logarithms of tables of mean 1, values below ``floor`` counted as ``floor``; (view, light, m) -> (pairs, m)."""
    return np.log(np.maximum(tables, floor)).reshape(-1, tables.shape[-1]).astype(float)


@reproducible()
def fit(
    btf: BTFBlocks,
    *,
    seed: int = 0,
    progress: Progress | None = None,
    smoothness: float | None = None,
    floor: float = 1e-2,
    bounded: bool = True,
    map_size: int = 32,
    clusters: int | None = 256,
    storage: str = "half",
    scale_storage: str | None = None,
    code: str = "fourth",
    rescale: bool = True,
    filter_type: str = "bilinear",
) -> Representation:
    """Homomorphic factorization of ``btf``, clustered.

    Parameters
    ----------
    btf : BTFBlocks
        Negative values count as 0.
    seed : int
        Of the held-out samples and of the clustering.
    progress : callable, optional
        ``progress(done, total, label)``.
    smoothness, floor, bounded, map_size
        Of the factorization: see :func:`factorize`.
    clusters, storage, scale_storage, code, rescale, filter_type
        See :class:`btfref.representations.factored.storage.Storing`.

    Returns
    -------
    Representation
        ``meta["fit"]``: relative squared errors of the maps before clustering ("maps") and of what is stored
        ("error"); "smoothness"; "log_rms", the residue of the logarithms.

    Raises
    ------
    InputError
        For parameters out of range, or a value that is not finite.
    """
    storing = Storing(clusters, storage, scale_storage, code, rescale, filter_type)

    def factors(step: Step) -> Factors:
        return factorize(
            btf, seed=seed, step=step, smoothness=smoothness, floor=floor, bounded=bounded, map_size=map_size
        )

    return fitted(btf, factors, storing, seed=seed, progress=progress, more_steps=6)


def factorize(
    btf: BTFBlocks,
    *,
    seed: int = 0,
    step: Step = lambda label: None,
    smoothness: float | None = None,
    floor: float = 1e-2,
    bounded: bool = True,
    map_size: int = 32,
) -> Factors:
    """Factors of every texel of ``btf``, not yet clustered.

    Parameters
    ----------
    btf : BTFBlocks
    seed : int
        Of the held-out samples.
    step : callable
        ``step(label)``, called now and then.
    smoothness : float, optional
        λ of the smoothing rows, above 0. None: of ``SMOOTHNESS`` the one that predicts the logarithms of a fifth of
        the samples of some texels best from the others.
    floor : float
        Share of its mean, (0, 1], below which a texel's value counts as that much: logarithms need positive numbers,
        and without a floor the least values would rule the fit. A black texel stays black.
    bounded : bool
        Texels of a map that no sample reaches, which the smoothing extrapolates, hold at most the largest value of
        those that one reaches. Differs from the papers (False): what no sample sees is up to 7 times as large, and
        8-bit codes are spent on it.
    map_size : int
        Texels along a side of a parabolic map, at least 2.

    Returns
    -------
    btfref.representations.factored.fit.Factors
    """
    map_size = checked_map_size(map_size)
    # Above 0: the least positive floats are in range.
    checked_ranges(floor=(floor, np.finfo(float).tiny, 1))
    if smoothness is not None:
        checked_ranges(smoothness=(smoothness, np.finfo(float).tiny, np.finfo(float).max))
    step("smoothness")
    system = LogSystem(btf.views, btf.lights, map_size)
    facts: Facts = {}
    if smoothness is None:
        n_texels = int(np.prod(btf.texels))
        some = np.unique(np.linspace(0, n_texels - 1, min(N_JUDGED, n_texels)).round().astype(int))
        data, _ = unit_tables(btf, some)
        chosen, errors = system.choose_smoothness(logarithms(data, floor), np.random.default_rng(seed))
        facts["held_out"] = dict(zip(map(str, SMOOTHNESS), errors, strict=True))
    else:
        chosen = float(smoothness)
    step("factorization")
    factor = system.factorize(chosen)
    operators = map_operators(btf.views.vectors, btf.lights.vectors, map_size, False)
    reached = {
        name: np.asarray(getattr(operators, name).max(0).todense()).ravel() > REACHED for name in "pqr"
    }
    one_part = _Part(system, factor, operators, floor, reached if bounded else None)
    maps, squared, log_errors = factorized(btf, dict.fromkeys("pqr", 1), map_size, step, one_part)
    facts |= squared | {
        "smoothness": chosen,
        "log_rms": float(np.sqrt(np.concatenate(log_errors).mean())),
    }
    parameters = {
        "smoothness": smoothness,
        "floor": floor,
        "bounded": bounded,
        "map_size": map_size,
    }
    return Factors("hf", maps, EXPONENT, parameters, facts)


@dataclass(frozen=True)
class _Part:
    """See :class:`btfref.representations.factored.fit.FactorizesPart`.

    Attributes
    ----------
    system : LogSystem
    factor : tuple
        Of :meth:`LogSystem.factorize`.
    operators : FactorOperators
    floor : float
        See :func:`factorize`.
    reached : dict of str to ndarray of bool, optional
        Texels of the maps whose largest value bounds the others.
    """

    system: LogSystem
    factor: tuple[np.ndarray, bool]
    operators: FactorOperators
    floor: float
    reached: dict[str, np.ndarray] | None

    def __call__(self, index: int, data: np.ndarray) -> PartFactors:
        """Maps, approximations, and mean squared errors of the logarithms, (m,)."""
        log_data = logarithms(data, self.floor)
        solution = self.system.solve(self.factor, log_data)
        errors = ((self.system.rows @ solution - log_data) ** 2).mean(0)
        found = self.system.maps(solution)
        if self.reached is not None:
            found = {name: np.minimum(m, m[self.reached[name]].max(0)) for name, m in found.items()}
        maps = {name: m[None] for name, m in found.items()}
        return maps, {"maps": self.operators.product(maps)}, errors
