"""Answers of geometry: independent paths for every row, each with a footprint, a view and a light of its own.

A sample is a random point of the row's footprint on the sampling plane z = 0; the ray through it along −w_view finds
the first surface point, so that oblique views get their exact sheared footprint. At every vertex of the path the row's
light is connected. Nothing is shared: samples are independent of each other, within a row and between rows (those of
`btfref.querying.shared_paths` are not, between rows). One kernel traces a vertex of all paths of a batch, and those
that go on are packed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from btfref.numerics.device_arrays import to_device
from btfref.querying.footprints import device_offset
from btfref.querying.settings import LEAST, PILOT
from btfref.sampling.paths.adaptive import FLOOR, MARGIN
from btfref.sampling.paths.estimator import PathEstimator
from btfref.sampling.tiled_scene import START, stream_keys, uniforms

if TYPE_CHECKING:
    from btfref.mesostructure.base import Mesostructure
    from btfref.querying.settings import QuerySettings
    from btfref.types import JitArray

#: Paths that are traced together; a bound on memory, without influence on the result.
LANES = 1 << 20

#: The patch of tiles reaches as far as shadows of lights at this polar angle; beyond it rays are wrapped.
REACH = np.radians(75)

#: First sample of a pilot: the estimate has other ones.
_PILOT_SAMPLES = 1 << 31

#: Rows whose pilot says how bright the whole is.
_FIRST_ROWS = 4096


class RowPaths(PathEstimator):
    """Samples of rows by path tracing.

    Parameters
    ----------
    mesostructure : Mesostructure
    settings : QuerySettings
    stream : int
        Selects other random numbers.

    Notes
    -----
    Build and use it inside one `mitsuba_variant` block.
    """

    def __init__(self, mesostructure: Mesostructure, settings: QuerySettings, stream: int = 0) -> None:
        reach = np.array([[np.sin(REACH), 0, np.cos(REACH)]])
        super().__init__(
            mesostructure,
            reach,
            texels=(1, 1),
            spp=settings.samples,
            seed=settings.seed,
            max_depth=settings.max_depth,
            views=reach,
        )
        # Lights of any row: some are lower.
        self.tiles.wrap_shadows = self.tiles.low < 0
        self.footprint = settings.footprint
        self._words = stream_keys(settings.seed, stream)
        self._layout: tuple[int, int] = (0, 0)

    def samples(
        self, rows: Mapping[str, np.ndarray], number: np.ndarray, count: int, first: int = 0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Mean and variance of the mean of some rows, each from as many samples.

        Parameters
        ----------
        rows : dict of ndarray
            ``uv`` (n, 2), ``radius`` (n,), ``w_light``, ``w_view`` (n, 3).
        number : ndarray (n,) of int
            Of the rows in the whole set: they select the random numbers.
        count : int
            Samples of each row.
        first : int
            Number of the first sample.

        Returns
        -------
        mean, variance : ndarray (n, 3), float32
            NaN for the variance of a single sample.
        """
        mean, variance = (np.zeros((len(number), 3), np.float32) for _ in range(2))
        step = max(1, LANES // count)
        for start in range(0, len(number), step):
            part = slice(start, start + step)
            found = self._pass({k: v[part] for k, v in rows.items()}, number[part], count, first)
            mean[part], variance[part] = found
        return mean, variance

    def _pass(
        self, rows: Mapping[str, np.ndarray], number: np.ndarray, count: int, first: int
    ) -> tuple[np.ndarray, np.ndarray]:
        import drjit as dr
        import mitsuba as mi

        n = len(number)
        if self._layout != (n, count):
            self._row = to_device(mi.UInt32, np.repeat(np.arange(n), count))
            self._sample = to_device(mi.UInt32, np.tile(np.arange(count), n))
            # A buffer for each channel: several scatters to one would be several kernels.
            self._channels = [dr.empty(mi.Float, self._answers(n) * count) for _ in range(3)]
            self._layout = (n, count)
        self._first = dr.opaque(mi.UInt32, first)
        self._number = to_device(mi.UInt32, number)
        self._uv, self._radius, self._lights, self._views = (
            to_device(mi.Float, rows[name]) for name in ("uv", "radius", "w_light", "w_view")
        )
        lane = dr.arange(mi.UInt32, n * count)
        self._trace(lane, dr.gather(mi.Vector3f, self._views, self._row_of(lane)))
        dr.eval(self._channels)
        samples = [channel.numpy().reshape(-1, count) for channel in self._channels]
        mean = np.stack([values.mean(1) for values in samples], -1)
        if count == 1:
            return mean, np.full(mean.shape, np.nan, np.float32)
        return mean, np.stack([values.var(1, ddof=1) for values in samples], -1) / np.float32(count)

    def _answers(self, n: int) -> int:
        """Means that a pass over n rows of the tables finds."""
        return n

    def _row_of(self, lane: JitArray) -> JitArray:
        import drjit as dr

        return dr.gather(type(lane), self._row, lane)

    def _stream(self, lane: JitArray) -> JitArray:
        import drjit as dr

        return dr.gather(type(lane), self._number, self._row_of(lane))

    def _keys(self, lane: JitArray) -> list[JitArray]:
        """Words that select the sample: every row has streams of its own."""
        import drjit as dr

        sample = dr.gather(type(lane), self._sample, lane)
        return [self._words[0], self._words[1] + self._first + sample]

    def _footprint(self, lane: JitArray, keys: Sequence[JitArray], w_view: JitArray) -> JitArray:
        """Start of the view rays: a random point of the row's footprint, moved up along w_view."""
        import drjit as dr
        import mitsuba as mi

        row = self._row_of(lane)
        uv, radius = dr.gather(mi.Point2f, self._uv, row), dr.gather(mi.Float, self._radius, row)
        u, v, _, _ = uniforms(self._stream(lane), keys, mi.UInt32(0))
        x, y = device_offset(self.footprint, u, v)
        return dr.fma(mi.Vector3f(w_view), START, mi.Point3f(uv.x + radius * x, uv.y + radius * y, 0))

    def _connect(
        self,
        interaction: JitArray,
        bsdf: JitArray,
        context: JitArray,
        throughput: JitArray,
        lane: JitArray,
        active: JitArray,
        *,
        first_vertex: bool,
    ) -> None:
        """Add throughput · f cos · visibility of the row's light to the samples."""
        import drjit as dr
        import mitsuba as mi

        w_light = dr.gather(mi.Vector3f, self._lights, self._row_of(lane))
        value, lit = self._light(interaction, bsdf, context, throughput, w_light, active)
        for channel, buffer in enumerate(self._channels):
            if first_vertex:
                dr.scatter(buffer, dr.select(lit, value[channel], 0), lane)
            else:
                dr.scatter_add(buffer, value[channel], lane, lit, mode=dr.ReduceMode.NoConflicts)


class PathSource:
    """Answers of a mesostructure.

    Parameters
    ----------
    mesostructure : Mesostructure
    settings : QuerySettings
    stream : int
        Selects other random numbers for the same rows.
    """

    def __init__(self, mesostructure: Mesostructure, settings: QuerySettings, stream: int = 0) -> None:
        self.settings = settings
        from btfref.querying.shared_paths import SharedPaths

        kind = RowPaths if settings.lights_per_path == 1 else SharedPaths
        self.paths = kind(mesostructure, settings, stream)
        self._brightness: float | None = None

    def answer(self, rows: Mapping[str, np.ndarray], number: np.ndarray) -> dict[str, np.ndarray]:
        """B, its variance and the samples of some rows.

        Parameters
        ----------
        rows : dict of ndarray
            Of `btfref.querying.laws.Laws.rows`.
        number : ndarray (n,) of int
            Of the rows in the whole set.

        Returns
        -------
        dict of str to ndarray
            ``B``, ``variance`` (n, 3) float32, ``samples`` (n,) uint32.
        """
        if self.settings.target_error is None:
            counts = np.full(len(number), self.settings.samples)
        else:
            counts = self._counts(rows, number)
        mean, variance = (np.zeros((len(number), 3), np.float32) for _ in range(2))
        for count in np.unique(counts):
            here = np.flatnonzero(counts == count)
            part = rows if len(here) == len(number) else {k: v[here] for k, v in rows.items()}
            mean[here], variance[here] = self.paths.samples(part, number[here], int(count))
        return {"B": mean, "variance": variance, "samples": counts.astype(np.uint32)}

    def _counts(self, rows: Mapping[str, np.ndarray], number: np.ndarray) -> np.ndarray:
        """Samples of rows to a target error, from a pilot of other samples: see `btfref.sampling.paths.adaptive`."""
        target = self.settings.target_error
        assert target is not None
        if self._brightness is None:
            first = np.arange(min(self.settings.n, _FIRST_ROWS))
            some = self.settings.laws.rows(self.settings.seed, 0, len(first))
            pilot, _ = self.paths.samples(some, first, PILOT, _PILOT_SAMPLES)
            self._brightness = float(pilot.mean(dtype=np.float64))
        mean, variance = self.paths.samples(rows, number, PILOT, _PILOT_SAMPLES)
        level = np.maximum(mean.mean(-1, dtype=np.float64), FLOOR * self._brightness)
        spread = PILOT * variance.mean(-1, dtype=np.float64)
        wanted = MARGIN * spread / np.maximum(target * level, 1e-30) ** 2
        wanted = np.clip(wanted, LEAST, self.settings.samples)
        power = LEAST * 2 ** np.ceil(np.log2(wanted / LEAST) - 1e-9)
        return np.minimum(power.astype(np.int64), self.settings.samples)


def path_facts(mesostructure: Mesostructure) -> dict[str, Any]:
    """What a file says of its source."""
    from btfref.sampling.job import fingerprint

    return {
        "kind": "mesostructure",
        "name": mesostructure.name,
        "parameters": mesostructure.parameters,
        "geometry": fingerprint(mesostructure),
    }
