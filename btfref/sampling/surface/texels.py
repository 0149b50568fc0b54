"""Walks from the texels of every direction by the rest of the BSDF, used both ways.

For a view they bring light by way of the rest; for a light they are photons, which bring light by way of
the rest to what they hit, and from there to all views. Where a light's direction is a view's as well, both come
from the same walk.

A path v – p – q – l by way of the rest at both p and q is found by walks from v, whose direction at p is drawn, and by
photons from l, whose direction at q is: each counts by the balance heuristic (Veach 1997, sec. 9.2.2). Per area
of both vertices and walks per texel alike, the densities are ``|n_p·v|/v_z pdf_p |n_q·ω| / r²`` and
``|n_q·l|/l_z pdf_q |n_p·ω| / r²``; where one lobe peaks, the walk that drew the other one counts little. Light by way
of the broad lobe at q comes with the walks from v alone, and of that at p with the photons alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from btfref.numerics.device_arrays import packed, to_device, unpacked
from btfref.sampling.surface.points import starts
from btfref.sampling.surface.walks import Surface, connect, continue_walks
from btfref.sampling.tiled_scene import rotated, stream_keys, uniforms

if TYPE_CHECKING:
    from btfref.sampling.surface.estimator import SurfaceScene
    from btfref.sampling.surface.points import Bins
    from btfref.types import JitArray

#: Walks that start together: a bound on memory, without influence on the result.
TOGETHER = 1 << 20

_NONE = 0xFFFFFFFF

#: Random streams of a texel; beyond them neighbours share numbers.
STREAMS = 1024

#: Lanes that Dr.Jit's LLVM backend gives to one thread at a time.
BLOCK = 1 << 14


def lanes(directions: np.ndarray, texel: np.ndarray, sample: np.ndarray) -> np.ndarray:
    """Numbers of random streams: of a direction's own vector, whatever else is asked for.

    Parameters
    ----------
    directions : ndarray (k, 3)
    texel, sample : ndarray (k,) int

    Returns
    -------
    ndarray (k,) uint32
    """
    lane = stream_numbers(directions).astype(np.int64) + texel * STREAMS + sample
    return (lane % (1 << 32)).astype(np.uint32)


def stream_numbers(directions: np.ndarray) -> np.ndarray:
    """First random stream of each direction: ndarray (k,) uint32."""
    bits = np.round(directions * 1e6).astype(np.int64) @ np.array([73856093, 19349663, 83492791])
    return (bits.astype(np.uint64) * np.uint64(2654435761) % np.uint64(1 << 32)).astype(np.uint32)


def _choose(bins: list[Bins], cell: JitArray, half: JitArray, u: JitArray) -> tuple[JitArray, JitArray]:
    """One entry of a half for each of some cells, drawn by weight.

    Parameters
    ----------
    bins : list of Bins
    cell : mitsuba.UInt32
        Number of the bin times texels, plus the texel.
    half : mitsuba.UInt32
    u : mitsuba.Float
        Random numbers in [0, 1).

    Returns
    -------
    entry : mitsuba.UInt32
    found : mitsuba.Bool
        False where the half has none.
    """
    import drjit as dr
    import mitsuba as mi

    weight = to_device(mi.Float, np.concatenate([some.weight for some in bins]))
    halves = to_device(mi.UInt8, np.concatenate([some.half for some in bins]))
    start = to_device(mi.UInt32, starts(bins))
    begin, end = dr.gather(mi.UInt32, start, cell), dr.gather(mi.UInt32, start, cell + 1)

    def share(i: JitArray) -> JitArray:
        mine = mi.UInt32(dr.gather(mi.UInt8, halves, i)) == half
        return dr.select(mine, dr.gather(mi.Float, weight, i), 0)

    state = (begin, dr.zeros(mi.Float, dr.width(cell)))
    _, total = dr.while_loop(state, lambda i, _: i < end, lambda i, total: (i + 1, total + share(i)))
    target = u * total
    dr.eval(target)

    def look(i: JitArray, below: JitArray, found: JitArray) -> tuple[JitArray, JitArray, JitArray]:
        some = share(i)
        return i + 1, below + some, dr.select((some > 0) & (below <= target), i, found)

    start_of_look = (begin, dr.zeros(mi.Float, dr.width(cell)), dr.full(mi.UInt32, _NONE, dr.width(cell)))
    found = dr.while_loop(start_of_look, lambda i, below, found: i < end, look)[2]
    dr.eval(found)
    return found, found != _NONE


class TexelWalks:
    """The walks' first hits and what follows from them.

    Parameters
    ----------
    scene : SurfaceScene
    surface : Surface
        Points and other records.
    bins : list of Bins
        One per direction.
    per_half : int
        Walks per direction, texel and half.
    n_texels, n_vertices, seed, stream : int
    """

    def __init__(
        self,
        scene: SurfaceScene,
        surface: Surface,
        bins: list[Bins],
        *,
        per_half: int,
        n_texels: int,
        n_vertices: int,
        seed: int,
        stream: int,
    ) -> None:
        import drjit as dr
        import mitsuba as mi

        self.scene, self.per_half, self.n_texels = scene, per_half, n_texels
        self.n_vertices = n_vertices
        self.keys = stream_keys(seed, stream)
        each = 2 * per_half * n_texels
        step = max(1, TOGETHER // each)
        parts = []
        for first in range(0, len(bins), step):
            part = self._start(surface, bins[first : first + step], first)
            if part is not None:
                parts.append(part)
        #: What the walks found first; empty where none found anything.
        self.hits: dict[str, Any] = {}
        if parts:
            self.hits = _joined(parts)
            self.range = np.searchsorted(self.hits.pop("direction"), np.arange(len(bins) + 1))
            self.photons = dr.compress(self.hits.pop("bright"))
            self.photon_range = to_device(mi.UInt32, np.searchsorted(self.photons.numpy(), self.range))

    def _start(self, surface: Surface, bins: list[Bins], first: int) -> dict[str, Any] | None:
        """Walks from the texels of some directions to their first hits, and what these see."""
        import drjit as dr
        import mitsuba as mi

        scene, lobes = self.scene, self.scene.lobes
        # Lanes: [direction, half, sample, texel].
        lane = dr.arange(mi.UInt32, len(bins) * 2 * self.per_half * self.n_texels)
        n_texels, per_half = (dr.opaque(mi.UInt32, n) for n in (self.n_texels, self.per_half))
        texel, rest = lane % n_texels, lane // n_texels
        sample, half, place = rest % per_half, rest // per_half % 2, rest // (2 * per_half)
        direction = place + dr.opaque(mi.UInt32, first)
        key = dr.gather(mi.UInt32, to_device(mi.UInt32, stream_numbers(scene.directions)), direction)
        stream = key + texel * STREAMS + 2 * sample + half
        keys = self.keys
        pick, _, _, _ = uniforms(stream, keys, mi.UInt32(0))
        entry, valid = _choose(bins, place * n_texels + texel, half, (mi.Float(sample) + pick) / per_half)
        record = to_device(mi.UInt32, np.concatenate([some.record for some in bins]))
        flux = to_device(mi.Float, np.concatenate([some.flux for some in bins]))
        lobe, _, _, choice = uniforms(stream, keys, mi.UInt32(1))
        # The walks of a texel share a random place in the square, from where they fill it evenly.
        u, v, _, _ = uniforms(stream - 2 * sample, keys, mi.UInt32(2))
        u, v = rotated(u, v, sample)
        w = dr.gather(mi.Vector3f, scene.cache.vectors, direction)
        si, bsdf, number, albedo = surface.interaction(dr.gather(mi.UInt32, record, entry, valid), valid)
        si.wi = si.to_local(w)
        drawn, weight = lobes.sample_rest(bsdf, number, albedo, si, lobe, mi.Point2f(u, v), valid)
        active = valid & (dr.max(dr.abs(weight)) > 0)
        ray = si.spawn_ray(si.to_world(drawn.wo))
        state = [mi.Vector3f(ray.d), mi.Color3f(weight), drawn.pdf, entry, stream, choice]
        origin = mi.Point3f(ray.o)
        dr.eval(origin, state, active)
        there, hit, found = scene.tiles.reached(origin, state[0], active)
        if dr.width(there) == 0:
            return None
        towards, weight, pdf, entry, stream, choice = (dr.gather(type(a), a, there) for a in state)
        place = there // (n_texels * 2 * per_half)
        w = dr.gather(mi.Vector3f, scene.cache.vectors, place + dr.opaque(mi.UInt32, first))
        si, bsdf, number, albedo = surface.interaction(dr.gather(mi.UInt32, record, entry))
        # What light from this direction sends the other way: BSDF with both directions exchanged, and the
        # geometry that shading normals leave unbalanced (Veach 1997, sec. 5.3).
        si.wi = si.to_local(towards)
        facing = dr.abs(dr.dot(si.n, towards))
        density = dr.abs(dr.dot(si.n, w)) / w.z * pdf
        power = lobes.eval_rest(bsdf, number, albedo, si, si.to_local(w), True)
        power *= facing / (dr.abs(dr.dot(si.n, w)) * pdf)
        power = dr.select(pdf > 0, power * dr.gather(mi.Float, flux, entry), 0)
        surface = Surface.of_interaction(hit, lobes)
        which, texel = np.divmod(there.numpy(), np.uint32(self.n_texels))
        which //= np.uint32(self.per_half)
        number = first + (which >> 1)
        row = scene.cache.row(found, surface.number)
        dr.eval(row, weight, power, stream, choice, facing, density)
        si, *_ = surface.interaction(None)
        coded = scene.cache.sights(scene.tiles, si, row, choice, towards=-towards)
        cosine = dr.abs(dr.dot(surface.n, towards))
        power *= to_device(mi.Float, scene.directions[number, 2]) / (cosine * 2 * self.per_half)
        # Power, |n·ω| at the start, direction, density, weight.
        what = packed([*power, facing, *-towards, density * cosine, *weight, mi.Float(0)])
        bright = dr.max(dr.abs(power)) > 0
        dr.eval(bright)
        return {
            "surface": surface.for_lookups(),
            "lane": stream,
            "coded": coded,
            "what": what,
            "bright": bright,
            "direction": number.astype(np.uint32),
            "half": (which & 1).astype(np.uint8),
            "texel": texel,
        }

    def radiance(self, rows: Sequence[int]) -> JitArray:
        """Light by way of the rest for some directions: [direction, half, texel, light, 3]."""
        import drjit as dr
        import mitsuba as mi

        lights, hits = self.scene.lights, self.hits
        n_lit = lights.count
        target = dr.zeros(mi.Float, len(rows) * 2 * self.n_texels * n_lit * 3)
        if not hits:
            return target
        index = np.concatenate([np.arange(self.range[k], self.range[k + 1]) for k in rows])
        place = np.repeat(np.arange(len(rows)), [self.range[k + 1] - self.range[k] for k in rows])
        if len(index):
            self._bring(target, index, place)
        return target

    def _bring(self, target: JitArray, index: np.ndarray, place: np.ndarray) -> None:
        """Connect some hits to all lights and follow their walks."""
        import drjit as dr
        import mitsuba as mi

        scene, lights, hits = self.scene, self.scene.lights, self.hits
        lobes, cache = scene.lobes, scene.cache
        slot = (place * 2 + hits["half"][index]) * self.n_texels + hits["texel"][index]
        offset, at = to_device(mi.UInt32, slot * (3 * lights.count)), to_device(mi.UInt32, index)
        share, n, coded = dr.opaque(mi.Float, 1 / self.per_half), dr.opaque(mi.UInt32, cache.n), hits["coded"]

        def bring(i: JitArray) -> Callable[[JitArray, JitArray, JitArray], JitArray]:
            i = dr.gather(mi.UInt32, at, i)
            si, bsdf, number, albedo = hits["surface"].interaction(i)
            e = unpacked(hits["what"], i, 12)
            si.wi, gain = si.to_local(mi.Vector3f(e[4:7])), share * mi.Color3f(e[8:11])
            facing, density = e[3], e[7]

            def from_light(w: JitArray, k: JitArray, wanted: JitArray) -> JitArray:
                seen = cache.value(dr.gather(mi.UInt8, coded, dr.fma(i, n, k)))
                local, lit = si.to_local(w), (seen != 0) & wanted
                value = lobes.eval_rest(bsdf, number, albedo, si, local, lit)
                back = type(si)(si)
                back.wi = local
                spread = dr.abs(dr.dot(si.n, w)) / w.z
                other = spread * facing * lobes.pdf_rest(bsdf, back, si.wi, lit)
                value *= density / dr.maximum(density + other, 1e-30)
                return gain * seen * (value + lobes.value(number, albedo, si.wi, local))

            return from_light

        connect(lights, target, offset, bring, stride=3)
        if self.n_vertices < 3:
            return
        keys = self.keys
        lane = dr.gather(mi.UInt32, hits["lane"], at)
        si, bsdf, _, _ = hits["surface"].interaction(at)
        e = unpacked(hits["what"], at, 12)
        si.wi, weight = si.to_local(mi.Vector3f(e[4:7])), mi.Color3f(e[8:11])
        lobe, u, v, _ = uniforms(lane, keys, mi.UInt32(4))
        drawn, gain = bsdf.sample(lobes.full, si, lobe, mi.Point2f(u, v))
        ray = si.spawn_ray(si.to_world(drawn.wo))
        state = {
            "lane": lane,
            "target": offset,
            "origin": mi.Point3f(ray.o),
            "direction": mi.Vector3f(ray.d),
            "weight": mi.Color3f(weight * gain),
        }
        continue_walks(
            scene.tiles, lobes, cache, lights, target, state, keys,
            vertex=3, last=self.n_vertices, stride=3, broad_first=False, count=self.per_half,
        )  # fmt: skip

    def splatted(self, rows: Sequence[int], texels: tuple[int, int], variance: bool = True) -> list[JitArray]:
        """Photons as the texels of some directions see them: sums, and with a variance sums of squares.

        Returns
        -------
        list of mitsuba.Float
            [direction, light, texel, 3] each.
        """
        import drjit as dr
        import mitsuba as mi

        scene, lights, hits = self.scene, self.scene.lights, self.hits
        n_lit = lights.count
        size = len(rows) * self.n_texels * n_lit * 3
        targets = [dr.zeros(mi.Float, size) for _ in range(1 + variance)]
        if not hits:
            return targets
        surface, cache, lobes = hits["surface"], scene.cache, scene.lobes
        # A lane is a light and a view. Few as they are, they are spread so that every thread gets its share.
        each = -(-n_lit * len(rows) // dr.thread_count())
        lane = dr.arange(mi.UInt32, max(BLOCK, each) * dr.thread_count())
        lane = lane // max(BLOCK, each) * each + lane % max(BLOCK, each)
        busy = (dr.arange(mi.UInt32, dr.width(lane)) % max(BLOCK, each) < each) & (lane < n_lit * len(rows))
        lane = dr.select(busy, lane, 0)
        n_rows = dr.opaque(mi.UInt32, len(rows))
        light, place = lane // n_rows, lane % n_rows
        row = dr.gather(mi.UInt32, to_device(mi.UInt32, rows), place)
        w = dr.gather(mi.Vector3f, cache.vectors, row)
        own = dr.gather(mi.UInt32, lights.rows, light)
        begin = dr.gather(mi.UInt32, self.photon_range, own)
        end = dr.select(busy, dr.gather(mi.UInt32, self.photon_range, own + 1), 0)
        height, width = texels
        base = (place * n_lit + light) * self.n_texels
        n = dr.opaque(mi.UInt32, cache.n)

        def step(entry: JitArray) -> tuple[JitArray]:
            i = dr.gather(mi.UInt32, self.photons, entry)
            seen = cache.value(dr.gather(mi.UInt8, hits["coded"], dr.fma(i, n, row)))
            si, bsdf, number, albedo = surface.interaction(i)
            e = unpacked(hits["what"], i, 12)
            si.wi, incoming = si.to_local(w), si.to_local(mi.Vector3f(e[4:7]))
            spread = dr.abs(dr.dot(si.n, w)) / w.z
            facing, density = e[3], e[7]
            value, pdf = lobes.eval_pdf_rest(bsdf, number, albedo, si, incoming, seen != 0)
            value *= density / dr.maximum(density + spread * facing * pdf, 1e-30)
            value += lobes.value(number, albedo, si.wi, incoming)
            value *= seen * spread * mi.Color3f(e[:3])
            p = si.p
            x, y = p.x - p.z * w.x / w.z, p.y - p.z * w.y / w.z
            column = dr.minimum(mi.UInt32((x - dr.floor(x)) * width), width - 1)
            line = dr.minimum(mi.UInt32((y - dr.floor(y)) * height), height - 1)
            at = 3 * (line * width + column + base)
            bright = dr.max(dr.abs(value)) > 0
            for channel in range(3):
                # A lane has one view and one light: its entries are its own, its order that of the photons.
                for target, term in zip(targets, (value[channel], dr.square(value[channel])), strict=False):
                    dr.scatter_add(target, term, at + channel, bright, mode=dr.ReduceMode.NoConflicts)
            return (entry + 1,)

        dr.while_loop((begin,), lambda entry: entry < end, step)
        dr.eval(targets)
        return targets


def _joined(parts: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Hits of several groups of directions, one after the other; what they are made of is given back on the way."""
    import drjit as dr

    result: dict[str, Any] = {}
    for name in list(parts[0]):
        values = [part.pop(name) for part in parts]
        if len(values) == 1:
            result[name] = values[0]
        elif isinstance(values[0], np.ndarray):
            result[name] = np.concatenate(values)
        elif isinstance(values[0], Surface):
            result[name] = Surface(table=dr.concat([some.table for some in values]))
            dr.eval(result[name].table)
        else:
            result[name] = dr.concat(values)
            dr.eval(result[name])
        # Dr.Jit keeps what it is given back, and what follows is of other sizes.
        del values
        dr.flush_malloc_cache()
    return result
