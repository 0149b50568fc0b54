"""Generalized cosine lobes per texel: the baseline "LAF" of reflectance fields.

Sources: E. Lafortune et al., "Non-Linear Approximation of Reflectance Functions", SIGGRAPH 1997, eq. 8; D. McAllister
et al., "Efficient Rendering of Spatial Bi-directional Reflectance Distribution Functions", Graphics Hardware 2002;
Meseth, Müller, Klein 2004, Table 1: ``f = ρ_d + Σ_j (C_x l_x v_x + C_y l_y v_y + C_z l_z v_z)^n`` of luminance, times
the texel's chroma.

The model is one of f; the data are ``B = f l_z``, so ``f l_z`` is fitted to them and nothing is divided by the cosine.
A lobe is stored as coefficients in [−1, 1], exponent and peak, instead of as ``C``, whose power could overflow.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from btfref.numerics.powers import FLOOR, safe_power
from btfref.numerics.solvers.levenberg import BatchFit, fit_batch
from btfref.numerics.solvers.threads import reproducible
from btfref.precision import real
from btfref.representations.analytic import light_functions
from btfref.representations.analytic.lobe_start import exponent_limit
from btfref.representations.file.schema import LARGEST, MapSchema, Number, Range, Schema
from btfref.representations.lookup import positive_integer, stored
from btfref.representations.protocol import FitMemory

if TYPE_CHECKING:
    from collections.abc import Callable, Collection
    from types import ModuleType

    from numpy.typing import ArrayLike

    from btfref.numerics.solvers.levenberg import Model, Samples
    from btfref.numerics.sphere.directions import DirectionSet
    from btfref.representations.analytic.light_functions import HeldStencils
    from btfref.sampling.blocks import BTFBlocks
    from btfref.types import Facts, JitArray, Progress

    #: A block's fit, and further maps.
    BlockFit = tuple[BatchFit, dict[str, np.ndarray]]
    #: See :func:`fit_texels`.
    FitBlock = Callable[[BTFBlocks, Facts, np.ndarray], BlockFit]


#: See :mod:`btfref.representations.fit_memory`.
FIT_MEMORY = FitMemory(blocks=220 << 20, scales=("lobes",), rows=4, texels=light_functions.BLOCK, texel=400)

#: "paper": Table 1's four lobes, in floats.
PRESETS = {"paper": {"lobes": 4, "storage": "float"}}

#: Largest peak and diffuse albedo relative to the brightest sample of the texel: f exceeds B by 1 / cos 75° = 3.9.
PEAK_BOUND = 4.0

#: Starts of lobes: coefficients, exponent. Forward and backward reflection, broad and narrow, and one about the normal.
STARTS = (
    (-1.0, -1.0, 1.0, 8.0),
    (1.0, 1.0, 1.0, 4.0),
    (0.1, 0.1, 1.0, 2.0),
    (-1.0, -1.0, 1.0, 40.0),
)


class Representation(light_functions.AnalyticMaps):
    """``lobes`` [row, column, 4 k]: coefficients and exponent of each lobe; ``peaks`` [row, column, k];
    ``colour`` [row, column, 4]: chroma and ρ_d in 1/sr; and the direction tables.
    """  # noqa: D205

    EXPONENTS: ClassVar = {"lobes": (3, 4)}

    @classmethod
    def schema(cls, meta: Facts, names: Collection[str]) -> Schema:
        """What its files hold; see :class:`btfref.representations.protocol.HasSchema`."""
        return lobe_schema()

    def evaluate(
        self, uv: ArrayLike, w_light: ArrayLike, w_view: ArrayLike, *, lod: ArrayLike = 0.0
    ) -> np.ndarray:
        """See :meth:`btfref.representations.protocol.Representation.evaluate`; ``lod`` is ignored. Never negative."""
        maps = flat_maps(self.maps)

        def kernel(s: HeldStencils) -> np.ndarray:
            value = texel_values(maps, s)
            return np.einsum("nt,ntc,nt->nc", s.texel_weight, maps["colour"][s.texel, :3], value)

        return light_functions.evaluate_analytic(self, kernel, uv, w_light, w_view)

    def luminance_tables(self, texels: np.ndarray, views: np.ndarray) -> np.ndarray:
        """Model of luminance at measured views and all measured lights, shape (n, n_views, n_lights)."""
        return luminance_tables(self.maps, texels, views)


def lobe_schema(**maps: MapSchema) -> Schema:
    """Maps of lobes, and further ones; see :class:`btfref.representations.protocol.HasSchema`."""
    # Coefficients beyond 1 would make powers that overflow.
    unit, exponent = Range(-1, 1), Range(0, LARGEST)
    own = {
        "lobes": MapSchema(
            "rows columns 4*lobes", parts={(0, 4): unit, (1, 4): unit, (2, 4): unit, (3, 4): exponent}
        ),
        "peaks": MapSchema("rows columns lobes", least=0),
        "colour": MapSchema("rows columns 4"),
    }
    return Schema(own | maps, light_functions.EDGES | {"n_lobes": Number("lobes")})


def flat_maps(maps: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The maps of the texels by flat index, as the definition computes; lobes as (n, k, 4)."""
    names = [name for name in maps if not name.startswith(("view_", "light_"))]
    flat = {name: real(maps[name].reshape(-1, maps[name].shape[-1])) for name in names}
    flat["lobes"] = flat["lobes"].reshape(len(flat["lobes"]), -1, 4)
    return flat


def texel_values(maps: dict[str, np.ndarray], s: HeldStencils) -> np.ndarray:
    """``f l_z`` of each texel of a lookup, shape (N, T)."""
    product = (s.w_light * s.w_view)[:, None, None]
    lobes = maps["lobes"][s.texel]
    power = safe_power((lobes[..., :3] * product).sum(-1), lobes[..., 3])
    return s.w_light[:, None, 2] * (maps["colour"][s.texel, 3] + (maps["peaks"][s.texel] * power).sum(-1))


def luminance_tables(maps: dict[str, np.ndarray], texels: np.ndarray, views: np.ndarray) -> np.ndarray:
    """See :meth:`Representation.luminance_tables`; float32."""
    lights = maps["light_directions"].astype(np.float32)
    product = maps["view_directions"][views].astype(np.float32)[:, None] * lights
    lobes = maps["lobes"].reshape(-1, maps["lobes"].shape[-1] // 4, 4)[texels].astype(np.float32)
    peaks = maps["peaks"].reshape(-1, lobes.shape[1])[texels].astype(np.float32)
    result = maps["colour"].reshape(-1, 4)[texels, 3].astype(np.float32)[:, None, None]
    for j in range(lobes.shape[1]):
        base = np.einsum("nc,vlc->nvl", lobes[:, j, :3], product, optimize=True)
        result = result + peaks[:, j, None, None] * safe_power(base, lobes[:, j, 3, None, None])
    return result * lights[:, 2]


def lafortune_model(
    module: ModuleType,
    data: np.ndarray,
    views: np.ndarray,
    lights: np.ndarray,
    n_lobes: int,
    factor: np.ndarray | None = None,
) -> Model:
    """Residuals and Jacobian for :func:`fit_batch`; a step is a pair of directions.

    Parameters
    ----------
    module : module
        Of :func:`btfref.numerics.solvers.levenberg.backend`.
    data : ndarray of float32, shape (N, n_views, n_lights)
        Luminance.
    views, lights : ndarray, shape (n, 3)
    n_lobes : int
    factor : ndarray of float32, shape (N, n_views), optional
        View-dependent factor of the model.

    Returns
    -------
    callable
        Parameters of each fit: ρ_d; for each lobe the coefficients, natural logarithm of the exponent, peak.
    """
    import drjit as dr

    Float = module.Float
    n_views, n_lights = (dr.opaque(module.UInt32, k) for k in data.shape[1:])
    values = Float(data.ravel())
    product = (views[:, None] * lights[None]).astype(np.float32)
    cosine = np.broadcast_to(lights[None, :, 2:], (*product.shape[:2], 1)).astype(np.float32)
    table = Float(np.concatenate([product, cosine], -1).ravel())
    factor = None if factor is None else Float(np.ascontiguousarray(factor, np.float32).ravel())

    def model(p: list[JitArray], fit: JitArray) -> tuple[Samples, list[JitArray]]:
        lobes, units = [], [Float(1)]
        for j in range(n_lobes):
            *c, log_exponent, peak = p[1 + 5 * j : 6 + 5 * j]
            exponent = dr.exp(log_exponent)
            lobes.append((c, exponent, peak))
            slope = peak * exponent
            units += [slope, slope, slope, slope * 0.6931471805599453, Float(1)]

        def samples(step: JitArray) -> list[tuple[JitArray, list[JitArray]]]:
            *w, scale = dr.gather(module.Array4f, table, step)
            if factor is not None:
                scale = scale * dr.gather(Float, factor, dr.fma(fit, n_views, step // n_lights))
            value, row = p[0] * scale, [scale]
            for c, exponent, peak in lobes:
                base = dr.fma(c[0], w[0], dr.fma(c[1], w[1], c[2] * w[2]))
                there = base > FLOOR
                log = dr.log2(dr.select(there, base, 1))
                # The power less one: the derivative by the coefficients needs it.
                less = dr.select(there, scale * dr.exp2((exponent - 1) * log), 0)
                power = less * base
                value = dr.fma(peak, power, value)
                row += [less * w[0], less * w[1], less * w[2], power * log, power]
            return [(value - dr.gather(Float, values, dr.fma(fit, n_views * n_lights, step)), row)]

        return samples, units

    return model


def bounds(
    luminance: np.ndarray, lights: DirectionSet, n_lobes: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Start, lower and upper bounds of the parameters; luminance (n_views, n_lights, N) -> three (N, 1 + 5 k)."""
    peak = np.maximum(luminance.max((0, 1)), 1e-12)[:, None]
    limit, ones = exponent_limit(lights), np.ones_like(peak)
    start, lower, upper = [0.1 * peak], [0 * peak], [PEAK_BOUND * peak]
    for j in range(n_lobes):
        *coefficients, exponent = STARTS[j % len(STARTS)]
        # A fifth start, if it is wanted, is the first again but twice as sharp.
        exponent = min(exponent * 2 ** (j // len(STARTS)), limit)
        start += [*(c * ones for c in coefficients), np.log(exponent) * ones, 0.2 * peak]
        lower += [-ones, -ones, -ones, 0 * ones, 0 * ones]
        upper += [ones, ones, ones, np.log(limit) * ones, PEAK_BOUND * peak]
    first, low, high = (np.concatenate(c, 1).astype(np.float32) for c in (start, lower, upper))
    return first, low, high


def fit_lafortune(
    luminance: np.ndarray,
    views: DirectionSet,
    lights: DirectionSet,
    n_lobes: int,
    *,
    start: np.ndarray | None = None,
    factor: np.ndarray | None = None,
    iterations: int = 100,
) -> BatchFit:
    """Lobes of N texels.

    Parameters
    ----------
    luminance : ndarray of float32, shape (n_views, n_lights, N)
    views, lights : DirectionSet
    n_lobes : int
    start : ndarray, shape (N, 1 + 5 k), optional
    factor : ndarray, shape (n_views, N), optional
    iterations : int

    Returns
    -------
    btfref.numerics.solvers.levenberg.BatchFit
    """
    from btfref.numerics.solvers.levenberg import backend

    first, lower, upper = bounds(luminance, lights, n_lobes)
    factor = None if factor is None else factor.T
    model = lafortune_model(
        backend(), np.moveaxis(luminance, 2, 0), views.vectors, lights.vectors, n_lobes, factor
    )
    n_samples = len(views) * len(lights)
    start = first if start is None else start
    # Sums over thousands of samples in float32 leave 1e-6 of the cost undetermined.
    return fit_batch(model, start, lower, upper, n_samples, iterations=iterations, ftol=1e-5)


def lobe_maps(parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Maps of fitted parameters (N, 1 + 5 k): lobes (N, 4 k), peaks (N, k), ρ_d (N,).

    Coefficients are scaled to a largest magnitude of 1 and the peak makes up for it: what is stored is unique, and as
    exact in halves as it can be.
    """
    lobes = parameters[:, 1:].reshape(len(parameters), -1, 5).astype(float)
    exponent = np.exp(lobes[..., 3])
    largest = np.abs(lobes[..., :3]).max(-1)
    safe = np.where(largest > FLOOR, largest, 1)
    peaks = lobes[..., 4] * safe_power(np.minimum(largest, 1), exponent)
    lobes = np.concatenate([lobes[..., :3] / safe[..., None], exponent[..., None]], -1)
    return lobes.reshape(len(parameters), -1), peaks, parameters[:, 0]


@reproducible()
def fit(
    btf: BTFBlocks,
    *,
    seed: int = 0,
    progress: Progress | None = None,
    lobes: int = 4,
    storage: str = "half",
    filter_type: str = "bilinear",
) -> Representation:
    """Fit Lafortune lobes to each texel of ``btf`` by batched Levenberg–Marquardt.

    Parameters
    ----------
    btf : BTFBlocks
    seed : int
        Unused: nothing is random.
    progress : callable, optional
        ``progress(done, total, label)``.
    lobes : int
        Per texel, at least 1.
    storage : {"half", "float"}
        Type of the stored maps.
    filter_type : {"bilinear", "nearest"}
        Lookup between texels.

    Returns
    -------
    Representation
        ``meta["fit"]`` holds ``epsilon`` (see :func:`light_functions.fit_report`), the counts of
        :attr:`btfref.numerics.solvers.levenberg.BatchFit.summary` ``not_converged_at``, up to 1000 texels,
        and ``memory`` (see :func:`light_functions.memory_report`).

    Raises
    ------
    InputError
        For parameters out of range, or values that are not finite or do not fit ``storage``.
    MissingDependencyError
        Without LLVM or CUDA.
    """
    n_lobes = positive_integer("lobes", lobes)
    parameters = {"lobes": n_lobes, "storage": storage, "seed": seed}
    return fit_texels(Representation, "lafortune", btf, _lobes, parameters, progress, storage, filter_type)


def _lobes(btf: BTFBlocks, parameters: Facts, luminance: np.ndarray) -> BlockFit:
    """A block's lobes."""
    return fit_lafortune(luminance, btf.views, btf.lights, parameters["lobes"]), {}


def fit_texels(
    made: type[light_functions.M],
    method: str,
    btf: BTFBlocks,
    fit_block: FitBlock,
    parameters: Facts,
    progress: Progress | None,
    storage: str,
    filter_type: str,
) -> light_functions.M:
    """A representation from a fit of one Lafortune model a texel.

    Parameters
    ----------
    fit_block : callable
        ``(btf, parameters, luminance (n_views, n_lights, n)) -> (BatchFit, {name: (n, width) further maps})``, a
        function of a module.
    """
    rows, columns = btf.texels
    blocks, fits = [], []
    task = fit_block, parameters
    for _, (result, further, chroma) in light_functions.over_luminance(
        btf, _fit_block, task, progress, "lobes"
    ):
        lobes, peaks, diffuse = lobe_maps(result.parameters)
        colour = np.concatenate([chroma, diffuse[:, None]], 1)
        blocks.append({"lobes": lobes, "peaks": peaks, "colour": colour} | further)
        fits.append(result)
    maps = {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}
    maps = {name: stored(name, array.reshape(rows, columns, -1), storage) for name, array in maps.items()}
    everything = BatchFit(
        *(np.concatenate([getattr(f, name) for f in fits]) for name in BatchFit.__dataclass_fields__)
    )
    failed = np.flatnonzero(~everything.converged)
    return light_functions.finished(
        made,
        method,
        btf,
        maps,
        parameters,
        filter_type=filter_type,
        constants={"n_lobes": parameters["lobes"]},
        facts=everything.summary | {"not_converged_at": failed[:1000].tolist()},
        by_view=False,
    )


def _fit_block(
    btf: BTFBlocks,
    task: tuple[FitBlock, Facts],
    part: slice,
    luminance: np.ndarray,
    chroma: np.ndarray,
) -> tuple[BatchFit, dict[str, np.ndarray], np.ndarray]:
    """A block's fit, further maps and chroma."""
    fit_block, parameters = task
    return *fit_block(btf, parameters, luminance), chroma
