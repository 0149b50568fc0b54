"""The gathering loop of the shared estimator: entries of each texel, lights, sums and their spread.

A texel's mean is made of two independent halves. With Y_h = Σ w L over a half's entries, W_h = Σ w whose
expectation is exactly 1, and R_h = Y_h / W_h, half h is corrected by what the other one says of the slope:
``Y_h − R_(1−h) (W_h − 1)``. No half's slope depends on its own points, so the mean is free of bias, and it is
about as quiet as the ratio Σ w L / Σ w. It equals ``½ [R_0 (1 + W_0 − W_1) + R_1 (1 + W_1 − W_0)]``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from btfref.numerics.device_arrays import in_one_kernel, packed, to_device, unpacked
from btfref.sampling.surface.points import starts

if TYPE_CHECKING:
    from btfref.sampling.surface.estimator import SurfaceScene
    from btfref.sampling.surface.points import Bins
    from btfref.sampling.surface.walks import Surface
    from btfref.types import JitArray

#: Bound of the correction n / (n − 1) of the variance for n entries, n counted by weight.
LEAST_FREEDOM = 4


def gather(
    scene: SurfaceScene,
    surface: Surface,
    table: JitArray,
    rows: Sequence[int],
    bins: list[Bins],
    *,
    radiance: JitArray | None,
    splats: list[JitArray] | None,
    texels: tuple[int, int],
    variance: bool = True,
) -> tuple[np.ndarray, np.ndarray | None]:
    """Means and variances of the mean of several views.

    Parameters
    ----------
    scene : SurfaceScene
    surface : Surface
    table : mitsuba.Float
        Per record and light: light by way of the broad lobe (3 numbers) and visibility.
    rows : sequence of int
        Numbers of the views' directions.
    bins : list of Bins
        One per view.
    radiance : mitsuba.Float
        Light by way of the rest, [view, half, texel, light, 3].
    splats : list of mitsuba.Float, or None
        Sums of photons, and with a variance sums of their squares, [view, light, texel, 3]; they are added to.
    texels : tuple of int
    variance : bool
        Whether variances are made.

    Returns
    -------
    mean, variance : ndarray (views, lights, texels, 3) float32
        None for a variance that is not wanted.

    Notes
    -----
    Variance of the points: pairs of a stratum are independent, so their squared differences are an unbiased
    estimate for any fixed slope (Wolter 2007, *Introduction to Variance Estimation*, sec. 2.2); a partner
    outside the texel counts as 0. Variance of the walks: the halves' squared difference, averaged over two by
    two texels. Photons are counted as a compound Poisson sum.
    """
    import drjit as dr
    import mitsuba as mi

    n_texels, n_lit = texels[0] * texels[1], scene.lights.count
    shape = (len(rows), n_lit, n_texels, 3)
    n_blocks, n_slots = scene.lights.division()
    halves = np.stack([some.totals for some in bins])  # view, half, texel
    share = to_device(mi.Float, 0.5 + 0.5 * (halves[:, 0] - halves[:, 1]))

    lane = dr.arange(mi.UInt32, len(rows) * n_texels * n_blocks)
    order = to_device(mi.UInt32, _order(bins))
    blocks = dr.opaque(mi.UInt32, n_blocks)
    cell, first = dr.gather(mi.UInt32, order, lane // blocks), lane % blocks
    view, texel = cell // n_texels, cell % n_texels
    lights = [first + j * blocks for j in range(n_slots)]
    points, spread = _points(scene, surface, table, rows, bins, cell, lights, variance)
    drafts = [dr.empty(mi.Float, int(np.prod(shape))) for _ in range(1 + variance)]
    mine = dr.gather(mi.Float, share, cell)
    pooled = None
    if variance and radiance is not None:
        pooled = _pooled(radiance, len(rows), texels, n_lit)
        block = (texel // texels[1] // 2) * ((texels[1] + 1) // 2) + texel % texels[1] // 2
        block += view * (((texels[0] + 1) // 2) * ((texels[1] + 1) // 2))

    def write() -> None:
        for j, light in enumerate(lights):
            inside = light < n_lit
            results = [points[j]] if spread is None else [points[j], spread[j]]
            if radiance is not None:
                at = (2 * view * n_texels + texel) * n_lit + light
                one = dr.gather(mi.Color3f, radiance, at, inside)
                other = dr.gather(mi.Color3f, radiance, at + n_texels * n_lit, inside)
                results[0] += mine * one + (1 - mine) * other
                if pooled is not None:
                    # The halves' shares are mine and 1 − mine, the pooled number is for ½ and ½.
                    scale = 2 * (dr.square(mine) + dr.square(1 - mine))
                    results[1] += scale * dr.gather(mi.Color3f, pooled, block * n_lit + light, inside)
            at = (cell * n_lit + light) * 3
            for draft, result in zip(drafts, results, strict=True):
                for channel in range(3):
                    dr.scatter(draft, result[channel], at + channel, inside)

    in_one_kernel(dr.width(lane), write)
    dr.eval(drafts)
    made = [
        _turned(draft, shape, None if splats is None else splats[k]).numpy().reshape(shape)
        for k, draft in enumerate(drafts)
    ]
    return made[0], made[1] if variance else None


def _order(bins: list[Bins]) -> np.ndarray:
    """Cells of several bins in the order of their first records: neighbours read the same rows of the table."""
    offsets = np.cumsum([0, *(len(some.record) for some in bins[:-1])])
    record = np.concatenate([*(some.record for some in bins), [0]])
    first = np.concatenate([some.start[:-1] + k for some, k in zip(bins, offsets, strict=True)])
    return np.argsort(record[np.minimum(first, len(record) - 1)], kind="stable")


def _turned(draft: JitArray, shape: tuple[int, int, int, int], target: JitArray | None) -> JitArray:
    """From [view, texel, light, 3], as lanes make them, to [view, light, texel, 3], added to a target if any."""
    import drjit as dr
    import mitsuba as mi

    _, n_lit, n_texels, _ = shape
    # Lanes: [view, texels by sixteen, light, one of sixteen]. What sixteen texels have is in the innermost cache
    # while their lights are written, whole lines each.
    side = 16 if n_texels % 16 == 0 else 1
    lane = dr.arange(mi.UInt32, dr.width(draft) // 3)
    inner, rest = lane % side, lane // side
    light, rest = rest % n_lit, rest // n_lit
    view, texel = rest // (n_texels // side), rest % (n_texels // side) * side + inner
    value = dr.gather(mi.Color3f, draft, (view * n_texels + texel) * n_lit + light)
    at = (view * n_lit + light) * n_texels + texel
    if target is None:
        target = dr.empty(mi.Float, dr.width(draft))
    else:
        value += dr.gather(mi.Color3f, target, at)

    def write() -> None:
        for channel in range(3):
            dr.scatter(target, value[channel], 3 * at + channel)

    in_one_kernel(dr.width(lane), write)
    dr.eval(target)
    return target


def _pooled(radiance: JitArray, n_views: int, texels: tuple[int, int], n_lit: int) -> JitArray:
    """Variance of the halves' mean over two by two texels: [view, block, light, 3]."""
    import drjit as dr
    import mitsuba as mi

    rows, columns = texels
    n_texels, wide, high = rows * columns, (columns + 1) // 2, (rows + 1) // 2
    lane = dr.arange(mi.UInt32, n_views * high * wide * n_lit)
    light, block = lane % n_lit, lane // n_lit
    view, y, x = block // (high * wide), block // wide % high, block % wide
    total = mi.Color3f(0)
    for dy in range(2):
        for dx in range(2):
            texel = dr.minimum(2 * y + dy, rows - 1) * columns + dr.minimum(2 * x + dx, columns - 1)
            at = (2 * view * n_texels + texel) * n_lit + light
            one = dr.gather(mi.Color3f, radiance, at)
            total += dr.square(one - dr.gather(mi.Color3f, radiance, at + n_texels * n_lit))
    result = dr.zeros(mi.Float, 3 * dr.width(lane))

    def write() -> None:
        for channel in range(3):
            dr.scatter(result, total[channel] / 16, 3 * lane + channel)

    in_one_kernel(dr.width(lane), write)
    dr.eval(result)
    return result


def _packets(scene: SurfaceScene, surface: Surface, rows: Sequence[int], bins: list[Bins]) -> JitArray:
    """What the loop needs to know of an entry, 16 numbers each: computed once, not once per light."""
    import drjit as dr
    import mitsuba as mi

    record = to_device(mi.UInt32, np.concatenate([some.record for some in bins]))
    row = np.repeat(np.asarray(rows, np.uint32), [len(some.record) for some in bins])
    w = dr.gather(mi.Vector3f, scene.cache.vectors, to_device(mi.UInt32, row))
    number = dr.gather(mi.UInt32, surface.number, record)
    shading, s = (dr.gather(mi.Vector3f, a, record) for a in (surface.shading, surface.s))
    wi = mi.Frame3f(s, dr.cross(shading, s), mi.Normal3f(shading)).to_local(w)
    uv = dr.gather(mi.Point2f, surface.uv, record)
    weight, part = (np.concatenate([getattr(some, name) for some in bins]) for name in ("weight", "part"))
    numbers, records = (mi.Float(dr.reinterpret_array(mi.Float, a)) for a in (number, record))
    weight, part = to_device(mi.Float, weight), to_device(mi.Float, part)
    shape = scene.lobes.shape(number, wi.z)
    return packed([*s, uv.x, *shading, uv.y, *wi, shape, part, numbers, records, weight])


def _points(
    scene: SurfaceScene,
    surface: Surface,
    table: JitArray,
    rows: Sequence[int],
    bins: list[Bins],
    cell: JitArray,
    index: list[JitArray],
    variance: bool,
) -> tuple[list[JitArray], list[JitArray] | None]:
    """Mean and its variance from the entries: per light of a lane one colour each.

    ``index`` are numbers of the lanes' lights, which may be beyond the last.
    """
    import drjit as dr
    import mitsuba as mi

    lights, lobes, block = scene.lights, scene.lobes, len(index)
    n_lit = lights.count
    start = starts(bins)
    n_entries, start = int(start[-1]), to_device(mi.UInt32, start)
    begin, end = dr.gather(mi.UInt32, start, cell), dr.gather(mi.UInt32, start, cell + 1)
    width = dr.width(cell)
    zero = dr.zeros(mi.Float, width)
    if n_entries == 0:
        return [mi.Color3f(zero) for _ in range(block)], [mi.Color3f(zero) for _ in range(block)]
    packets = _packets(scene, surface, rows, bins)
    inside, index = [i < n_lit for i in index], [dr.minimum(i, n_lit - 1) for i in index]
    vectors = [dr.gather(mi.Vector3f, lights.vectors, i) for i in index]
    light_count = dr.opaque(mi.UInt32, n_lit)
    # Direct light by way of broad lobes is in the table where they are the table's.
    context = lobes.drawn if lobes.exact else lobes.full

    def entry_values(entry: JitArray) -> tuple[JitArray, JitArray, JitArray, list[JitArray]]:
        e = unpacked(packets, entry, 16)
        si = dr.zeros(mi.SurfaceInteraction3f, width)
        s, shading = mi.Vector3f(e[:3]), mi.Vector3f(e[4:7])
        si.sh_frame = mi.Frame3f(s, dr.cross(shading, s), mi.Normal3f(shading))
        si.n = si.sh_frame.n
        si.uv = mi.Point2f(e[3], e[7])
        si.wi = mi.Vector3f(e[8:11])
        shape, part, weight = e[11], e[12], e[15]
        bsdf = dr.reinterpret_array(mi.BSDFPtr, dr.reinterpret_array(mi.UInt32, e[13]))
        record = dr.reinterpret_array(mi.UInt32, e[14])
        values = []
        for j in range(block):
            row = dr.gather(mi.Array4f, table, dr.fma(record, light_count, index[j]))
            # Zero where the light is hidden.
            direct = bsdf.eval(context, si, si.to_local(vectors[j]), (row.w != 0) & inside[j])
            values.append(dr.fma(mi.Color3f(row.x, row.y, row.z), shape, direct * row.w))
        return part, weight, record, values

    colours = tuple(mi.Color3f(zero) for _ in range(block))

    def step_of_means(entry: JitArray, sums: tuple[JitArray, ...]) -> tuple[JitArray, tuple[JitArray, ...]]:
        part, _, _, values = entry_values(entry)
        return entry + 1, tuple(dr.fma(part, value, a) for value, a in zip(values, sums, strict=True))

    if not variance:
        _, sums = dr.while_loop((begin, colours), lambda entry, *_: entry < end, step_of_means)
        return list(sums), None

    def step(
        entry: JitArray,
        scale: JitArray,
        weights: tuple[JitArray, JitArray],
        last_w: JitArray,
        last_pair: JitArray,
        last: Sequence[JitArray],
        dd: Sequence[JitArray],
        dx: Sequence[JitArray],
        dw: JitArray,
        sums: Sequence[JitArray],
    ) -> tuple[JitArray, ...]:
        part, weight, record, values = entry_values(entry)
        # The partner of the same stratum comes just before; alone in the texel, an entry differs from 0.
        pair = record >> 1
        together = pair == last_pair
        latest, dds, dxs, totals = list(last), list(dd), list(dx), list(sums)
        kept_w = dr.select(together, last_w, 0)
        for j in range(block):
            totals[j] = dr.fma(part, values[j], totals[j])
            value = weight * values[j]
            kept = dr.select(together, latest[j], 0)
            dds[j] = dr.fma(value, value - 2 * kept, dds[j])
            dxs[j] = dr.fma(value, weight - kept_w, dr.fma(-kept, weight, dxs[j]))
            latest[j] = value
        dw = dr.fma(weight, weight - 2 * kept_w, dw)
        weights = weights[0] + weight, dr.fma(weight, weight, weights[1])
        scale = dr.fma(part, part, scale)
        return (
            entry + 1,
            scale,
            weights,
            weight,
            pair,
            tuple(latest),
            tuple(dds),
            tuple(dxs),
            dw,
            tuple(totals),
        )

    nothing = dr.full(mi.UInt32, 0xFFFFFFFF, width)
    state = (begin, zero, (zero, zero), zero, nothing, colours, colours, colours, zero, colours)
    state = dr.while_loop(state, lambda entry, *_: entry < end, step)
    _, scale, (total, both), _, _, _, dd, dx, dw, means = state
    # Variance of the entries' sum with the halves' shares, and what the slope takes of the degrees of freedom.
    freedom = 1 - both * dr.square(dr.select(total > 0, dr.rcp(total), 0))
    scale *= dr.select(both > 0, dr.rcp(both), 0) / dr.maximum(freedom, 1 / LEAST_FREEDOM)
    spread = [
        scale * dr.maximum(dd[j] - 2 * means[j] * dx[j] + dr.square(means[j]) * dw, 0) for j in range(block)
    ]
    return list(means), spread
