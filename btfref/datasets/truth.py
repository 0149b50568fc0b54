"""What is known of a modelled surface besides its BTF: maps seen from above, and light apart by its bounces."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from btfref.datasets.sets import MAP_SEED, MAX_DEPTH
from btfref.numerics.device_arrays import to_device
from btfref.querying.paths import REACH, PathSource
from btfref.querying.settings import QuerySettings
from btfref.sampling.tiled_scene import START, TiledScene, stream_keys, uniforms
from btfref.sampling.variant import mitsuba_variant

if TYPE_CHECKING:
    from btfref.mesostructure.base import Mesostructure
    from btfref.types import JitArray

#: Maps and what they hold.
MAPS = {
    "height": "z of the surface seen from above, tile units, at most 0",
    "normal": "its shading normal, unit vectors of the local frame",
    "material": "number of the part of the mesostructure",
    "albedo": "share of light from the normal that the material scatters, linear RGB",
    "visibility": "share of the cosine-weighted hemisphere about the shading normal that no geometry hides",
    "direct": "share of cosine-weighted light from all directions that is seen from above after one bounce",
    "indirect": "and after two and more",
}

#: Directions of `visibility` and samples of `albedo`, stratified.
_SIDE = 12


def truth_maps(mesostructure: Mesostructure, texels: int, lights: int, variant: str) -> dict[str, np.ndarray]:
    """All maps of a mesostructure.

    Parameters
    ----------
    mesostructure : Mesostructure
    texels : int
        Along a side; maps are [row, column, …], values at texels' centres but for the last two, which are means over
        texels.
    lights : int
        Light directions of each texel of the last two.
    variant : str
        Of Mitsuba.

    Returns
    -------
    dict of str to ndarray
        Of `MAPS`: float32, ``material`` uint8.
    """
    with mitsuba_variant(variant):
        maps = _from_above(mesostructure, texels)
        sources = [_source(mesostructure, depth, lights, variant) for depth in (2, MAX_DEPTH)]
        direct, full = (_reflected(source, texels, lights) for source in sources)
    # The same paths: what differs is what comes after the first bounce.
    return maps | {"direct": direct, "indirect": full - direct}


def centres(texels: int) -> np.ndarray:
    """Texels' centres (n², 2), row by row."""
    line = (np.arange(texels) + 0.5) / texels
    u, v = np.meshgrid(line, line)
    return np.stack([u, v], -1).reshape(-1, 2)


def _source(mesostructure: Mesostructure, depth: int, lights: int, variant: str) -> PathSource:
    settings = QuerySettings(n=1, spp=1, seed=MAP_SEED, max_depth=depth, footprint="square", variant=variant)
    return PathSource(mesostructure, settings)


def _reflected(source: PathSource, texels: int, lights: int) -> np.ndarray:
    """Mean of π B / cos θ over cosine-distributed lights, seen from above, float32 (n, n, 3)."""
    uv = np.repeat(centres(texels), lights, 0)
    rng = np.random.default_rng([MAP_SEED, texels])
    z = np.sqrt(1 - rng.random(len(uv)))
    phi = 2 * np.pi * rng.random(len(uv))
    r = np.sqrt(np.maximum(1 - z * z, 0))
    rows = {
        "uv": uv,
        "radius": np.full(len(uv), 0.5 / texels),
        "w_light": np.stack([r * np.cos(phi), r * np.sin(phi), z], -1),
        "w_view": np.broadcast_to([0.0, 0.0, 1.0], (len(uv), 3)),
    }
    found = source.paths.samples(
        {key: np.ascontiguousarray(value, np.float32) for key, value in rows.items()},
        np.arange(len(uv)),
        1,
    )[0]
    share = np.pi * found.astype(np.float64) / z[:, None]
    return share.reshape(texels, texels, lights, 3).mean(2).astype(np.float32)


def _from_above(mesostructure: Mesostructure, texels: int) -> dict[str, np.ndarray]:
    """The maps that rays straight down find."""
    import drjit as dr
    import mitsuba as mi

    tiles = TiledScene(mesostructure, np.array([[np.sin(REACH), 0, np.cos(REACH)]]))
    tiles.wrap_shadows = tiles.low < 0
    uv = to_device(mi.Point2f, centres(texels).T)
    n = texels * texels
    si = tiles.intersect(mi.Point3f(uv.x, uv.y, START), mi.Vector3f(0, 0, -1))
    bsdf = si.bsdf()
    pointers = [int(dr.reinterpret_array(mi.UInt32, mi.BSDFPtr(one))[0]) for one in tiles.bsdfs]
    found = dr.reinterpret_array(mi.UInt32, bsdf).numpy()
    valid = si.is_valid()
    words = stream_keys(MAP_SEED, 1)
    albedo, open_ = dr.opaque(mi.Color3f, 0, n), dr.opaque(mi.Float, 0, n)
    context = mi.BSDFContext()
    dr.eval(si, bsdf, valid)
    for k in range(_SIDE * _SIDE):
        # Opaque, so that all of them are one kernel.
        number, column, row = (dr.opaque(mi.UInt32, word) for word in (k, k % _SIDE, k // _SIDE))
        u, v, lobe, _ = uniforms(dr.arange(mi.UInt32, n), words, number)
        u, v = (mi.Float(column) + u) / _SIDE, (mi.Float(row) + v) / _SIDE
        above = type(si)(si)
        above.wi = mi.Vector3f(0, 0, 1)
        _, weight = bsdf.sample(context, above, lobe, mi.Point2f(u, v), valid)
        albedo += weight
        local = mi.warp.square_to_cosine_hemisphere(mi.Point2f(u, v))
        ray = si.spawn_ray(si.sh_frame.to_world(local))
        blocked = tiles.occluded(ray, valid, coherent=False)
        open_ += dr.select(valid & ~blocked, 1, 0)
        dr.eval(albedo, open_)
    count = _SIDE * _SIDE

    def shaped(values: JitArray, width: int) -> np.ndarray:
        array = np.array(values, np.float32).reshape(width, n).T
        array = np.where(np.array(valid)[:, None], array, 0)
        return array.reshape(texels, texels, *([width] if width > 1 else []))

    numbers = np.zeros(n, np.uint8)
    for number, pointer in enumerate(pointers):
        numbers[found == pointer] = number
    return {
        "height": shaped(si.p.z, 1),
        "normal": shaped(si.sh_frame.n, 3),
        "material": numbers.reshape(texels, texels),
        "albedo": shaped(albedo / count, 3),
        "visibility": shaped(open_ / count, 1),
    }
