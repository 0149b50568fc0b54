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

import numpy as np

from btfref.sampling.tiled_scene import START, TiledScene, stream_keys, uniforms

#: Memory (bytes) of the sample buffer of one pass; reduction needs about three times that.
SAMPLE_BUFFER = 96 << 20

#: First vertex (1 = the visible one) at which Russian roulette may end a path.
ROULETTE_VERTEX = 3

#: Largest probability of survival.
ROULETTE_LIMIT = 0.95


def strata(spp):
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


class PathEstimator:
    """Radiance of all texels for one view and all lights, by path tracing with light connections.

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
    views : ndarray, shape (n_views, 3), optional
        Needed for `all_views` only.
    wanted : sequence of int, optional
        Not used: views are independent of each other.
    mask : ndarray (rows · columns,) bool, optional
        Texels that are asked for; the others may be left 0.

    Notes
    -----
    Build and use it inside one `mitsuba_variant` block. Light that reaches a point through delta lobes
    (smooth glass) is missing, as in every path tracer with delta lights.
    """

    key = "path"

    def __init__(
        self, mesostructure, lights, *, texels, spp, seed, max_depth, views=None, wanted=None, mask=None
    ):
        self.texels, self.spp, self.seed = tuple(texels), int(spp), int(seed)
        self.max_depth, self.views, self.mask = int(max_depth), views, mask
        self._vectors = np.asarray(lights, dtype=np.float64)
        self.tiles = TiledScene(mesostructure, self._vectors)
        self._buffer = None
        self.choose()

    def choose(self, lights=None):
        """Make results of some lights from now on; those of a light do not depend on which others are made.

        Parameters
        ----------
        lights : ndarray of int, optional
            Indices; all when not given.
        """
        import drjit as dr
        import mitsuba as mi

        vectors = self._vectors if lights is None else self._vectors[lights]
        self.n_lights = len(vectors)
        self.lit = np.flatnonzero(vectors[:, 2] > 0)
        self.lights = mi.Float(vectors[self.lit].astype(np.float32).ravel())
        dr.eval(self.lights)

    @property
    def texels_per_pass(self):
        """Texels traced together; a bound on memory, without influence on the result."""
        lanes = max(SAMPLE_BUFFER // (12 * max(len(self.lit), 1)), 1)
        return max(1, min(self.texels[0] * self.texels[1], lanes // self.spp))

    def all_views(self, views):
        """Yield (view, mean, variance) of views, one after the other; see `view`."""
        for index in views:
            yield index, *self.view(index, self.views[index])

    def view(self, index, w_view):
        """Mean and variance of the mean for one view.

        Parameters
        ----------
        index : int
            Number of the view in the full set: with the seed it fixes the random numbers.
        w_view : array_like, shape (3,)
            Unit vector.

        Returns
        -------
        mean, variance : ndarray, shape (n_lights, rows, columns, 3), float32
            B in 1/sr, and the variance of that mean.
        """
        rows, columns = self.texels
        mean = np.zeros((self.n_lights, rows * columns, 3), np.float32)
        variance = np.zeros_like(mean)
        if w_view[2] > 0 and len(self.lit):
            keys = stream_keys(self.seed, int(index))
            step = self.texels_per_pass
            for first in range(0, rows * columns, step):
                last = min(first + step, rows * columns)
                if self.mask is not None and not self.mask[first:last].any():
                    continue
                part = self._texels(first, last - first, np.asarray(w_view, dtype=np.float64), keys)
                # Advanced index beside a slice: (n_lit, texels, 3) on both sides.
                mean[self.lit, first:last] = part[0]
                variance[self.lit, first:last] = part[1]
        return mean.reshape(-1, rows, columns, 3), variance.reshape(-1, rows, columns, 3)

    def _texels(self, first, n_texels, w_view, keys):
        """Statistics of texels first … first + n_texels − 1, as two (n_lit, n_texels, 3) arrays."""
        self._paths(n_texels * self.spp, first * self.spp, w_view, keys)
        return self._statistics(len(self.lit), n_texels)

    def _paths(self, n_lanes, first, w_view, keys):
        """Fill the buffer with the samples of one pass, whose streams begin at `first`."""
        import drjit as dr
        import mitsuba as mi

        n_lit = len(self.lit)
        if self._buffer is None or dr.width(self._buffer) != 3 * n_lit * n_lanes:
            # Touching new memory costs as much as filling it: one buffer serves all views of equally many lights.
            self._buffer = dr.empty(mi.Float, 3 * n_lit * n_lanes)
        # Everything that changes between views is opaque: one kernel then serves all of them.
        first = dr.opaque(mi.UInt32, first)
        n_lanes_opaque = dr.opaque(mi.UInt32, n_lanes)
        lane = dr.arange(mi.UInt32, n_lanes)
        w_view = mi.Vector3f(*(dr.opaque(mi.Float, float(value)) for value in w_view))
        origin = self._footprint(lane + first, keys, w_view)
        state = (lane, origin, mi.Vector3f(-w_view), mi.Color3f(1.0))
        n_vertices = self.max_depth - 1 if self.max_depth > 0 else 2**31
        vertex = 1
        while vertex <= n_vertices:
            state, alive = self._vertex(state, vertex, first, keys, n_lanes_opaque)
            if vertex == n_vertices:
                break
            # Most paths leave after the first vertex: the survivors are packed, or SIMD lanes idle.
            survivors = dr.compress(alive)
            if dr.width(survivors) == 0:
                break
            state = tuple(dr.gather(type(value), value, survivors) for value in state)
            vertex += 1

    def _stream(self, lane, first):
        """Number of the random stream of a lane of this pass: the sample's own, whatever the pass."""
        return lane + first

    def _footprint(self, lane, keys, w_view):
        """Start of the view rays: a stratified point of the lane's texel square, moved up along w_view."""
        import drjit as dr
        import mitsuba as mi

        columns, rows, per_stratum = strata(self.spp)
        texel, sample = lane // self.spp, lane % self.spp
        stratum = sample // per_stratum
        u, v, _, _ = uniforms(lane, keys, mi.UInt32(0))
        u = (mi.Float(stratum % columns) + u) / columns
        v = (mi.Float(stratum // columns) + v) / rows
        x = (mi.Float(texel % self.texels[1]) + u) / self.texels[1]
        y = (mi.Float(texel // self.texels[1]) + v) / self.texels[0]
        return dr.fma(mi.Vector3f(w_view), START, mi.Point3f(x, y, 0))

    def _vertex(self, state, number, first, keys, n_lanes):
        """Trace to the next vertex, connect it to all lights, sample the way on; one kernel."""
        import drjit as dr
        import mitsuba as mi

        lane, origin, direction, throughput = state
        depth = dr.opaque(mi.UInt32, number)
        interaction = self.tiles.intersect(origin, direction)
        active = interaction.is_valid()
        bsdf = interaction.bsdf()
        context = mi.BSDFContext()
        self._connect(interaction, bsdf, context, throughput, lane, active, n_lanes, first_vertex=number == 1)

        lobe, u, v, _ = uniforms(self._stream(lane, first), keys, 2 * depth)
        roulette, _, _, _ = uniforms(self._stream(lane, first), keys, 2 * depth + 1)
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

    def _connect(self, interaction, bsdf, context, throughput, lane, active, n_lanes, *, first_vertex):
        """Add throughput · f cos · visibility of every light to the lane's samples."""
        import drjit as dr
        import mitsuba as mi

        buffer, lights, n_lit = self._buffer, self.lights, dr.opaque(mi.UInt32, len(self.lit))

        def connect(i):
            w_light = dr.gather(mi.Vector3f, lights, i)
            value = throughput * bsdf.eval(context, interaction, interaction.to_local(w_light), active)
            lit = active & (dr.max(value) > 0)
            ray = interaction.spawn_ray(w_light)
            lit &= ~self.tiles.occluded(ray, lit)
            index = dr.fma(i, 3 * n_lanes, lane)
            for channel in range(3):
                at = index + channel * n_lanes
                # Each lane owns its entries: no atomics. The first vertex overwrites the last view's samples.
                if first_vertex:
                    dr.scatter(buffer, dr.select(lit, value[channel], 0), at)
                else:
                    dr.scatter_add(buffer, value[channel], at, lit, mode=dr.ReduceMode.NoConflicts)
            return (i + 1,)

        dr.while_loop((mi.UInt32(0) + dr.zeros(mi.UInt32, dr.width(lane)),), lambda i: i < n_lit, connect)

    def _statistics(self, n_lit, n_texels):
        """Mean and variance of the mean from the samples of the last pass."""
        import drjit as dr

        _, _, per_stratum = strata(self.spp)
        n_strata = self.spp // per_stratum
        samples = self._buffer
        mean = dr.block_sum(samples, self.spp) / self.spp
        centre = dr.repeat(dr.block_sum(samples, per_stratum) / per_stratum, per_stratum)
        spread = dr.block_sum(dr.square(samples - centre), self.spp)
        variance = spread / (n_strata**2 * per_stratum * (per_stratum - 1))
        shape = (n_lit, 3, n_texels)
        return tuple(value.numpy().reshape(shape).transpose(0, 2, 1) for value in (mean, variance))
