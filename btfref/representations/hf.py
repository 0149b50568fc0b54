"""Homomorphic factorization: factors of light, half vector and view from a linear system of their logarithms.

Sources: M. McCool, J. Ang, A. Ahmad, "Homomorphic Factorization of BRDFs for High-Performance Rendering",
SIGGRAPH 2001; F. Suykens, K. vom Berge, A. Lagae, P. Dutré, "Interactive Rendering with Bidirectional Texture
Functions", Eurographics 2003, section 4.3: ``log f = P̃(l) + Q̃(h) + R̃(v)``, one row of bilinear weights per sample,
with smoothing rows ``λ L x̃ = 0``. The matrix depends on directions alone, so it is factored once for all texels and
channels.
"""

from __future__ import annotations

import numpy as np

from btfref.errors import InputError
from btfref.numerics.parabolic import texel_centres
from btfref.representations.factored import Representation, texel_parts
from btfref.representations.factored_fit import assemble, check_parameters, map_operators, unit_tables
from btfref.representations.lookup import positive_integer

__all__ = ["PRESETS", "Representation", "fit"]

#: "paper": all in 8 bits, scales from the normalisation alone.
PRESETS = {"paper": {"rescale": False, "storage": "byte", "scale_storage": "byte"}}

#: Candidates for λ where none is given.
SMOOTHNESS = (0.3, 1.0, 3.0, 10.0)

#: Texels and share of the samples that judge the candidates.
N_JUDGED, HELD_OUT = 48, 0.2

#: How errors weigh when the scales are fitted; see :func:`btfref.numerics.factoring.sample_weights`.
EXPONENT = 0.75

#: Weight of x̃ = 0 in the normal equations: constants can move between the factors freely, and this picks the smallest.
RIDGE = 1e-6

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

    def __init__(self, views, lights, map_size):
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

    def _laplacian(self):
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

    def factorize(self, smoothness, rows=None):
        """Cholesky factor of the normal equations; ``rows`` selects samples."""
        from scipy.linalg import cho_factor

        matrix = self.rows if rows is None else self.rows[rows]
        normal = (matrix.T @ matrix + smoothness**2 * (self.laplacian.T @ self.laplacian)).toarray()
        normal[np.diag_indices_from(normal)] += RIDGE
        return cho_factor(normal, lower=True, overwrite_a=True, check_finite=False)

    def solve(self, factor, logarithms, rows=None):
        """Logarithms of the factors in use, shape (3 * used, m), for samples (pairs, m)."""
        from scipy.linalg import cho_solve

        matrix = self.rows if rows is None else self.rows[rows]
        return cho_solve(factor, matrix.T @ logarithms, check_finite=False)

    def choose_smoothness(self, logarithms, rng):
        """The candidate that predicts held-out samples best, by squared error of the logarithm."""
        held = rng.permutation(len(logarithms)) < HELD_OUT * len(logarithms)
        errors = []
        for candidate in SMOOTHNESS:
            solution = self.solve(self.factorize(candidate, ~held), logarithms[~held], ~held)
            errors.append(float(((self.rows[held] @ solution - logarithms[held]) ** 2).mean()))
        return SMOOTHNESS[int(np.argmin(errors))], errors

    def maps(self, solution):
        """Maps of the three factors: dict of (n², m), the unused corners black."""
        result = {}
        for name, block in zip("pqr", np.split(solution, 3), strict=True):
            values = np.zeros((self.map_size**2, solution.shape[1]), np.float32)
            # The mean of the logarithm goes to the scale, which is common to the factors anyway.
            values[self.used] = np.exp(np.clip(block, -LOG_LIMIT, LOG_LIMIT))
            result[name] = values
        return result


def logarithms(tables, floor):
    """Logarithms of tables of mean 1, values below ``floor`` counted as ``floor``; (view, light, m) -> (pairs, m)."""
    return np.log(np.maximum(tables, floor)).reshape(-1, tables.shape[-1]).astype(float)


def fit(
    btf,
    *,
    seed=0,
    progress=None,
    smoothness=None,
    floor=1e-3,
    map_size=32,
    clusters=256,
    storage="half",
    scale_storage=None,
    rescale=True,
    filter_type="bilinear",
):
    """Homomorphic factorization of ``btf``, clustered.

    Parameters
    ----------
    btf : SampledBTF
        Negative values count as 0.
    seed : int
        Of the held-out samples and of the clustering.
    progress : callable, optional
        ``progress(done, total, label)``.
    smoothness : float, optional
        λ of the smoothing rows. None: of ``SMOOTHNESS`` the one that predicts the logarithms of a fifth of the samples
        of some texels best from the others.
    floor : float
        Share of its mean below which a texel's value counts as that much: logarithms need positive numbers, and
        without a floor the least values would rule the fit. A black texel stays black.
    map_size : int
        Texels along a side of a parabolic map, at least 2.
    clusters : int or None
        Largest codebook of each factor; None: no clustering.
    storage : {"half", "float", "byte"}
    scale_storage : {"half", "float", "byte"}, optional
        Of the scale map. None: that of the maps, but half for "byte".
    rescale : bool
        Fit the scales to the data by weighted least squares with the stored maps, as :func:`cmf.fit` does.
    filter_type : {"bilinear", "nearest"}

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
    check_parameters(clusters=clusters, storage=storage, scale_storage=scale_storage)
    map_size = positive_integer("map_size", map_size)
    if map_size < 2:
        raise InputError("a parameter is out of range", field="map_size", got=map_size, expected="at least 2")
    if not 0 < floor <= 1:
        raise InputError(
            "a parameter is out of range", field="floor", got=floor, expected="above 0, at most 1"
        )
    if smoothness is not None and not 0 < smoothness < np.inf:
        raise InputError(
            "a parameter is out of range", field="smoothness", got=smoothness, expected="a number above 0"
        )
    report = progress or (lambda *_: None)
    n_texels = int(np.prod(btf.values.shape[2:4]))
    parts = texel_parts(n_texels)
    steps = len(parts) + 6
    report(1, steps, "smoothness")
    system = LogSystem(btf.views, btf.lights, map_size)
    meta = {}
    if smoothness is None:
        some = np.unique(np.linspace(0, n_texels - 1, min(N_JUDGED, n_texels)).round().astype(int))
        data, _ = unit_tables(btf, some)
        chosen, errors = system.choose_smoothness(logarithms(data, floor), np.random.default_rng(seed))
        meta["held_out"] = dict(zip(map(str, SMOOTHNESS), errors, strict=True))
    else:
        chosen = float(smoothness)
    report(2, steps, "factorization")
    factor = system.factorize(chosen)
    operators = map_operators(btf.views.vectors, btf.lights.vectors, map_size, False)
    maps = {name: np.zeros((n_texels, 1, map_size, map_size, 3), np.float32) for name in "pqr"}
    energy = squared = log_squared = 0.0
    for step, texels in enumerate(parts):
        report(step + 2, steps, "factorization")
        data, mean = unit_tables(btf, texels)
        log_data = logarithms(data, floor)
        solution = system.solve(factor, log_data)
        log_squared += float(((system.rows @ solution - log_data) ** 2).sum())
        found = system.maps(solution)
        found["p"] = found["p"] * mean
        model = operators.product({name: values[None] for name, values in found.items()})
        energy += float(((data * mean).astype(float) ** 2).sum())
        squared += float(((model - data * mean).astype(float) ** 2).sum())
        for name, values in found.items():
            maps[name][texels, 0] = np.moveaxis(values.reshape(map_size, map_size, len(texels), 3), 2, 0)
    parameters = {
        "smoothness": smoothness,
        "floor": floor,
        "map_size": map_size,
        "clusters": clusters,
        "storage": storage,
        "scale_storage": scale_storage,
        "rescale": rescale,
        "seed": seed,
    }
    labels = iter(range(len(parts) + 3, steps + 1))
    result = assemble(
        "hf",
        btf,
        maps,
        parameters,
        exponent=EXPONENT,
        filter_type=filter_type,
        report=lambda label: report(next(labels), steps, label),
    )
    result.meta["fit"] |= meta | {
        "maps": squared / energy if energy > 0 else 0.0,
        "smoothness": chosen,
        "log_rms": float(np.sqrt(log_squared / (n_texels * 3 * len(system.rows.indptr[1:])))),
    }
    return result
