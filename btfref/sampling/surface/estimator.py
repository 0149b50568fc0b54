"""The shared estimator: surface points whose visibility serves all views and all lights.

The radiance of texel t towards v under light l is a mean over the surface that the texel sees, ``Σ_k w_k L(p_k →
v)`` with w the share of the texel's footprint that point p_k stands for. Points are spread over the surface of
one tile, each is tested once for visibility along every direction, and what a view sees is sorted into its
texels. L is the sum of

* direct light: the BSDF times the visibility bit, pair by pair;
* light by way of a broad lobe at p_k (see `lobes`): walks that start at the points, shared by all views;
* light by way of the rest of the BSDF at p_k: walks from every view's texels;
* light l → rest lobe → p_k → v (caustics): photons, the first step of walks from every *light's* texels. Where a
  light's direction is also a view's these are the same walks, used both ways; what two rest lobes pass on is found
  both ways and shared by the balance heuristic (`surface_texels`).

Points stand where a pilot finds that direct light varies inside texels. Walks go on to the full depth. By
construction the expectation is right: two independent halves of the points correct each other (`surface_gather`), a
half gets view rays where the *other* one finds a texel empty, and visibility at the vertices of walks is looked up
with a traced correction (`surface_cache`). Roulette looks at a walk's own weight: seen through the number of walks
that share a target it would make few, heavy walks of many, whose tails a few seeds do not show. Against plain renders
of thirty pairs to depth 8, 12 runs of 1024 points, the mean is off by −0.02 ± 0.03 % on the checker, +0.14 ± 0.19 % on
the rings and −0.04 ± 0.04 % on the tissue (95 %; tests/statistical/test_accuracy.py). Single values may be negative
where few points were drawn; a few texels, seen by one half only, have a stored variance near 0. Noise is shared:
neighbouring views and all lights see the same points and walks.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from btfref.numerics.device_arrays import in_one_kernel, to_device
from btfref.sampling.surface.cache import LARGEST, LEAST, VisibilityCache
from btfref.sampling.surface.gather import gather
from btfref.sampling.surface.lobes import BroadLobes
from btfref.sampling.surface.pilot import contrast
from btfref.sampling.surface.points import Bins, centroids, footprints, sample_points
from btfref.sampling.surface.texels import TOGETHER, TexelWalks, lanes
from btfref.sampling.surface.triangles import density, triangles
from btfref.sampling.surface.walks import Lights, Surface, continue_walks, visibility
from btfref.sampling.tiled_scene import START, TiledScene, rotated, stream_keys, uniforms

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from btfref.mesostructure.base import Mesostructure
    from btfref.types import JitArray

#: View rays of a half whose other half finds a texel empty.
RAYS = 2

#: Rays of the pilot that finds out which triangles are visible.
PILOT_RAYS = 3_000_000

#: Directions whose pilot rays also look for visible back sides.
BACK_DIRECTIONS = 8

#: Memory (bytes) of the means of views that are gathered together, at most.
GATHER_BUFFER = 64 << 20

# Streams of random numbers.
_POINTS, _RAYS, _BROAD, _REST, _PLACES = range(5)


@dataclass
class SurfaceScene:
    """What all steps of the estimator look at.

    Attributes
    ----------
    tiles : TiledScene
    lobes : BroadLobes
    directions : ndarray (n, 3)
        Views and lights, each once.
    lights : Lights
    cache : VisibilityCache
    """

    tiles: TiledScene
    lobes: BroadLobes
    directions: np.ndarray
    lights: Lights
    cache: Any = None


#: Walks by the broad lobe from each point.
BROAD_WALKS = 8


def walks(spp: int) -> tuple[int, int]:
    """Walks per point, and per texel, direction and half.

    Five points per walk of a half: on tissue and rings direct light and light by way of the rest are then about
    equally noisy. With 10 points per texel the checker's error is that of 16 paths per texel and pair, with 18 the
    tissue's, with 25 that of the rings (`btfref bench synth`). Direct light falls faster than with the root of the
    points, which are stratified, and light by way of walks with the root of their number.
    """
    return BROAD_WALKS, max(1, spp // 5)


class SurfaceEstimator:
    """Radiance of all texels for all views and all lights from shared surface points.

    Parameters
    ----------
    mesostructure : Mesostructure
    lights : ndarray, shape (n_lights, 3)
        Unit vectors.
    views : ndarray, shape (n_views, 3)
        All views of the BTF, so that parts of it are made of the same points.
    texels : tuple of int
        Rows and columns.
    spp : int
        Points per texel of the tile.
    seed : int
    max_depth : int
        As in Mitsuba's path integrator: 2 is direct light only, −1 has no limit.
    wanted : sequence of int, optional
        Views that will be asked for; None for all.
    mask : ndarray (rows · columns,) bool, optional
        Texels that are asked for; None for all. The others lack light by way of broad lobes.
    chosen : sequence of int, optional
        Lights that results are of; None for all.
    variance : bool
        Whether variances are made; they take about a third of the time of `all_views`.
    buffer : int
        Bytes of the means of views that are gathered together.

    Notes
    -----
    Build and use it inside one `mitsuba_variant` block.
    """

    key = "surface"

    def __init__(
        self,
        mesostructure: Mesostructure,
        lights: ArrayLike,
        *,
        views: ArrayLike,
        texels: Sequence[int],
        spp: int,
        seed: int,
        max_depth: int,
        wanted: ArrayLike | None = None,
        mask: np.ndarray | None = None,
        chosen: ArrayLike | None = None,
        variance: bool = True,
        buffer: int = GATHER_BUFFER,
    ) -> None:
        import drjit as dr
        import mitsuba as mi

        rows, columns = texels
        self.texels, self.spp, self.seed = (int(rows), int(columns)), int(spp), int(seed)
        self.mask, self.variance, self.buffer = mask, variance, buffer
        self.n_texels = rows * columns
        views, every = np.asarray(views, np.float64), np.asarray(lights, np.float64)
        asked = np.arange(len(views)) if wanted is None else np.asarray(wanted)
        # The patch is that of all directions: rays that are wrapped elsewhere round otherwise.
        ways = np.concatenate([views, every])
        own = every if chosen is None else every[np.asarray(chosen)]
        self.n_lights = len(own)
        self.lit = np.flatnonzero(own[:, 2] > 0)
        self.wanted = asked[views[asked, 2] > 0]
        # Equal directions of views and lights are one direction.
        vectors = np.concatenate([views[self.wanted], own[self.lit]]).astype(np.float32)
        _, first, index = np.unique(np.round(vectors, 6), axis=0, return_index=True, return_inverse=True)
        directions = vectors[first].astype(np.float64)
        index = index.ravel()
        self.row = dict(zip(self.wanted.tolist(), index[: len(self.wanted)].tolist(), strict=True))
        light_rows = index[len(self.wanted) :].astype(np.uint32)
        self.n_vertices = max_depth - 1 if max_depth > 0 else 2**31
        self.broad_walks, self.rest_walks = walks(self.spp)
        if not len(directions) or not len(self.lit):
            return
        tiles = TiledScene(mesostructure, ways)
        there = Lights(to_device(mi.Float, own[self.lit]), to_device(mi.UInt32, light_rows))
        self.scene = SurfaceScene(tiles, BroadLobes(tiles.bsdfs), directions, there)
        self._place_points(mesostructure, views)
        self._see()
        self.walks: TexelWalks | None = None
        if self.n_vertices >= 2:
            self.walks = TexelWalks(
                self.scene, self.surface, self.bins, per_half=self.rest_walks,
                n_texels=self.n_texels, n_vertices=self.n_vertices, seed=self.seed, stream=_REST,
            )  # fmt: skip
            self._walk_from_points()
        # What making all this took is of other sizes than what results take.
        dr.flush_malloc_cache()

    # --- points and what they see

    def _place_points(self, mesostructure: Mesostructure, views: np.ndarray) -> None:
        """Points where views look, and the visibility of small triangles."""
        scene = self.scene
        pieces, descent = triangles(mesostructure, 1.0 / self.n_texels)
        count = 2 * -(-self.spp * self.n_texels // 2)
        n_triangles = len(pieces.area)
        up = views[views[:, 2] > 0]
        pilots = up[:: max(1, -(-len(up) * n_triangles // PILOT_RAYS))]
        middles = centroids(pieces)
        surface = Surface.of_points(middles, scene.lobes)
        few = pilots[:: max(1, len(pilots) // BACK_DIRECTIONS)]
        back = visibility(scene.tiles, surface, few).astype(bool) & ((few @ pieces.facet.T) < 0)
        #: Closed surfaces never show their back: half of the rays need not be traced.
        self.closed = not back.any()
        bits = None
        if n_triangles <= max(LARGEST * count, LEAST):
            bits = visibility(scene.tiles, surface, scene.directions, front_only=self.closed)
        front = visibility(scene.tiles, surface, pilots, front_only=True).astype(bool)
        scene.cache = VisibilityCache(bits, descent, scene.lobes, scene.directions)
        varied = contrast(surface, middles, scene.lobes, pilots, front, self.texels)
        share = density(pieces, pilots, front, varied)
        self.points = sample_points(pieces, share, count, np.random.default_rng([self.seed, _POINTS]))

    def _see(self) -> None:
        """Visibility of all points along all directions, bins of all directions, rays for empty texels."""
        import drjit as dr

        scene, n_texels = self.scene, self.n_texels
        n_points = len(self.points.p)
        self.surface = Surface.of_points(self.points, scene.lobes)
        seen = visibility(scene.tiles, self.surface, scene.directions, front_only=self.closed)
        rays = []
        self.bins = []
        place = n_points
        for k, w in enumerate(scene.directions):
            texel, point, weight = footprints(self.points, seen[k], w, self.texels)
            half = point & 1
            total = np.bincount(half * n_texels + texel, weight, 2 * n_texels).reshape(2, -1)
            flux = total[half, texel]
            # Rays of a half are decided by the other half: no point has a say in its own weight.
            empty = total[::-1] == 0
            if empty.any():
                aided = empty[half, texel]
                # Its own points keep half of the say: what they make of the ratio is what the other half,
                # which has none, needs for its slope.
                weight[aided] /= 2 * flux[aided]
                flux[aided] = 0
            some = np.stack([*np.nonzero(empty), (total > 0)[empty]], 1).astype(np.uint32)
            rays.append(some)
            # Records of rays follow those of points, direction after direction.
            row, column, shared = (np.repeat(values, RAYS).astype(np.int64) for values in some.T)
            record = place + np.arange(len(row))
            place += len(row)
            share = np.where(shared, 0.5, 1.0)
            parts = zip(
                (texel, point, weight, half, flux),
                (column, record, share / RAYS, row, 1 / share),
                strict=True,
            )
            texel, record, weight, half, flux = (np.concatenate(part) for part in parts)
            self.bins.append(Bins.sorted(texel, record, weight, half, flux, n_texels))
        sights = None
        self.stream = np.arange(n_points, dtype=np.uint32)
        if place > n_points:
            found, lane, sights = self._view_rays(rays)
            self.stream = np.concatenate([self.stream, lane])
            self.surface = self.surface.joined(found)
            del found
            dr.flush_malloc_cache()
        self.used = np.zeros(place, bool)
        for k in set(self.row.values()):
            some = self.bins[k].record
            if self.mask is not None:
                some = some[np.repeat(self.mask, np.diff(self.bins[k].start))]
            self.used[some] = True
        self._light_table(seen[scene.lights.rows.numpy()], sights)

    def _view_rays(self, rays: list[np.ndarray]) -> tuple[Surface, np.ndarray, JitArray]:
        """First hits of rays through texels of several directions: records, streams, what they see.

        Misses are the absorber.
        """
        import drjit as dr
        import mitsuba as mi

        direction = np.repeat(np.arange(len(rays)), [RAYS * len(some) for some in rays])
        half, texel, _ = (np.repeat(column, RAYS) for column in np.concatenate(rays).T)
        ray = np.tile(np.arange(RAYS), len(texel) // RAYS)
        lane = to_device(mi.UInt32, lanes(self.scene.directions[direction], texel, 2 * ray + half))
        u, v, choice, _ = uniforms(lane, stream_keys(self.seed, _RAYS), mi.UInt32(0))
        x = (to_device(mi.Float, texel % self.texels[1]) + u) / self.texels[1]
        y = (to_device(mi.Float, texel // self.texels[1]) + v) / self.texels[0]
        w = to_device(mi.Vector3f, self.scene.directions[direction].T)
        hit, place = self.scene.tiles.locate(dr.fma(w, START, mi.Point3f(x, y, 0)), -w)
        found = Surface.of_interaction(hit, self.scene.lobes)
        row = self.scene.cache.row(place, found.number)
        dr.eval(row, choice)
        si, *_ = found.interaction(None)
        return found, lane.numpy(), self.scene.cache.sights(self.scene.tiles, si, row, choice, towards=w)

    def _light_table(self, seen: np.ndarray, sights: JitArray | None) -> None:
        """Per record and light: three sums of light by way of the broad lobe, and the visibility.

        ``seen`` [light, point] tells that of points, ``sights`` [ray, direction] that of view rays. Direct light
        by way of broad lobes is among the sums where these are the tables'; `gather` adds the rest alone.
        """
        import drjit as dr
        import mitsuba as mi

        n_points, n_lit, cache, lobes = seen.shape[1], len(self.lit), self.scene.cache, self.scene.lobes
        self.table = dr.zeros(mi.Float, len(self.stream) * n_lit * 4)

        def fill(lane: JitArray, record: JitArray, sees: JitArray) -> None:
            light = lane % n_lit
            if lobes.exact:
                _, _, number, albedo = self.surface.interaction(record)
                w = dr.gather(mi.Vector3f, self.scene.lights.vectors, light)
                cosine = dr.dot(dr.gather(mi.Vector3f, self.surface.shading, record), w)
                direct = albedo * (lobes.shape(number, cosine) * dr.maximum(cosine, 0) * dr.inv_pi * sees)
            else:
                direct = mi.Color3f(0)
            values = (*direct, sees)

            def write() -> None:
                for k, value in enumerate(values):
                    dr.scatter(self.table, value, (record * n_lit + light) * 4 + k)

            in_one_kernel(dr.width(lane), write)

        lane = dr.arange(mi.UInt32, n_points * n_lit)
        sees = dr.gather(mi.UInt8, to_device(mi.UInt8, seen), lane % n_lit * n_points + lane // n_lit)
        fill(lane, lane // n_lit, mi.Float(sees))
        if sights is not None:
            lane = dr.arange(mi.UInt32, (len(self.stream) - n_points) * n_lit)
            row = dr.gather(mi.UInt32, self.scene.lights.rows, lane % n_lit)
            sees = cache.value(dr.gather(mi.UInt8, sights, lane // n_lit * cache.n + row))
            fill(lane, lane // n_lit + n_points, sees)
        dr.eval(self.table)

    # --- walks

    def _walk_from_points(self) -> None:
        """Light by way of the broad lobe at the points: cosine-distributed walks, the same for all views."""
        import drjit as dr
        import mitsuba as mi

        scene = self.scene
        lobes, n_lit = scene.lobes, len(self.lit)
        if not lobes.any:
            return
        albedo = np.array(self.surface.albedo).T
        start = np.flatnonzero(self.used & (albedo.max(1) > 0))
        if not len(start):
            return
        keys, places = stream_keys(self.seed, _BROAD), stream_keys(self.seed, _PLACES)
        count = self.broad_walks
        step = max(1, TOGETHER // count)
        for first in range(0, len(start), step):
            some = np.repeat(start[first : first + step], count)
            number = dr.arange(mi.UInt32, len(some)) % count
            index, lane = (to_device(mi.UInt32, words) for words in (some, self.stream[some]))
            # The walks of a point share a random place in the square, from where they fill it evenly.
            u, v, _, _ = uniforms(lane, places, mi.UInt32(0))
            u, v = rotated(u, v, number)
            si, _, kind, rho = self.surface.interaction(index)
            local = mi.warp.square_to_cosine_hemisphere(mi.Point2f(u, v))
            weight = rho * lobes.shape(kind, local.z)
            ray = si.spawn_ray(si.to_world(local))
            state = {
                "lane": lane * count + number,
                "target": index * (4 * n_lit),
                "origin": mi.Point3f(ray.o),
                "direction": mi.Vector3f(ray.d),
                "weight": mi.Color3f(weight),
            }
            continue_walks(
                scene.tiles, lobes, scene.cache, scene.lights, self.table, state, keys,
                vertex=2, last=self.n_vertices, stride=4, broad_first=True, count=count,
            )  # fmt: skip

    def counts(self) -> tuple[float, float]:
        """View rays per texel and direction, and the share of walks from texels that hit something."""
        import drjit as dr

        if not len(self.lit):
            return 0.0, 0.0
        cells = self.n_texels * len(self.scene.directions)
        rays = (len(self.stream) - len(self.points.p)) / cells
        hits = self.walks.hits if self.walks is not None else {}
        found = dr.width(hits["lane"]) if hits else 0
        return rays, found / (2 * self.rest_walks * cells)

    # --- results

    def view(self, index: int, w_view: object = None) -> tuple[np.ndarray, np.ndarray | None]:
        """Mean and variance of the mean for one view; see `PathEstimator.view`."""
        return next(self.all_views([index]))[1:]

    def all_views(self, views: Iterable[int]) -> Iterator[tuple[int, np.ndarray, np.ndarray | None]]:
        """Results of views in the order given.

        Yields
        ------
        view, mean, variance : int, ndarray, ndarray
            Mean and variance of shape (n_lights, rows, columns, 3), float32; None for a variance that is not
            made.
        """
        views = list(views)
        each = self.n_texels * max(len(self.lit), 1) * 12
        together = max(1, min(self.buffer // each, (2**31 - 1) * 2 // each))
        live = [view for view in views if view in self.row and len(self.lit)]
        together = -(-len(live) // max(1, -(-len(live) // together)))  # none is left alone at the end
        held: dict[int, tuple[np.ndarray, np.ndarray | None]] = {}
        done = 0
        for view in views:
            if view not in self.row or not len(self.lit):
                zero = np.zeros((self.n_lights, *self.texels, 3), np.float32)
                yield view, zero, zero.copy() if self.variance else None
                continue
            if view not in held:
                now = live[done : done + together]
                held = {}
                mean, variance = self._results(now)
                held = {
                    one: (mean[k], None if variance is None else variance[k]) for k, one in enumerate(now)
                }
            done += 1
            one, spread = held[view]
            yield view, self._all_lights(one), None if spread is None else self._all_lights(spread)

    def _results(self, views: Sequence[int]) -> tuple[np.ndarray, np.ndarray | None]:
        """Means and variances of several views: (views, lights above the horizon, texels, 3) each."""
        rows = [self.row[view] for view in views]
        walks = self.walks if self.walks is not None and self.walks.hits else None
        return gather(
            self.scene, self.surface, self.table, rows, [self.bins[k] for k in rows],
            radiance=None if walks is None else walks.radiance(rows),
            splats=None if walks is None else walks.splatted(rows, self.texels, self.variance),
            texels=self.texels, variance=self.variance,
        )  # fmt: skip

    def _all_lights(self, part: np.ndarray) -> np.ndarray:
        """With black images for lights below the horizon: (lights, rows, columns, 3)."""
        if len(self.lit) < self.n_lights:
            full = np.zeros((self.n_lights, self.n_texels, 3), np.float32)
            full[self.lit] = part
            part = full
        return part.reshape(self.n_lights, *self.texels, 3)
