"""Reflectance fields as a diffuse term and a few cosine lobes per texel and measured view.

Source: J. Meseth, G. Müller, R. Klein, "Reflectance Field Based Real-Time, High-Quality Rendering of Bidirectional
Texture Functions", Computers & Graphics 2004, eq. 1 ("RFNL"): ``ρ_d(x) + ρ_{s,v}(x) Σ_j (t_{v,j}(x) · l)^{n_{v,j}(x)}``
of luminance, times the texel's chroma.

Differs from eq. 1 in two points. The data hold the cosine of the light, so the diffuse term is ``ρ_d l_z``, which is
what eq. 4 makes of it; the lobes are fitted to the data as they are. And a lobe is stored as unit axis, exponent and
peak ``ρ_s ‖t‖^n`` instead of ``ρ_s`` and ``t``: the same functions, but no stored number can overflow when it is raised
to a power.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from btfref.errors import InputError
from btfref.numerics.powers import FLOOR, safe_power, unit_lobe
from btfref.numerics.solvers.levenberg import fit_batch
from btfref.numerics.solvers.threads import reproducible
from btfref.precision import real
from btfref.representations.analytic import light_functions
from btfref.representations.analytic.lobe_start import (
    exponent_limit,
    lobe_starts,
    tilted_starts,
)
from btfref.representations.file.schema import LARGEST, MapSchema, Number, Range, Schema
from btfref.representations.lookup import positive_integer, stored
from btfref.representations.protocol import FitMemory

if TYPE_CHECKING:
    from collections.abc import Collection
    from types import ModuleType

    from numpy.typing import ArrayLike

    from btfref.numerics.solvers.levenberg import BatchFit, Model, Samples
    from btfref.numerics.sphere.directions import DirectionSet
    from btfref.representations.analytic.light_functions import HeldStencils
    from btfref.sampling.blocks import BTFBlocks
    from btfref.types import Facts, JitArray, Progress


#: See :mod:`btfref.representations.fit_memory`.
FIT_MEMORY = FitMemory(blocks=560 << 20, scales=("lobes",), rows=4, texels=light_functions.BLOCK, field=75)

#: "paper": two lobes in floats.
PRESETS = {"paper": {"lobes": 2, "storage": "float"}}

#: Parabolic coordinates of a lobe's axis stay within ± this: axes may dip below the horizon, where raised structure
#: keeps brightening towards grazing light, but not reach the pole of the map.
AXIS_BOUND = 1.5

#: Parabolic coordinates that a file may hold: their squares stay within float32.
LARGEST_AXIS = 1e6

#: Least exponent: below 1 a lobe's slope is infinite where it ends, and no interpolation of rounded numbers agrees.
LEAST_EXPONENT = 1.0

#: Largest peak of a lobe relative to the brightest sample of its fit. An axis midway between samples, at the largest
#: exponent, needs 2; axes beyond the samples more.
PEAK_BOUND = 4.0

#: Share of the fits, those that leave most, that are tried from other starts as well.
SECOND_CHANCE = 0.15

#: See :func:`fit_batch`. 1e-5 takes a fifth more iterations and lowers the mean residual by 0.2 %; a second start for
#: more fits lowers it further for that time.
FTOL = 1e-4

#: The diffuse albedo of a texel is this quantile of luminance / l_z over its samples: what is there almost always.
#: Lobes add to it and cannot take away.
DIFFUSE_QUANTILE = 0.1


class Representation(light_functions.AnalyticMaps):
    """``lobes`` [row, column, view, 4 k]: parabolic axis (s, t), exponent, peak of each; ``colour`` [row, column, 4]:
    chroma and diffuse albedo ρ_d in 1/sr; and the direction tables.
    """  # noqa: D205

    #: Maps by view; see :mod:`btfref.representations.file.resident`.
    DIRECTION_AXES: ClassVar = {"view": {"lobes": 2}}
    DRAWS_VIEWS: ClassVar = True
    ROWS_BY: ClassVar = {"lobes": (2,)}
    EXPONENTS: ClassVar = {"lobes": (2, 4)}

    @classmethod
    def schema(cls, meta: Facts, names: Collection[str]) -> Schema:
        """What its files hold; see :class:`btfref.representations.protocol.HasSchema`."""
        axis, positive = Range(-LARGEST_AXIS, LARGEST_AXIS), Range(0, LARGEST)
        parts = {(0, 4): axis, (1, 4): axis, (2, 4): positive, (3, 4): positive}
        maps = {
            "lobes": MapSchema("rows columns views 4*lobes", parts=parts),
            "colour": MapSchema("rows columns 4"),
        }
        return Schema(maps, light_functions.EDGES | {"n_lobes": Number("lobes")})

    def evaluate(
        self,
        uv: ArrayLike,
        w_light: ArrayLike,
        w_view: ArrayLike,
        *,
        lod: ArrayLike = 0.0,
        draw: ArrayLike | None = None,
    ) -> np.ndarray:
        """See :meth:`btfref.representations.protocol.DrawsViews.evaluate`; ``lod`` is ignored. Never negative."""
        lobes = self._lobes()
        colour = real(self.maps["colour"].reshape(-1, 4))

        def kernel(s: HeldStencils) -> np.ndarray:
            index = (s.texel[:, :, None], s.view[:, None, :])
            value = lobe_sum(real(lobes[index]), s.w_light[:, None, None, None])
            value = np.einsum("ntv,nt,nv->nt", value, s.texel_weight, s.view_weight)
            at = colour[s.texel]
            value += s.texel_weight * at[..., 3] * s.w_light[:, None, 2]
            return np.einsum("nt,ntc->nc", value, at[..., :3])

        return light_functions.evaluate_analytic(self, kernel, uv, w_light, w_view, draw=draw)

    def _lobes(self) -> np.ndarray:
        """Lobes by flat texel and view, shape (n_texels, n_views, k, 4)."""
        lobes = self.maps["lobes"]
        return lobes.reshape(-1, lobes.shape[2], lobes.shape[3] // 4, 4)

    def luminance_tables(self, texels: np.ndarray, views: np.ndarray) -> np.ndarray:
        """Model of luminance at measured views and all measured lights, shape (n, n_views, n_lights)."""
        lights = self.maps["light_directions"].astype(np.float32)
        s, t, exponent, peak = np.moveaxis(self._lobes()[texels[:, None], views].astype(np.float32), -1, 0)
        axis = parabolic_axis(s, t)
        colour = self.maps["colour"].reshape(-1, 4).astype(np.float32)[texels]
        result = colour[:, 3, None, None] * lights[:, 2]
        for j in range(s.shape[-1]):
            power = safe_power(np.minimum(axis[:, :, j] @ lights.T, 1), exponent[:, :, j, None])
            result = result + peak[:, :, j, None] * power
        return result


def parabolic_axis(s: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Unit vectors of parabolic coordinates, on the whole sphere but for its lower pole; (...) -> (..., 3)."""
    r2 = s * s + t * t
    return np.stack([2 * s, 2 * t, 1 - r2], -1) / (1 + r2)[..., None]


def lobe_sum(lobes: np.ndarray, w_light: np.ndarray) -> np.ndarray:
    """``Σ_j peak_j (axis_j · l)^{n_j}``; (..., k, 4), (..., 1, 3) -> (...)."""
    s, t, exponent, peak = np.moveaxis(lobes, -1, 0)
    return (peak * unit_lobe(parabolic_axis(s, t), w_light, exponent)).sum(-1)


def lobe_model(module: ModuleType, data: np.ndarray, lights: np.ndarray, n_lobes: int) -> tuple[Model, int]:
    """Residuals and Jacobian of lobes for :func:`fit_batch`, and the number of its steps.

    Parameters
    ----------
    module : module
        Of :func:`btfref.numerics.solvers.levenberg.backend`.
    data : ndarray of float32, shape (N, n_lights)
        Luminance of N fits.
    lights : ndarray, shape (n_lights, 3)
    n_lobes : int

    Returns
    -------
    model : callable
        Parameters of each lobe: s, t, natural logarithm of the exponent, peak.
    n_steps : int
    """
    import drjit as dr

    Float = module.Float
    # Four samples at a time: a gather of four neighbours costs little more than one of a single number. Lights of
    # length zero fill up: all lobes are 0 there.
    fill = -len(lights) % 4
    n_steps = (len(lights) + fill) // 4
    values = Float(np.pad(data, ((0, 0), (0, fill))).ravel())
    table = np.pad(np.asarray(lights, np.float32), ((0, fill), (0, 0))).reshape(n_steps, 4, 3)
    table = Float(np.ascontiguousarray(table.transpose(0, 2, 1)).ravel())
    steps = dr.opaque(module.UInt32, n_steps)

    def model(p: list[JitArray], fit: JitArray) -> tuple[Samples, list[JitArray]]:
        shapes, units = [], []
        for j in range(n_lobes):
            s, t, log_exponent, peak = p[4 * j : 4 * j + 4]
            scale = dr.rcp(1 + s * s + t * t)
            exponent = dr.exp(log_exponent)
            # The axis is (2 s, 2 t, 2 − D) / D with D = 1 + s² + t².
            shapes.append((s, t, (2 * s * scale, 2 * t * scale, 2 * scale - 1), exponent, peak))
            slope = 2 * scale * peak * exponent
            units += [slope, slope, peak * exponent * 0.6931471805599453, Float(1)]

        def samples(step: JitArray) -> list[tuple[JitArray, list[JitArray]]]:
            x, y, z = (dr.gather(module.Array4f, table, 3 * step + i) for i in range(3))
            wanted = dr.gather(module.Array4f, values, dr.fma(fit, steps, step))
            return [sample((x[i], y[i], z[i]), wanted[i]) for i in range(4)]

        def sample(
            light: tuple[JitArray, JitArray, JitArray], wanted: JitArray
        ) -> tuple[JitArray, list[JitArray]]:
            r, row = -wanted, []
            for s, t, axis, exponent, peak in shapes:
                cosine = dr.fma(axis[0], light[0], dr.fma(axis[1], light[1], axis[2] * light[2]))
                there = cosine > FLOOR
                log = dr.log2(dr.select(there, cosine, 1))
                # The power less one: the derivative by the axis needs it, and a product is all that is left.
                less = dr.select(there, dr.exp2((exponent - 1) * log), 0)
                power = less * cosine
                r = dr.fma(peak, power, r)
                along = cosine + light[2]
                row += [less * dr.fma(-s, along, light[0]), less * dr.fma(-t, along, light[1])]
                row += [power * log, power]
            return r, row

        return samples, units

    return model, n_steps


@reproducible()
def fit(
    btf: BTFBlocks,
    *,
    seed: int = 0,
    progress: Progress | None = None,
    lobes: int = 2,
    diffuse_quantile: float = DIFFUSE_QUANTILE,
    storage: str = "half",
    filter_type: str = "bilinear",
) -> Representation:
    """Fit lobes to ``btf`` by batched Levenberg–Marquardt.

    Fits that do not converge, and those that leave most, are repeated from a second start; the better result is kept.
    Fits that have converged from neither are listed.

    Parameters
    ----------
    btf : BTFBlocks
    seed : int
        Unused: nothing is random.
    progress : callable, optional
        ``progress(done, total, label)``.
    lobes : int
        Per texel and view, at least 1.
    diffuse_quantile : float
        Quantile of luminance / l_z that becomes the diffuse albedo of a texel, [0, 1].
    storage : {"half", "float"}
        Type of the stored maps.
    filter_type : {"bilinear", "nearest"}
        Lookup between texels.

    Returns
    -------
    Representation
        ``meta["fit"]`` holds ``epsilon`` (see :func:`light_functions.fit_report`), the counts of
        :attr:`btfref.numerics.solvers.levenberg.BatchFit.summary`, ``not_converged_at``: up to 1000 pairs (texel,
        view), and ``memory`` (see :func:`light_functions.memory_report`).

    Raises
    ------
    InputError
        For parameters out of range, or values that are not finite or do not fit ``storage``.
    MissingDependencyError
        Without LLVM or CUDA.
    """
    n_lobes = positive_integer("lobes", lobes)
    if not 0 <= diffuse_quantile <= 1:
        raise InputError(
            "a parameter is out of range", field="diffuse_quantile", got=diffuse_quantile, expected="0 to 1"
        )
    n_views, (rows, columns) = len(btf.views), btf.texels
    maps: dict[str, np.ndarray] = {
        "lobes": np.zeros((rows * columns, n_views, 4 * n_lobes), np.float32),
        "colour": np.zeros((rows * columns, 4), np.float32),
    }
    summaries, failed = [], []
    settings = n_lobes, float(diffuse_quantile)
    for part, block in light_functions.over_luminance(btf, _lobes_of_block, settings, progress, "lobes"):
        maps["lobes"][part], maps["colour"][part], summary, without = block
        summaries.append(summary)
        failed += without
    shapes = {"lobes": (rows, columns, n_views, -1), "colour": (rows, columns, 4)}
    maps = {name: stored(name, array.reshape(shapes[name]), storage) for name, array in maps.items()}
    return light_functions.finished(
        Representation,
        "rf_lobes",
        btf,
        maps,
        {"lobes": n_lobes, "diffuse_quantile": diffuse_quantile, "storage": storage, "seed": seed},
        filter_type=filter_type,
        constants={"n_lobes": n_lobes},
        facts=merged(summaries) | {"not_converged_at": failed[:1000]},
        by_view=True,
    )


def _lobes_of_block(
    btf: BTFBlocks, settings: tuple[int, float], part: slice, luminance: np.ndarray, chroma: np.ndarray
) -> tuple[np.ndarray, np.ndarray, Facts, list[list[int]]]:
    """Lobes (n, view, 4 n_lobes) and colours of a block's texels, a summary, and pairs that did not converge."""
    n_lobes, quantile = settings
    diffuse = diffuse_albedo(luminance, btf.lights.vectors, quantile)
    data = luminance - (diffuse * btf.lights.vectors[:, 2, None]).astype(np.float32)
    n_views, _, n = data.shape
    found = fit_lobes(data.swapaxes(1, 2).reshape(n_views * n, -1), btf.lights, n_lobes)
    numbers = found.parameters.reshape(n_views, n, 4 * n_lobes)
    numbers[..., 2::4] = np.exp(numbers[..., 2::4])
    view, texel = np.divmod(np.flatnonzero(~found.converged), n)
    without = np.stack([texel + part.start, view], 1).tolist()
    return numbers.swapaxes(0, 1), np.concatenate([chroma, diffuse[:, None]], 1), found.summary, without


def merged(summaries: list[Facts]) -> Facts:
    """One summary of several batches."""
    fits = sum(s["fits"] for s in summaries)
    result = {key: sum(s[key] for s in summaries) for key in ("fits", "converged", "not_converged")}
    result["ends"] = {kind: sum(s["ends"][kind] for s in summaries) for kind in summaries[0]["ends"]}
    result["mean_iterations"] = sum(s["mean_iterations"] * s["fits"] for s in summaries) / max(fits, 1)
    return result


def diffuse_albedo(luminance: np.ndarray, lights: np.ndarray, quantile: float) -> np.ndarray:
    """ρ_d of each texel: a quantile of luminance / l_z; (n_views, n_lights, n) -> (n,)."""
    # Grazing lights would amplify noise: 0.2 leaves out what is below 78 degrees.
    high = lights[:, 2] > 0.2
    if not high.any():
        return np.zeros(luminance.shape[2])
    ratio = luminance[:, high] / lights[high, 2, None].astype(np.float32)
    return np.maximum(
        np.quantile(ratio.reshape(-1, ratio.shape[2]), quantile, axis=0, overwrite_input=True), 0
    )


def lobe_bounds(data: np.ndarray, lights: DirectionSet, n_lobes: int) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of the parameters of N fits, two arrays of shape (N, 4 n_lobes)."""
    peak = PEAK_BOUND * np.maximum(data.max(1), 0)[:, None]
    ones, limit = np.ones_like(peak), np.log(exponent_limit(lights))
    lower = [-AXIS_BOUND * ones, -AXIS_BOUND * ones, np.log(LEAST_EXPONENT) * ones, 0 * ones]
    upper = [AXIS_BOUND * ones, AXIS_BOUND * ones, limit * ones, peak]
    low, high = (np.tile(np.concatenate(columns, 1), n_lobes) for columns in (lower, upper))
    return low, high


def fit_lobes(
    data: np.ndarray,
    lights: DirectionSet,
    n_lobes: int,
    *,
    iterations: int = 100,
    high_pass: bool = False,
    restart: bool = True,
) -> BatchFit:
    """Lobes of N reflectance fields.

    Parameters
    ----------
    data : ndarray of float32, shape (N, n_lights)
        Luminance without its diffuse term.
    lights : DirectionSet
    n_lobes : int
    iterations : int
    high_pass : bool
        Whether the first start is the paper's; the second is the other one. See :func:`lobe_starts`.
    restart : bool
        Whether fits that did not converge, and those that leave most, have a second and a third start.

    Returns
    -------
    btfref.numerics.solvers.levenberg.BatchFit
        Parameters (s, t, natural logarithm of the exponent, peak) of each lobe.
    """
    from btfref.numerics.solvers.levenberg import backend

    module = backend()

    def run(data: np.ndarray, start: np.ndarray, steps: int) -> BatchFit:
        model, n_steps = lobe_model(module, data, lights.vectors, n_lobes)
        bounds = lobe_bounds(data, lights, n_lobes)
        return fit_batch(model, start, *bounds, n_steps, iterations=steps, ftol=FTOL)

    result = run(data, lobe_starts(data, lights.vectors, n_lobes, high_pass=high_pass), iterations)
    if not restart:
        return result
    worst = result.cost > np.quantile(result.cost, 1 - SECOND_CHANCE)
    again = np.flatnonzero(~result.converged | worst)
    if not len(again):
        return result
    some = data[again]
    starts = (
        lambda: lobe_starts(some, lights.vectors, n_lobes, high_pass=not high_pass),
        lambda: tilted_starts(some, lights.vectors, result.parameters[again]),
    )
    for start in starts:
        second = run(some, start(), 2 * iterations)
        lower_cost = second.cost < result.cost[again]
        better = np.where(second.converged == result.converged[again], lower_cost, second.converged)
        for name in ("parameters", "cost", "status", "iterations"):
            getattr(result, name)[again[better]] = getattr(second, name)[better]
    return result
