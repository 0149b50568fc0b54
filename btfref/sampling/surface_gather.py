"""The gathering loop of the shared estimator: entries of each texel, lights, sums and their spread.

A texel's mean is made of two independent halves. With Y_h = Σ w L over a half's entries, W_h = Σ w whose
expectation is exactly 1, and R_h = Y_h / W_h, half h is corrected by what the other one says of the slope:
``Y_h − R_(1−h) (W_h − 1)``. No half's slope depends on its own points, so the mean is free of bias, and it is
about as quiet as the ratio Σ w L / Σ w. It equals ``½ [R_0 (1 + W_0 − W_1) + R_1 (1 + W_1 − W_0)]``.
"""

from __future__ import annotations

import numpy as np

from btfref.numerics.transfer import in_one_kernel, to_device
from btfref.sampling.surface_points import starts

#: Lights that one lane serves.
LIGHTS_PER_LANE = 3

#: Bound of the correction n / (n − 1) of the variance for n entries, n counted by weight.
LEAST_FREEDOM = 4


def gather(scene, surface, table, rows, bins, *, radiance, splats, texels):
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
    splats : tuple of mitsuba.Float, or None
        Sums and sums of squares of photons, [view, light, texel, 3].
    texels : tuple of int

    Returns
    -------
    mean, variance : ndarray (views, lights, texels, 3) float32

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
    points, spread = _points(scene, surface, table, rows, bins, n_texels)
    n_blocks = -(-n_lit // LIGHTS_PER_LANE)
    halves = np.stack([some.totals() for some in bins])  # view, half, texel
    lean = 0.5 * (halves[:, 0] - halves[:, 1])
    share = to_device(mi.Float, 0.5 + lean)

    lane = dr.arange(mi.UInt32, len(rows) * n_texels * n_blocks)
    cell, first = lane // n_blocks, (lane % n_blocks) * LIGHTS_PER_LANE
    view, texel = cell // n_texels, cell % n_texels
    mean, variance = (dr.zeros(mi.Float, int(np.prod(shape))) for _ in range(2))
    mine = dr.gather(mi.Float, share, cell)
    if radiance is not None:
        pooled = _pooled(radiance, len(rows), texels, n_lit)
        block = (texel // texels[1] // 2) * ((texels[1] + 1) // 2) + texel % texels[1] // 2
        block += view * (((texels[0] + 1) // 2) * ((texels[1] + 1) // 2))

    def write():
        for j in range(LIGHTS_PER_LANE):
            light = first + j
            inside = light < n_lit
            value, noise = points[j], spread[j]
            if radiance is not None:
                at = (2 * view * n_texels + texel) * n_lit + light
                one = dr.gather(mi.Color3f, radiance, at, inside)
                other = dr.gather(mi.Color3f, radiance, at + n_texels * n_lit, inside)
                value += mine * one + (1 - mine) * other
                # The halves' shares are mine and 1 − mine, the pooled number is for ½ and ½.
                scale = 2 * (dr.square(mine) + dr.square(1 - mine))
                noise += scale * dr.gather(mi.Color3f, pooled, block * n_lit + light, inside)
            if splats is not None:
                at = (view * n_lit + light) * n_texels + texel
                value += dr.gather(mi.Color3f, splats[0], at, inside)
                noise += dr.gather(mi.Color3f, splats[1], at, inside)
            at = ((view * n_lit + light) * n_texels + texel) * 3
            for channel in range(3):
                dr.scatter(mean, value[channel], at + channel, inside)
                dr.scatter(variance, noise[channel], at + channel, inside)

    in_one_kernel(dr.width(lane), write)
    dr.eval(mean, variance)
    return mean.numpy().reshape(shape), variance.numpy().reshape(shape)


def _pooled(radiance, n_views, texels, n_lit):
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

    def write():
        for channel in range(3):
            dr.scatter(result, total[channel] / 16, 3 * lane + channel)

    in_one_kernel(dr.width(lane), write)
    dr.eval(result)
    return result


def _packets(scene, surface, rows, bins):
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
    weight, half = (np.concatenate([getattr(some, name) for some in bins]) for name in ("weight", "half"))
    lane = dr.arange(mi.UInt32, len(weight))
    packets = dr.zeros(mi.Float, 16 * len(weight))
    numbers, records = (mi.Float(dr.reinterpret_array(mi.Float, a)) for a in (number, record))
    values = (
        *s, uv.x, *shading, uv.y, *wi, scene.lobes.shape(number, wi.z),
        to_device(mi.Float, weight), numbers, records, to_device(mi.Float, half),
    )  # fmt: skip

    def write():
        for k, value in enumerate(values):
            dr.scatter(packets, value, lane * 16 + k)

    in_one_kernel(len(weight), write)
    dr.eval(packets)
    return packets


def _points(scene, surface, table, rows, bins, n_texels):
    """Mean and its variance from the entries: per light of a lane's block one colour each."""
    import drjit as dr
    import mitsuba as mi

    lights, lobes, block = scene.lights, scene.lobes, LIGHTS_PER_LANE
    n_lit = lights.count
    n_blocks = -(-n_lit // block)
    lane = dr.arange(mi.UInt32, len(rows) * n_texels * n_blocks)
    cell, first = lane // n_blocks, (lane % n_blocks) * block
    start = starts(bins)
    n_entries, start = int(start[-1]), to_device(mi.UInt32, start)
    begin, end = dr.gather(mi.UInt32, start, cell), dr.gather(mi.UInt32, start, cell + 1)
    zero = dr.zeros(mi.Float, dr.width(lane))
    if n_entries == 0:
        return [[mi.Color3f(zero) for _ in range(block)] for _ in range(2)]
    packets = _packets(scene, surface, rows, bins)
    index = [dr.minimum(first + j, n_lit - 1) for j in range(block)]
    vectors = [dr.gather(mi.Vector3f, lights.vectors, i) for i in index]
    light_count = dr.opaque(mi.UInt32, n_lit)

    def step(entry, weights, squares, last_w, last_pair, last, dd, dx, dw, sums):
        e = [dr.gather(mi.Array4f, packets, entry * 4 + k) for k in range(4)]
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(lane))
        shading, s = mi.Vector3f(e[1].x, e[1].y, e[1].z), mi.Vector3f(e[0].x, e[0].y, e[0].z)
        si.sh_frame = mi.Frame3f(s, dr.cross(shading, s), mi.Normal3f(shading))
        si.n = si.sh_frame.n
        si.uv = mi.Point2f(e[0].w, e[1].w)
        si.wi = mi.Vector3f(e[2].x, e[2].y, e[2].z)
        weight, shape, odd = e[3].x, e[2].w, e[3].w > 0
        bsdf = dr.reinterpret_array(mi.BSDFPtr, dr.reinterpret_array(mi.UInt32, e[3].y))
        record = dr.reinterpret_array(mi.UInt32, e[3].z)
        # The partner of the same stratum comes just before; alone in the texel, an entry differs from 0.
        pair = record >> 1
        together = pair == last_pair
        row = [dr.gather(mi.Array4f, table, dr.fma(record, light_count, i)) for i in index]
        lit = [one.w != 0 for one in row]
        last, dd, dx, sums = list(last), list(dd), list(dx), list(sums)
        kept_w = dr.select(together, last_w, 0)
        for j in range(block):
            broad = mi.Color3f(row[j].x, row[j].y, row[j].z)
            direct = bsdf.eval(lobes.full, si, si.to_local(vectors[j]), lit[j])
            value = weight * dr.fma(broad, shape, dr.select(lit[j], direct * row[j].w, 0))
            kept = dr.select(together, last[j], 0)
            dd[j] = dr.fma(value, value - 2 * kept, dd[j])
            dx[j] = dr.fma(value, weight - kept_w, dr.fma(-kept, weight, dx[j]))
            last[j] = value
            sums[j] = sums[j] + dr.select(odd, 0, value)
            sums[block + j] = sums[block + j] + dr.select(odd, value, 0)
        dw = dr.fma(weight, weight - 2 * kept_w, dw)
        split = (dr.select(odd, 0, weight), dr.select(odd, weight, 0))
        weights = tuple(a + b for a, b in zip(weights, split, strict=True))
        squares = tuple(dr.fma(b, b, a) for a, b in zip(squares, split, strict=True))
        return entry + 1, weights, squares, weight, pair, tuple(last), tuple(dd), tuple(dx), dw, tuple(sums)

    colours = tuple(mi.Color3f(zero) for _ in range(block))
    nothing = dr.full(mi.UInt32, 0xFFFFFFFF, dr.width(lane))
    state = (
        begin, (zero, zero), (zero, zero), zero, nothing, colours, colours, colours, zero, (*colours, *colours)
    )  # fmt: skip
    state = dr.while_loop(state, lambda entry, *_: entry < end, step)
    _, (one, two), squares, _, _, _, dd, dx, dw, sums = state
    inverse = dr.select(one + two > 0, dr.rcp(one + two), 0)
    shares = [dr.select(a > 0, (0.5 + 0.5 * (a - b)) / a, 0) for a, b in ((one, two), (two, one))]
    # Variance of the entries' sum with the halves' shares, and what the slope takes of the degrees of freedom.
    both = squares[0] + squares[1]
    scale = dr.fma(squares[0], dr.square(shares[0]), squares[1] * dr.square(shares[1]))
    scale *= dr.select(both > 0, dr.rcp(both), 0) / dr.maximum(
        1 - both * dr.square(inverse), 1 / LEAST_FREEDOM
    )
    means = [shares[0] * sums[j] + shares[1] * sums[block + j] for j in range(block)]
    slopes = [(sums[j] + sums[block + j]) * inverse for j in range(block)]
    spread = [
        scale * dr.maximum(dd[j] - 2 * slopes[j] * dx[j] + dr.square(slopes[j]) * dw, 0) for j in range(block)
    ]
    return means, spread
