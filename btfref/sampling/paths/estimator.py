"""The reference estimator of a synthetic BTF: paths from the view side, each shared by all lights.

A sample of texel t and view v is a uniform point in the texel's square on the sampling plane z = 0 (the top
of the mesostructure); the ray through it along −w_view finds the first surface point, so that oblique views
get their exact sheared footprint. At every vertex of the path all lights are connected by a shadow ray and
the BSDF, which gives one number per light from one path. A light has unit irradiance perpendicular to its
direction: the result is B = f · cos θ_light in 1/sr with shadows, masking and interreflection. Vertices are
the same for all lights, so the lights of a texel are correlated, its samples are not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from btfref.numerics.device_arrays import to_device
from btfref.sampling.tiled_scene import TiledScene, uniforms

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from btfref.mesostructure.base import Mesostructure
    from btfref.types import JitArray

#: Memory (bytes) of the sample buffer of one pass; reduction needs about three times that.
SAMPLE_BUFFER = 96 << 20

#: First vertex (1 = the visible one) at which Russian roulette may end a path.
ROULETTE_VERTEX = 3

#: Largest probability of survival.
ROULETTE_LIMIT = 0.95


def strata(spp: int) -> tuple[int, int, int]:
    """How the samples of one texel are stratified over its square.

    Each stratum holds m ≥ 2 independent samples, m the smallest prime factor of ``spp``; the spread inside
    the strata then gives an unbiased variance of the stratified mean.

    Parameters
    ----------
    spp : int
        Samples per texel, at least 2.

    Returns
    -------
    columns, rows, per_stratum : int
        ``columns * rows * per_stratum == spp``.
    """
    per_stratum = next(m for m in range(2, spp + 1) if spp % m == 0)
    n = spp // per_stratum
    rows = next(k for k in range(math.isqrt(n), 0, -1) if n % k == 0)
    return n // rows, rows, per_stratum


@dataclass
class Piece:
    """Lanes of one pass that share a view and its lights.

    Attributes
    ----------
    w_view : ndarray, shape (3,)
    keys : sequence of two int
        Random stream.
    lights : ndarray, shape (n_lit, 3)
        Above the horizon, at least one.
    n_lanes : int
    """

    w_view: np.ndarray
    keys: tuple[int, int]
    lights: np.ndarray
    n_lanes: int

    @property
    def size(self) -> int:
        """Numbers of the sample buffer: [light, channel, lane]."""
        return 3 * len(self.lights) * self.n_lanes


class PathEstimator:
    """Samples of lanes, each with a view and lights of its own, by path tracing with light connections.

    Subclasses say which texel a lane belongs to (`_footprint`) and which random stream it has (`_stream`).

    Parameters
    ----------
    mesostructure : Mesostructure
    lights : ndarray, shape (n_lights, 3)
        Unit vectors.
    texels : tuple of int
        Rows and columns.
    spp : int
        Samples per texel and view, at least 2.
    seed : int
    max_depth : int
        As in Mitsuba's path integrator: 2 is direct light only, −1 has no limit.
    views : ndarray, shape (n_views, 3)
    wanted : sequence of int, optional
        Not used: views are independent of each other.
    mask : ndarray (rows · columns,) bool, optional
        Texels that are asked for; the others may be left 0.

    Notes
    -----
    Build and use it inside one `mitsuba_variant` block. Masks let the light through. Light that reaches a point
    through delta lobes that turn it (smooth glass) is missing, as in every path tracer with delta lights.
    """

    key = "path"

    def __init__(
        self,
        mesostructure: Mesostructure,
        lights: ArrayLike,
        *,
        texels: Sequence[int],
        spp: int,
        seed: int,
        max_depth: int,
        views: np.ndarray,
        wanted: Sequence[int] | None = None,
        mask: np.ndarray | None = None,
    ) -> None:
        rows, columns = texels
        self.texels, self.spp, self.seed = (int(rows), int(columns)), int(spp), int(seed)
        self.max_depth, self.views, self.mask = int(max_depth), views, mask
        self.lights = np.asarray(lights, dtype=np.float64)
        self.tiles = TiledScene(mesostructure, self.lights)
        self._buffer: JitArray = None

    def _stream(self, lane: JitArray) -> JitArray:
        """Random stream of each lane."""
        raise NotImplementedError

    def _footprint(self, lane: JitArray, keys: Sequence[JitArray], w_view: JitArray) -> JitArray:
        """Start of each lane's view ray."""
        raise NotImplementedError

    def _paths(self, pieces: Sequence[Piece]) -> None:
        """Fill the buffer with the samples of one pass: lanes and samples of its pieces one after the other."""
        import drjit as dr
        import mitsuba as mi

        size = sum(piece.size for piece in pieces)
        if self._buffer is None or dr.width(self._buffer) != size:
            # Touching new memory costs as much as filling it: one buffer serves all passes of a size.
            self._buffer = dr.empty(mi.Float, size)
        self._tell(pieces)
        # Everything that changes between passes is in arrays: one kernel then serves all of them.
        lane = dr.arange(mi.UInt32, sum(piece.n_lanes for piece in pieces))
        self._trace(lane, dr.gather(mi.Vector3f, self._views, dr.gather(mi.UInt32, self._piece, lane)))

    def _trace(self, lane: JitArray, w_view: JitArray) -> None:
        """Trace one path a lane, seen along its view, and connect its vertices."""
        import drjit as dr
        import mitsuba as mi

        origin = self._footprint(lane, self._keys(lane), w_view)
        state = (lane, origin, mi.Vector3f(-w_view), mi.Color3f(1.0))
        n_vertices = self.max_depth - 1 if self.max_depth > 0 else 2**31
        vertex = 1
        while vertex <= n_vertices:
            state, alive = self._vertex(state, vertex)
            if vertex == n_vertices:
                break
            # Most paths leave after the first vertex: the survivors are packed, or SIMD lanes idle.
            survivors = dr.compress(alive)
            if dr.width(survivors) == 0:
                break
            state = tuple(dr.gather(type(value), value, survivors) for value in state)
            vertex += 1

    def _tell(self, pieces: Sequence[Piece]) -> None:
        """Tables of the pieces, and the piece of each lane."""
        import mitsuba as mi

        lanes, sizes, lit = (
            np.array([count(piece) for piece in pieces])
            for count in (lambda p: p.n_lanes, lambda p: p.size, lambda p: len(p.lights))
        )
        first, base, start = (np.cumsum(a) - a for a in (lanes, sizes, lit))
        words = [[piece.keys[k] for piece in pieces] for k in (0, 1)]
        # Samples of a lane: base − first lane of the piece + lane + 3 n_lanes times the light.
        table = np.stack([*words, start, lit, base - first, lanes], 1).astype(np.int64) % 2**32
        self._piece = to_device(mi.UInt32, np.repeat(np.arange(len(pieces)), lanes))
        self._words = to_device(mi.UInt32, table)
        self._views = to_device(mi.Float, np.array([piece.w_view for piece in pieces]))
        self._lights = to_device(mi.Float, np.concatenate([piece.lights for piece in pieces]))

    def _word(self, lane: JitArray, number: int) -> JitArray:
        import drjit as dr

        piece = dr.gather(type(lane), self._piece, lane)
        return dr.gather(type(lane), self._words, piece * 6 + number)

    def _keys(self, lane: JitArray) -> list[JitArray]:
        """Words that select the random streams of the lanes' pieces."""
        return [self._word(lane, 0), self._word(lane, 1)]

    def _vertex(self, state: tuple[JitArray, ...], number: int) -> tuple[tuple[JitArray, ...], JitArray]:
        """Trace to the next vertex, connect it to all lights, sample the way on; one kernel."""
        import drjit as dr
        import mitsuba as mi

        lane, origin, direction, throughput = state
        depth = dr.opaque(mi.UInt32, number)
        if number == 1:
            interaction = self.tiles.intersect(origin, direction)
        else:
            # Most rays that leave the surface hit nothing: SIMD lanes would idle in what follows.
            index, interaction, _ = self.tiles.reached(origin, direction)
            if dr.width(index) == 0:
                return state, dr.full(mi.Bool, False, dr.width(lane))
            lane, throughput = dr.gather(type(lane), lane, index), dr.gather(mi.Color3f, throughput, index)
        active = interaction.is_valid()
        bsdf = interaction.bsdf()
        context = mi.BSDFContext()
        self._connect(interaction, bsdf, context, throughput, lane, active, first_vertex=number == 1)

        stream, keys = self._stream(lane), self._keys(lane)
        lobe, u, v, _ = uniforms(stream, keys, 2 * depth)
        roulette, _, _, _ = uniforms(stream, keys, 2 * depth + 1)
        sample, weight = bsdf.sample(context, interaction, lobe, mi.Point2f(u, v), active)
        throughput = throughput * weight
        survival = dr.minimum(dr.max(throughput), ROULETTE_LIMIT)
        survival = dr.select(depth >= ROULETTE_VERTEX, survival, 1)
        alive = active & (dr.max(throughput) > 0) & (roulette < survival)
        throughput = dr.select(alive, throughput / survival, 0)
        ray = interaction.spawn_ray(interaction.to_world(sample.wo))
        state = (lane, mi.Point3f(ray.o), mi.Vector3f(ray.d), mi.Color3f(throughput))
        dr.eval(state, alive)
        return state, alive

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
        """Add throughput · f cos · visibility of each of the lane's lights to its samples."""
        import drjit as dr
        import mitsuba as mi

        buffer, lights = self._buffer, self._lights
        start, n_lit, base, n_lanes = (self._word(lane, number) for number in (2, 3, 4, 5))
        mine = base + lane

        def connect(i: JitArray) -> tuple[JitArray]:
            w_light = dr.gather(mi.Vector3f, lights, start + i)
            value, lit = self._light(interaction, bsdf, context, throughput, w_light, active)
            index = dr.fma(i, 3 * n_lanes, mine)
            for channel in range(3):
                at = index + channel * n_lanes
                # Each lane owns its entries: no atomics. The first vertex overwrites the last view's samples.
                if first_vertex:
                    dr.scatter(buffer, dr.select(lit, value[channel], 0), at)
                else:
                    dr.scatter_add(buffer, value[channel], at, lit, mode=dr.ReduceMode.NoConflicts)
            return (i + 1,)

        dr.while_loop((mi.UInt32(0) + dr.zeros(mi.UInt32, dr.width(lane)),), lambda i: i < n_lit, connect)

    def _light(
        self,
        interaction: JitArray,
        bsdf: JitArray,
        context: JitArray,
        throughput: JitArray,
        w_light: JitArray,
        active: JitArray,
    ) -> tuple[JitArray, JitArray]:
        """Throughput · f cos · visibility of a light at the vertices, and where it is not 0."""
        import drjit as dr

        value = throughput * bsdf.eval(context, interaction, interaction.to_local(w_light), active)
        lit = active & (dr.max(value) > 0)
        ray = interaction.spawn_ray(w_light)
        if self.tiles.masked:
            value *= self.tiles.transmittance(ray, lit)
        else:
            lit &= ~self.tiles.occluded(ray, lit)
        return value, lit

    def _statistics(self, pieces: Sequence[Piece]) -> list[tuple[np.ndarray, ...]]:
        """Mean and variance of the mean from the samples of the last pass: two (n_lit, texels, 3) arrays a piece."""
        import drjit as dr

        _, _, per_stratum = strata(self.spp)
        n_strata = self.spp // per_stratum
        samples = self._buffer
        mean = dr.block_sum(samples, self.spp) / self.spp
        centre = dr.repeat(dr.block_sum(samples, per_stratum) / per_stratum, per_stratum)
        spread = dr.block_sum(dr.square(samples - centre), self.spp)
        variance = spread / (n_strata**2 * per_stratum * (per_stratum - 1))
        ends = np.cumsum([piece.size // self.spp for piece in pieces])
        parts = [np.split(value.numpy(), ends[:-1]) for value in (mean, variance)]
        return [
            tuple(part.reshape(len(piece.lights), 3, -1).transpose(0, 2, 1) for part in both)
            for piece, both in zip(pieces, zip(*parts, strict=True), strict=True)
        ]
