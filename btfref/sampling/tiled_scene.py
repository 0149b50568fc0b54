"""The infinitely tiled mesostructure as a Mitsuba scene, with rays that never see the end of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from btfref.mesostructure.base import Mesostructure
    from btfref.types import JitArray

#: Largest number of tiles on each side of the central one; beyond it rays are wrapped instead.
MAXIMUM_REACH = 4

#: Crossings of the tiled patch after which a ray counts as escaped. A ray needs |d_z| below
#: height / (MAXIMUM_ROUNDS · reach), i.e. under 1e-4 · height, and no hit on its way, to be concerned.
MAXIMUM_ROUNDS = 10_000

#: Where a view ray starts, in tile units above the sampling plane along w_view.
START = 0.125


class TiledScene:
    """A patch of tiles; rays that leave it inside the slab of the mesostructure enter the other side.

    Parameters
    ----------
    mesostructure : Mesostructure
    directions : ndarray, shape (n, 3)
        Unit vectors of the rays to the outside: the patch is made large enough for them, up to a limit.

    Attributes
    ----------
    scene : mitsuba.Scene
    bsdfs : list of mitsuba.BSDF
        One per part.
    masked : bool
        Whether a part lets light through without turning it: shadow rays then want `transmittance`.
    """

    def __init__(self, mesostructure: Mesostructure, directions: ArrayLike) -> None:
        import mitsuba as mi

        from btfref.mesostructure.materials import load_bsdf
        from btfref.mesostructure.tiling import tiled_shapes

        self.low, self.high = mesostructure.height
        up = np.asarray(directions, dtype=np.float64)
        z = up[up[:, 2] > 0, 2]
        z = z if len(z) else np.ones(1)
        across = -self.low * float((np.sqrt(1 - np.minimum(z, 1) ** 2) / z).max()) + mesostructure.overhang
        # A shadow ray from the depth of the mesostructure to its top must not leave the patch, or it is
        # wrapped.
        self.reach = int(np.clip(math.ceil(across + START), 1, MAXIMUM_REACH))
        self.wrap_shadows = across > self.reach
        # Geometry that sticks out of its tile must be complete as far as any ray goes.
        margin = self.reach + math.ceil(mesostructure.overhang)
        offsets = range(-margin, margin + 1)
        self.bsdfs = [load_bsdf(part) for part in mesostructure.parts]
        self.masked = any(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null) for bsdf in self.bsdfs)
        shapes = tiled_shapes(mesostructure, offsets, offsets, bsdfs=self.bsdfs)
        self.scene = mi.load_dict({"type": "scene", **shapes})

    def _travel(self, direction: JitArray) -> JitArray:
        """Distance along a ray from the central tile that surely stays in the patch."""
        import drjit as dr

        return dr.minimum(self.reach / dr.maximum(dr.abs(direction.x), dr.abs(direction.y)), 1e4)

    def _wrapped(self, origin: JitArray, direction: JitArray, travel: JitArray) -> tuple[JitArray, JitArray]:
        """The place at the patch's border, taken to the central tile, and whether the slab goes on there."""
        import drjit as dr
        import mitsuba as mi

        end = dr.fma(direction, travel, origin)
        inside = dr.select(direction.z <= 0, end.z >= self.low, end.z <= self.high)
        return mi.Point3f(end.x - dr.floor(end.x), end.y - dr.floor(end.y), end.z), inside

    def intersect(self, origin: JitArray, direction: JitArray) -> JitArray:
        """First hit of rays on the infinitely tiled surface, moved to the central tile.

        Parameters
        ----------
        origin : mitsuba.Point3f
        direction : mitsuba.Vector3f

        Returns
        -------
        mitsuba.SurfaceInteraction3f
        """
        return self.locate(origin, direction)[0]

    def locate(self, origin: JitArray, direction: JitArray) -> tuple[JitArray, JitArray]:
        """As `intersect`, and the preliminary intersection, which knows the triangle."""
        origin, hit = self._search(origin, direction, True)
        return self._interaction(origin, direction, hit), hit

    def reached(
        self, origin: JitArray, direction: JitArray, active: JitArray = True
    ) -> tuple[JitArray, JitArray, JitArray]:
        """As `locate`, of the rays that hit something alone: most of those that leave a surface do not.

        Parameters
        ----------
        origin : mitsuba.Point3f
        direction : mitsuba.Vector3f
        active : mitsuba.Bool
            Rays to be traced.

        Returns
        -------
        index : mitsuba.UInt32
            Which rays hit.
        interaction, preliminary : mitsuba.SurfaceInteraction3f, mitsuba.PreliminaryIntersection3f
            Of these; of any width where there are none.
        """
        import drjit as dr
        import mitsuba as mi

        origin, hit = self._search(origin, direction, active)
        valid = hit.is_valid()
        dr.eval(origin, hit, valid)
        index = dr.compress(valid)
        if dr.width(index) == 0:
            return index, dr.zeros(mi.SurfaceInteraction3f), dr.zeros(mi.PreliminaryIntersection3f)
        origin, direction, hit = (dr.gather(type(a), a, index) for a in (origin, direction, hit))
        return index, self._interaction(origin, direction, hit), hit

    def _search(self, origin: JitArray, direction: JitArray, active: JitArray) -> tuple[JitArray, JitArray]:
        """Start of the part of each ray that hits something, and the preliminary intersection."""
        import drjit as dr
        import mitsuba as mi

        travel = self._travel(direction)
        origin = mi.Point3f(origin.x - dr.floor(origin.x), origin.y - dr.floor(origin.y), origin.z)

        def search(
            origin: JitArray, hit: JitArray, searching: JitArray, rounds: JitArray
        ) -> tuple[JitArray, ...]:
            ray = mi.Ray3f(origin, direction)
            ray.maxt = travel
            hit = self.scene.ray_intersect_preliminary(ray, coherent=False, active=searching)
            end, inside = self._wrapped(origin, direction, travel)
            searching = searching & ~hit.is_valid() & inside & (rounds < MAXIMUM_ROUNDS)
            origin = dr.select(searching, end, origin)
            return origin, hit, searching, rounds + 1

        width = dr.width(origin)
        hit = dr.zeros(mi.PreliminaryIntersection3f, width)
        hit.t = dr.full(mi.Float, math.inf, width)
        state = (origin, hit, dr.full(mi.Bool, True, width) & active, dr.zeros(mi.UInt32, width))
        origin, hit, _, _ = dr.while_loop(state, lambda origin, hit, searching, rounds: searching, search)
        return origin, hit

    def _interaction(self, origin: JitArray, direction: JitArray, hit: JitArray) -> JitArray:
        """What is known of a hit, moved to the central tile."""
        import drjit as dr
        import mitsuba as mi

        interaction = hit.compute_surface_interaction(
            mi.Ray3f(origin, direction), mi.RayFlags.All, hit.is_valid()
        )
        p = interaction.p
        interaction.p = mi.Point3f(p.x - dr.floor(p.x), p.y - dr.floor(p.y), p.z)
        return interaction

    def occluded(self, ray: JitArray, active: JitArray, *, coherent: bool = True) -> JitArray:
        """Whether the infinitely tiled surface blocks rays that start in the central tile.

        Parameters
        ----------
        ray : mitsuba.Ray3f
        active : mitsuba.Bool
        coherent : bool
            Whether neighbouring rays are alike.

        Returns
        -------
        mitsuba.Bool
        """
        import drjit as dr
        import mitsuba as mi

        if not self.wrap_shadows:
            return self.scene.ray_test(ray, coherent=coherent, active=active)
        travel, direction = self._travel(ray.d), mi.Vector3f(ray.d)

        def search(
            origin: JitArray, blocked: JitArray, searching: JitArray, rounds: JitArray
        ) -> tuple[JitArray, ...]:
            part = mi.Ray3f(origin, direction)
            part.maxt = travel
            blocked = blocked | self.scene.ray_test(part, coherent=coherent, active=searching)
            end, inside = self._wrapped(origin, direction, travel)
            searching = searching & ~blocked & inside & (rounds < MAXIMUM_ROUNDS)
            return dr.select(searching, end, origin), blocked, searching, rounds + 1

        state = (mi.Point3f(ray.o), mi.Bool(False), mi.Bool(active), mi.UInt32(0))
        return dr.while_loop(state, lambda origin, blocked, searching, rounds: searching, search)[1]

    def transmittance(self, ray: JitArray, active: JitArray) -> JitArray:
        """Share of light that reaches the origins of rays from the central tile through masked surfaces.

        Parameters
        ----------
        ray : mitsuba.Ray3f
        active : mitsuba.Bool

        Returns
        -------
        mitsuba.Color3f
            0 where a surface lets nothing through, 1 where there is none.
        """
        import drjit as dr
        import mitsuba as mi

        travel, direction = self._travel(ray.d), mi.Vector3f(ray.d)

        def search(
            origin: JitArray, left: JitArray, share: JitArray, searching: JitArray, rounds: JitArray
        ) -> tuple[JitArray, ...]:
            part = mi.Ray3f(origin, direction)
            part.maxt = left
            hit = self.scene.ray_intersect(part, mi.RayFlags.All, coherent=False, active=searching)
            found = searching & hit.is_valid()
            through = hit.bsdf().eval_null_transmission(hit, found)
            share = dr.select(found, share * mi.Color3f(through), share)
            end, inside = self._wrapped(origin, direction, left)
            origin = dr.select(found, mi.Point3f(hit.spawn_ray(direction).o), end)
            left = dr.select(found, left - hit.t, travel)
            searching = searching & (dr.max(share) > 0) & (found | inside) & (rounds < MAXIMUM_ROUNDS)
            return origin, left, share, searching, rounds + 1

        width = dr.width(direction)
        state = (
            mi.Point3f(ray.o),
            mi.Float(travel),
            dr.full(mi.Color3f, 1, width),
            mi.Bool(active),
            dr.zeros(mi.UInt32, width),
        )
        return dr.while_loop(state, lambda origin, left, share, searching, rounds: searching, search)[2]


def uniforms(
    lane: JitArray, keys: Sequence[JitArray], dimension: JitArray
) -> tuple[JitArray, JitArray, JitArray, JitArray]:
    """Four numbers in [0, 1) per lane and dimension: counter-based, so that no state travels with a path."""
    import mitsuba as mi

    a, b = mi.sample_tea_32(lane ^ keys[0], keys[1], 6)
    words = (*mi.sample_tea_32(a, b + 2 * dimension, 6), *mi.sample_tea_32(a, b + 2 * dimension + 1, 6))
    return tuple(mi.Float(word >> 8) * 2.0**-24 for word in words)


def stream_keys(*words: int) -> list[JitArray]:
    """Two opaque words that select a stream of `uniforms`; from any number of integers."""
    import drjit as dr
    import mitsuba as mi

    return [dr.opaque(mi.UInt32, word) for word in stream_words(*words)]


def stream_words(*words: int) -> tuple[int, int]:
    """The two words as numbers."""
    a, b = np.random.SeedSequence([int(word) for word in words]).generate_state(2, np.uint32)
    return int(a), int(b)


def rotated(u: JitArray, v: JitArray, number: JitArray) -> tuple[JitArray, JitArray]:
    """Two numbers in [0, 1) moved along the R2 sequence (Roberts 2018), modulo 1.

    Any of them is as uniform as the first; those of successive numbers fill the square evenly.

    Parameters
    ----------
    u, v : mitsuba.Float
    number : mitsuba.UInt32

    Returns
    -------
    tuple of mitsuba.Float
    """
    import drjit as dr
    import mitsuba as mi

    # Multiples modulo 2^32 are exact; floats of large numbers would be a coarse lattice.
    shift = (mi.Float((number * mi.UInt32(a)) >> 8) * 2.0**-24 for a in (3242174889, 2447445414))
    moved = (x + y for x, y in zip((u, v), shift, strict=True))
    return tuple(x - dr.select(x >= 1, 1, 0) for x in moved)
