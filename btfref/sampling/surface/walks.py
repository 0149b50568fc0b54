"""Surface records in Dr.Jit, their visibility, and walks that connect every vertex to all lights."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from btfref.numerics.device_arrays import in_one_kernel, packed, to_device, unpacked
from btfref.sampling.paths.estimator import ROULETTE_LIMIT, ROULETTE_VERTEX
from btfref.sampling.tiled_scene import uniforms
from btfref.types import JitArray

if TYPE_CHECKING:
    from btfref.sampling.surface.cache import VisibilityCache
    from btfref.sampling.surface.lobes import BroadLobes
    from btfref.sampling.surface.points import Points
    from btfref.sampling.tiled_scene import TiledScene

#: Lights that one lane serves, and multiple of the number of lanes of a vertex or a texel: whole SIMD packets then
#: share what is looked up for all lights, and what one of their lanes need not evaluate none does.
LIGHTS_PER_LANE, PACKET = 6, 8

_FIELDS = ("p", "n", "s", "shading", "uv", "number", "albedo")


#: What vertices bring: of the numbers of some, a function of a light and the number of its direction.
Bring: TypeAlias = Callable[[JitArray], Callable[[JitArray, JitArray, JitArray], JitArray]]


@dataclass
class Surface:
    """Places on the surface as Dr.Jit arrays: what a BSDF needs to know of each.

    Attributes
    ----------
    p, n, s, shading : mitsuba.Point3f, mitsuba.Vector3f
        Position, geometric normal, tangent and shading normal.
    uv : mitsuba.Point2f
    number : mitsuba.UInt32
        BSDF as Dr.Jit's number of it; 0 for the absorber.
    albedo : mitsuba.Color3f
        ρ of the broad lobe.
    table : mitsuba.Float
        All of these side by side, for lookups; where only these are wanted the others are None.
    """

    p: Any = None
    n: Any = None
    s: Any = None
    shading: Any = None
    uv: Any = None
    number: Any = None
    albedo: Any = None
    table: Any = None

    @classmethod
    def of_points(cls, points: Points, lobes: BroadLobes) -> Surface:
        """From `btfref.sampling.surface.points.Points`."""
        import mitsuba as mi

        ids = np.array([*lobes.ids, 0], np.uint32)  # the absorber's part is −1
        place = cls(
            to_device(mi.Point3f, points.p.T),
            to_device(mi.Vector3f, points.n.T),
            to_device(mi.Vector3f, points.s.T),
            to_device(mi.Vector3f, points.shading.T),
            to_device(mi.Point2f, points.uv.T),
            to_device(mi.UInt32, ids[points.part]),
            mi.Color3f(0),
        )
        return place._finished(lobes)

    @classmethod
    def of_interaction(cls, hit: JitArray, lobes: BroadLobes) -> Surface:
        """From surface interactions; invalid ones become the absorber."""
        import drjit as dr
        import mitsuba as mi

        number = dr.select(hit.is_valid(), dr.reinterpret_array(mi.UInt32, hit.bsdf()), 0)
        place = cls(
            mi.Point3f(hit.p),
            mi.Vector3f(hit.n),
            mi.Vector3f(hit.sh_frame.s),
            mi.Vector3f(hit.sh_frame.n),
            mi.Point2f(hit.uv),
            number,
            mi.Color3f(0),
        )
        return place._finished(lobes)

    def _finished(self, lobes: BroadLobes) -> Surface:
        import drjit as dr

        si, bsdf, number, _ = self.interaction(None)
        self.albedo = lobes.albedo(bsdf, number, si)
        self.albedo += dr.zeros(type(self.albedo), dr.width(self.number))
        dr.eval(self._values())
        return self._tabled()

    def _tabled(self) -> Surface:
        import drjit as dr
        import mitsuba as mi

        number = dr.reinterpret_array(mi.Float, self.number)
        values = (
            self.p,
            self.uv.x,
            self.n,
            self.uv.y,
            self.s,
            number,
            self.shading,
            mi.Float(0),
            self.albedo,
            mi.Float(0),
        )
        self.table = packed([x for value in values for x in (value if dr.depth_v(value) > 1 else (value,))])
        return self

    def for_lookups(self) -> Surface:
        """These records for `interaction` at an index alone, at half of the memory."""
        return Surface(table=self.table)

    def taken(self, index: JitArray) -> Surface:
        """The records of an index (mitsuba.UInt32)."""
        import drjit as dr

        parts = [dr.gather(type(value), value, index) for value in self._values()]
        dr.eval(*parts)
        return Surface(*parts)._tabled()

    def joined(self, other: Surface) -> Surface:
        """These records and then the others."""
        import drjit as dr

        def both(a: JitArray, b: JitArray) -> JitArray:
            if dr.depth_v(a) == 1:
                return dr.concat([a, b])
            return type(a)(*(dr.concat([a[k], b[k]]) for k in range(len(a))))

        parts = [both(a, b) for a, b in zip(self._values(), other._values(), strict=True)]
        dr.eval(*parts)
        return Surface(*parts)._tabled()

    def _values(self) -> list[JitArray]:
        return [getattr(self, name) for name in _FIELDS]

    def interaction(
        self, index: JitArray | None, active: JitArray = True
    ) -> tuple[JitArray, JitArray, JitArray, JitArray]:
        """Surface interactions, BSDF pointers, their numbers, and ρ, at an index (None for all)."""
        import drjit as dr
        import mitsuba as mi

        if index is None:
            p, n, s, shading, uv, number, albedo = self._values()
        else:
            e = unpacked(self.table, index, 20, active)
            p, n, s, shading = (
                mi.Point3f(e[:3]),
                mi.Vector3f(e[4:7]),
                mi.Vector3f(e[8:11]),
                mi.Vector3f(e[12:15]),
            )
            uv, number, albedo = (
                mi.Point2f(e[3], e[7]),
                dr.reinterpret_array(mi.UInt32, e[11]),
                mi.Color3f(e[16:19]),
            )
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(p))
        si.p, si.n, si.uv, si.dp_du = p, mi.Normal3f(n), uv, s
        si.sh_frame = mi.Frame3f(s, dr.cross(shading, s), mi.Normal3f(shading))
        return si, dr.reinterpret_array(mi.BSDFPtr, number), number, albedo


def visibility(
    tiles: TiledScene, surface: Surface, directions: np.ndarray, *, front_only: bool = False
) -> np.ndarray:
    """Which directions the records see.

    Parameters
    ----------
    tiles : TiledScene
    surface : Surface
    directions : ndarray (n, 3)
    front_only : bool
        Leave out what lies behind the surface.

    Returns
    -------
    ndarray (n, records) of uint8
    """
    import drjit as dr
    import mitsuba as mi

    n_records, n_directions = dr.width(surface.number), len(directions)
    result = dr.zeros(mi.UInt8, n_records * n_directions)
    vectors = to_device(mi.Float, np.asarray(directions))
    count, records = dr.opaque(mi.UInt32, n_directions), dr.opaque(mi.UInt32, n_records)
    lane = dr.arange(mi.UInt32, n_records)
    si = dr.zeros(mi.SurfaceInteraction3f, n_records)
    si.p, si.n = surface.p, mi.Normal3f(surface.n)

    def look(i: JitArray) -> tuple[JitArray]:
        w = dr.gather(mi.Vector3f, vectors, i)
        active = dr.dot(si.n, w) > 0 if front_only else mi.Bool(True)
        free = active & ~tiles.occluded(si.spawn_ray(w), active)
        dr.scatter(result, mi.UInt8(dr.select(free, mi.UInt32(1), mi.UInt32(0))), dr.fma(i, records, lane))
        return (i + 1,)

    dr.while_loop((dr.zeros(mi.UInt32, n_records),), lambda i: i < count, look)
    return result.numpy().reshape(n_directions, n_records)


@dataclass
class Lights:
    """Directions of the lights, and the numbers of those directions.

    Attributes
    ----------
    vectors : mitsuba.Float
        Flat.
    rows : mitsuba.UInt32
    """

    vectors: Any
    rows: Any

    @property
    def count(self) -> int:
        """Number of lights."""
        import drjit as dr

        return dr.width(self.rows)

    def division(self) -> tuple[int, int]:
        """Lanes that share the lights, and lights of each, as many lanes apart: neighbours read neighbours."""
        lanes = -(-self.count // LIGHTS_PER_LANE)
        if lanes > PACKET // 2:
            lanes = -(-lanes // PACKET) * PACKET
        return lanes, -(-self.count // lanes)


def connect(lights: Lights, target: JitArray, offset: JitArray, bring: Bring, *, stride: int) -> None:
    """Add what vertices get from all lights to ``target``, in the order of the vertices.

    Parameters
    ----------
    lights : Lights
    target : mitsuba.Float
    offset : mitsuba.UInt32
        Where in ``target`` the first light of each vertex goes; each ``stride`` further. Vertices may share places.
    bring : callable
        ``bring(i)`` for the numbers of some vertices gives a callable of a light, ``(w, row, wanted) ->
        mitsuba.Color3f``: weight · BSDF · cosine · visibility; row is the number of the light's direction, and what is
        not wanted need not be evaluated.
    """
    import drjit as dr
    import mitsuba as mi

    # Lanes are places and blocks of lights, neighbours read the same vertices; a place is written once, without
    # atomics, and the bytes are the same every time.
    places = offset.numpy()
    order = np.argsort(places, kind="stable")
    places = places[order]
    first = np.flatnonzero(np.concatenate([[True], places[1:] != places[:-1]]))
    start = to_device(mi.UInt32, np.append(first, len(places)))
    order, places = to_device(mi.UInt32, order), to_device(mi.UInt32, places[first])
    (n_blocks, n_slots), count = lights.division(), dr.opaque(mi.UInt32, lights.count)
    lane = dr.arange(mi.UInt32, len(first) * n_blocks)
    blocks = dr.opaque(mi.UInt32, n_blocks)
    place, light = lane // blocks, [lane % blocks + j * blocks for j in range(n_slots)]
    chosen = [dr.minimum(k, count - 1) for k in light]
    vectors = [dr.gather(mi.Vector3f, lights.vectors, k) for k in chosen]
    rows = [dr.gather(mi.UInt32, lights.rows, k) for k in chosen]
    wanted = [k < count for k in light]
    begin, end = dr.gather(mi.UInt32, start, place), dr.gather(mi.UInt32, start, place + 1)

    def step(i: JitArray, sums: tuple[JitArray, ...]) -> tuple[JitArray, tuple[JitArray, ...]]:
        from_light = bring(dr.gather(mi.UInt32, order, i))
        return i + 1, tuple(
            a + from_light(*light) for a, *light in zip(sums, vectors, rows, wanted, strict=True)
        )

    zero = dr.zeros(mi.Float, dr.width(lane))
    state = (begin, tuple(mi.Color3f(zero) for _ in chosen))
    _, sums = dr.while_loop(state, lambda i, _: i < end, step)
    at = dr.gather(mi.UInt32, places, place)

    def write() -> None:
        for j, value in enumerate(sums):
            for channel in range(3):
                dr.scatter_add(
                    target,
                    value[channel],
                    dr.fma(light[j], stride, at) + channel,
                    wanted[j],
                    mode=dr.ReduceMode.NoConflicts,
                )

    in_one_kernel(dr.width(lane), write)
    dr.eval(target)


def continue_walks(
    tiles: TiledScene,
    lobes: BroadLobes,
    cache: VisibilityCache,
    lights: Lights,
    target: JitArray,
    state: dict[str, JitArray],
    keys: Sequence[JitArray],
    *,
    vertex: int,
    last: int,
    stride: int,
    broad_first: bool,
    count: int,
) -> None:
    """Follow walks from their first ray to the last vertex, connecting each vertex to all lights.

    Parameters
    ----------
    cache : VisibilityCache
    lights : Lights
    state : dict
        ``lane``, ``target`` (offset), ``origin``, ``direction``, ``weight``.
    vertex, last : int
        Number of the next vertex of the path (the visible point is 1), and of the last one.
    broad_first : bool
        At the first vertex connect by the broad lobe only: photons bring the rest.
    count : int
        Walks that share a target. It divides what they bring and not their weights: roulette must not end a
        walk because there are many.
    """
    import drjit as dr
    import mitsuba as mi

    share = dr.opaque(mi.Float, 1 / count)
    names = ("lane", "target", "origin", "direction", "weight")
    values = [state[name] for name in names]
    alive = dr.max(dr.abs(values[4])) > 0
    dr.eval(values, alive)
    first = True
    while vertex <= last:
        index = dr.compress(alive)
        if dr.width(index) == 0:
            return
        lane, offset, origin, direction, weight = (dr.gather(type(a), a, index) for a in values)
        index, hit, place = tiles.reached(origin, direction)
        if dr.width(index) == 0:
            return
        surface = Surface.of_interaction(hit, lobes)
        row = cache.row(place, surface.number)
        lane, offset, weight, direction = (
            dr.gather(type(a), a, index) for a in (lane, offset, weight, direction)
        )
        dr.eval(row, lane, offset, weight, direction)
        si, bsdf, _, _ = surface.interaction(None)
        si.wi = si.to_local(-direction)
        depth = dr.opaque(mi.UInt32, 2 * vertex)
        lobe, u, v, _ = uniforms(lane, keys, depth)
        roulette, choice, _, _ = uniforms(lane, keys, depth + 1)
        if vertex < last:
            sample, gain = bsdf.sample(lobes.full, si, lobe, mi.Point2f(u, v))
            onward = weight * gain
            survival = dr.minimum(dr.max(dr.abs(onward)), ROULETTE_LIMIT)
            survival = dr.select(dr.opaque(mi.UInt32, vertex) >= ROULETTE_VERTEX, survival, 1)
            alive = (dr.max(dr.abs(onward)) > 0) & (roulette < survival)
            onward = dr.select(alive, onward / survival, 0)
            ray = si.spawn_ray(si.to_world(sample.wo))
            values = [lane, offset, mi.Point3f(ray.o), mi.Vector3f(ray.d), mi.Color3f(onward)]
            dr.eval(values, alive)
        coded = cache.sights(tiles, si, row, choice, towards=-direction)
        dr.eval(offset)
        what = packed([*si.wi, mi.Float(0), *(share * weight), mi.Float(0)])
        vertices = surface, what, coded
        connect(
            lights, target, offset, _bringing(lobes, cache, vertices, first and broad_first), stride=stride
        )
        first = False
        vertex += 1


def _bringing(
    lobes: BroadLobes, cache: VisibilityCache, vertices: tuple[Surface, JitArray, JitArray], broad: bool
) -> Bring:
    """What `connect` asks for, at vertices of walks: by the broad lobe alone, or by the whole BSDF."""
    import drjit as dr
    import mitsuba as mi

    surface, what, coded = vertices
    n = dr.opaque(mi.UInt32, cache.n)

    def bring(i: JitArray) -> Callable[[JitArray, JitArray, JitArray], JitArray]:
        si, bsdf, number, albedo = surface.interaction(i)
        e = unpacked(what, i, 8)
        si.wi, gain = mi.Vector3f(e[:3]), mi.Color3f(e[4:7])

        def from_light(w: JitArray, row: JitArray, wanted: JitArray) -> JitArray:
            seen = cache.value(dr.gather(mi.UInt8, coded, dr.fma(i, n, row)))
            local = si.to_local(w)
            if broad:
                return gain * lobes.value(number, albedo, si.wi, local) * seen
            return gain * bsdf.eval(lobes.full, si, local, (seen != 0) & wanted) * seen

        return from_light

    return bring
