"""Walks from the texels of every direction by the rest of the BSDF, used both ways.

For a view they bring light by way of the rest; for a light they are photons, which bring light by way of
the rest and then of the broad lobe of what they hit (caustics). Where a light's direction is a view's as
well, both come from the same walk.
"""

from __future__ import annotations

import numpy as np

from btfref.sampling.surface_walks import Surface, connect, continue_walks
from btfref.sampling.tiled_scene import stream_keys, uniforms

#: Walks that start together: a bound on memory, without influence on the result.
TOGETHER = 1 << 20

_REST = 3


def lanes(directions, texel, sample):
    """Numbers of random streams: of a direction's own vector, whatever else is asked for.

    Parameters
    ----------
    directions : ndarray (k, 3)
    texel, sample : ndarray (k,) int

    Returns
    -------
    ndarray (k,) uint32
    """
    bits = np.round(directions * 1e6).astype(np.int64) @ np.array([73856093, 19349663, 83492791])
    key = (bits % (1 << 32)).astype(np.uint64)
    lane = key * np.uint64(2654435761) + texel.astype(np.uint64) * np.uint64(64) + sample.astype(np.uint64)
    return (lane % np.uint64(1 << 32)).astype(np.uint32)


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
    n_texels, n_vertices, seed : int
    """

    def __init__(self, scene, surface, bins, *, per_half, n_texels, n_vertices, seed):
        self.scene, self.per_half, self.n_texels = scene, per_half, n_texels
        self.n_vertices, self.seed = n_vertices, seed
        each = 2 * per_half * n_texels
        step = max(1, TOGETHER // each)
        parts = []
        for first in range(0, len(bins), step):
            part = self._start(surface, bins[first : first + step], first)
            if part is not None:
                parts.append(part)
        self.hits = None
        if parts:
            self.hits = _joined(parts)
            self.range = np.searchsorted(self.hits["direction"], np.arange(len(bins) + 1))
            self._look()

    def _start(self, surface, bins, first):
        """Walks from the texels of some directions to their first hits."""
        import drjit as dr
        import mitsuba as mi

        scene, lobes = self.scene, self.scene.lobes
        shape = (len(bins), 2, self.per_half, self.n_texels)
        place, half, sample, texel = (a.ravel() for a in np.indices(shape, np.int32))
        direction = place + first
        lane = mi.UInt32(lanes(scene.directions[direction], texel, 2 * sample + half))
        keys = stream_keys(self.seed, _REST)
        pick, _, _, _ = uniforms(lane, keys, mi.UInt32(0))
        pick = ((sample + pick.numpy().astype(np.float64)) / self.per_half).reshape(shape)
        record, flux = np.full(shape, -1, np.int64), np.zeros(shape, np.float32)
        every = np.tile(np.arange(self.n_texels), self.per_half)
        for k, some in enumerate(bins):
            if not len(some.record):
                continue
            for h in range(2):
                entry = some.choose(h, every, pick[k, h].ravel()).reshape(shape[2:])
                record[k, h] = np.where(entry >= 0, some.record[np.maximum(entry, 0)], -1)
                flux[k, h] = np.where(entry >= 0, some.flux[np.maximum(entry, 0)], 0)
        record = record.ravel()
        lobe, u, v, choice = uniforms(lane, keys, mi.UInt32(1))
        valid = mi.Bool(record >= 0)
        w = mi.Vector3f(scene.directions[direction].T.astype(np.float32))
        si, bsdf, number, albedo = surface.interaction(
            mi.UInt32(np.maximum(record, 0).astype(np.uint32)), valid
        )
        si.wi = si.to_local(w)
        drawn, weight = lobes.sample_rest(bsdf, number, albedo, si, lobe, mi.Point2f(u, v), valid)
        active = valid & (dr.max(dr.abs(weight)) > 0)
        ray = si.spawn_ray(si.to_world(drawn.wo))
        # What light from this direction sends the other way: BSDF with both directions exchanged, and the
        # geometry that shading normals leave unbalanced (Veach 1997, sec. 5.3).
        back = type(si)(si)
        back.wi = drawn.wo
        power = lobes.eval_rest(bsdf, number, albedo, back, si.to_local(w), active)
        power *= dr.abs(dr.dot(si.n, ray.d)) / (dr.abs(dr.dot(si.n, w)) * drawn.pdf)
        power = dr.select(active & (drawn.pdf > 0), power * mi.Float(flux.ravel()), 0)
        state = [mi.Point3f(ray.o), mi.Vector3f(ray.d), mi.Color3f(power), mi.Color3f(weight), lane, choice]
        dr.eval(state, active)
        alive = dr.compress(active)
        if dr.width(alive) == 0:
            return None
        origin, towards, power, weight, lane, choice = (dr.gather(type(a), a, alive) for a in state)
        hit, found = scene.tiles.locate(origin, towards)
        surface = Surface.of_interaction(hit, lobes)
        row = scene.cache.row(found, surface.number)
        reached = hit.is_valid()
        dr.eval(row, reached, towards, power, weight, lane, choice)
        there = dr.compress(reached)
        if dr.width(there) == 0:
            return None
        gathered = {
            name: dr.gather(type(a), a, there)
            for name, a in (
                ("row", row),
                ("weight", weight),
                ("power", power),
                ("lane", lane),
                ("choice", choice),
            )
        }
        gathered["wi"] = -dr.gather(mi.Vector3f, towards, there)
        dr.eval(gathered)
        which = dr.gather(mi.UInt32, alive, there).numpy()
        numbers = {"direction": direction[which], "half": half[which], "sample": sample[which]}
        return gathered | numbers | {"texel": texel[which], "surface": surface.taken(there)}

    def _look(self):
        """Visibility of the hits, and the power of the photons but for what depends on the view."""
        import drjit as dr
        import mitsuba as mi

        scene, hits = self.scene, self.hits
        surface, incoming = hits["surface"], hits["wi"]
        si, _, number, albedo = surface.interaction(None)
        hits["coded"] = scene.cache.sights(scene.tiles, si, hits["row"], hits["choice"], towards=incoming)
        cosine = dr.dot(surface.shading, incoming)
        z = mi.Float(scene.directions[hits["direction"], 2])
        power = hits["power"] * albedo * scene.lobes.shape(number, cosine) * dr.maximum(cosine, 0)
        power *= dr.inv_pi * z / (dr.abs(dr.dot(surface.n, incoming)) * 2 * self.per_half)
        hits["power"] = mi.Color3f(power)
        dr.eval(hits["power"])

    def radiance(self, rows):
        """Light by way of the rest for some directions: [direction, half, texel, light, 3]."""
        import drjit as dr
        import mitsuba as mi

        lights, hits = self.scene.lights, self.hits
        n_lit = lights.count
        target = dr.zeros(mi.Float, len(rows) * 2 * self.n_texels * n_lit * 3)
        if hits is None:
            return target
        index = np.concatenate([np.arange(self.range[k], self.range[k + 1]) for k in rows])
        place = np.repeat(np.arange(len(rows)), [self.range[k + 1] - self.range[k] for k in rows])
        for sample in range(self.per_half):
            # Lanes of one sample write to places of their own.
            mine = hits["sample"][index] == sample
            if mine.any():
                self._bring(target, index[mine], place[mine])
        return target

    def _bring(self, target, index, place):
        """Connect some hits to all lights and follow their walks."""
        import drjit as dr
        import mitsuba as mi

        scene, lights, hits = self.scene, self.scene.lights, self.hits
        lobes, cache = scene.lobes, scene.cache
        slot = (place * 2 + hits["half"][index]) * self.n_texels + hits["texel"][index]
        offset = mi.UInt32((slot * (3 * lights.count)).astype(np.uint32))
        at = mi.UInt32(index.astype(np.uint32))
        si, bsdf, number, albedo = hits["surface"].interaction(at)
        si.wi = si.to_local(dr.gather(mi.Vector3f, hits["wi"], at))
        weight = dr.gather(mi.Color3f, hits["weight"], at) * dr.opaque(mi.Float, 1 / self.per_half)
        n, coded = dr.opaque(mi.UInt32, cache.n), hits["coded"]

        def sees(k):
            return cache.value(dr.gather(mi.UInt8, coded, dr.fma(at, n, k)))

        connect(lobes, lights, target, (si, bsdf, number, albedo, weight), offset, sees, stride=3)
        if self.n_vertices < 3:
            return
        keys = stream_keys(self.seed, _REST)
        lane = dr.gather(mi.UInt32, hits["lane"], at)
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
            vertex=3, last=self.n_vertices, stride=3, broad_first=False,
        )  # fmt: skip

    def splatted(self, rows, texels):
        """Photons as the texels of some directions see them: sums and sums of squares.

        Returns
        -------
        tuple of mitsuba.Float
            [direction, texel, light, 3] each.
        """
        import drjit as dr
        import mitsuba as mi

        scene, lights, hits = self.scene, self.scene.lights, self.hits
        n_lit = lights.count
        size = len(rows) * self.n_texels * n_lit * 3
        sums, squares = dr.zeros(mi.Float, size), dr.zeros(mi.Float, size)
        if hits is None or not scene.lobes.any:
            return sums, squares
        surface, cache = hits["surface"], scene.cache
        lane = dr.arange(mi.UInt32, n_lit * len(rows))
        n_rows = dr.opaque(mi.UInt32, len(rows))
        light, place = lane // n_rows, lane % n_rows
        row = dr.gather(mi.UInt32, mi.UInt32(np.asarray(rows, np.uint32)), place)
        w = dr.gather(mi.Vector3f, cache.vectors, row)
        bounds, own = mi.UInt32(self.range.astype(np.uint32)), dr.gather(mi.UInt32, lights.rows, light)
        begin, end = dr.gather(mi.UInt32, bounds, own), dr.gather(mi.UInt32, bounds, own + 1)
        height, width = texels
        base = place * (self.n_texels * n_lit) + light
        n = dr.opaque(mi.UInt32, cache.n)

        def step(i):
            seen = cache.value(dr.gather(mi.UInt8, hits["coded"], dr.fma(i, n, row)))
            number = dr.gather(mi.UInt32, surface.number, i)
            shape = scene.lobes.shape(number, dr.dot(dr.gather(mi.Vector3f, surface.shading, i), w))
            factor = seen * shape * dr.abs(dr.dot(dr.gather(mi.Vector3f, surface.n, i), w)) / w.z
            value = dr.gather(mi.Color3f, hits["power"], i) * factor
            p = dr.gather(mi.Point3f, surface.p, i)
            x, y = p.x - p.z * w.x / w.z, p.y - p.z * w.y / w.z
            column = dr.minimum(mi.UInt32((x - dr.floor(x)) * width), width - 1)
            line = dr.minimum(mi.UInt32((y - dr.floor(y)) * height), height - 1)
            at = 3 * dr.fma(line * width + column, n_lit, base)
            bright = dr.max(dr.abs(value)) > 0
            for channel in range(3):
                # A lane has one view and one light: its entries are its own, its order that of the photons.
                for target, term in ((sums, value[channel]), (squares, dr.square(value[channel]))):
                    dr.scatter_add(target, term, at + channel, bright, mode=dr.ReduceMode.NoConflicts)
            return (i + 1,)

        dr.while_loop((begin,), lambda i: i < end, step)
        dr.eval(sums, squares)
        return sums, squares


def _joined(parts):
    """Hits of several groups of directions, one after the other."""
    import drjit as dr

    if len(parts) == 1:
        return parts[0]

    def both(a, b):
        if isinstance(a, np.ndarray):
            return np.concatenate([a, b])
        if isinstance(a, Surface):
            return a.joined(b)
        if dr.depth_v(a) == 1:
            return dr.concat([a, b])
        return type(a)(*(dr.concat([a[k], b[k]]) for k in range(len(a))))

    result = parts[0]
    for part in parts[1:]:
        result = {name: both(result[name], part[name]) for name in result}
    dr.eval({name: value for name, value in result.items() if not isinstance(value, np.ndarray | Surface)})
    return result
