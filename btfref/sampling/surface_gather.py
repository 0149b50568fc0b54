"""The gathering loop of the shared estimator: entries of each texel, lights, sums and their spread."""

from __future__ import annotations

import numpy as np

#: Lights that one lane serves.
LIGHTS_PER_LANE = 3


def gather_view(surface, lobes, table, lights, bins, w_view, *, radiance, place, per_texel, photons, texels):
    """Mean and variance of the mean of one view.

    Parameters
    ----------
    surface : Surface
    lobes : BroadLobes
    table : mitsuba.Float
        Per point and light: light by way of the broad lobe (3 numbers) and visibility.
    lights : mitsuba.Float
        Vectors, flat.
    bins : Bins
    w_view : ndarray (3,)
    radiance : mitsuba.Float
        Light by way of the rest, [view, sample, texel, light, 3].
    place : int
        This view's place in it.
    per_texel : int
        Samples in it; already divided by their number.
    photons : tuple of ndarray (texels · lights, 3), or None
        Sums and sums of squares.
    texels : tuple of int

    Returns
    -------
    mean, variance : ndarray (lights, texels, 3) float32

    Notes
    -----
    Variance of the ratio Σ w L / Σ w by successive differences along the curve on which the points are
    stratified (Wolter 2007, *Introduction to Variance Estimation*, sec. 8.2): neighbours share almost all
    that does not vary inside a stratum. Of one walk per texel no spread is known; differences to the four
    neighbouring texels stand for it. Photons are counted as a compound Poisson sum.
    """
    import drjit as dr
    import mitsuba as mi

    n_texels, n_lit = texels[0] * texels[1], dr.width(lights) // 3
    block = LIGHTS_PER_LANE
    n_blocks = -(-n_lit // block)
    # Everything that depends on the entry alone, once.
    point = mi.UInt32(bins.point)
    if len(bins.point) == 0:
        zero = np.zeros((n_lit, n_texels, 3), np.float32)
        return zero, zero.copy()
    w = mi.Vector3f(*(dr.opaque(mi.Float, float(x)) for x in w_view))
    number = dr.gather(mi.UInt32, surface.number, point)
    shading, s = (dr.gather(mi.Vector3f, a, point) for a in (surface.shading, surface.s))
    frame = mi.Frame3f(s, dr.cross(shading, s), mi.Normal3f(shading))
    wi = frame.to_local(w)
    uv = dr.gather(mi.Point2f, surface.uv, point)
    packets = dr.zeros(mi.Float, 16 * len(bins.point))
    lane = dr.arange(mi.UInt32, len(bins.point))
    values = (*s, uv.x, *shading, uv.y, *wi, lobes.shape(number, wi.z), mi.Float(bins.weight))
    for k, value in enumerate(values):
        dr.scatter(packets, value, lane * 16 + k)
    dr.scatter(packets, dr.reinterpret_array(mi.Float, number), lane * 16 + 13)
    dr.scatter(packets, dr.reinterpret_array(mi.Float, point), lane * 16 + 14)
    dr.eval(packets)

    lane = dr.arange(mi.UInt32, n_texels * n_blocks)
    texel, first = lane // n_blocks, (lane % n_blocks) * block
    start = mi.UInt32(bins.start)
    entry, end = dr.gather(mi.UInt32, start, texel), dr.gather(mi.UInt32, start, texel + 1)
    count = end - entry
    index = [dr.minimum(first + j, n_lit - 1) for j in range(block)]
    vectors = [dr.gather(mi.Vector3f, lights, i) for i in index]
    light_count = dr.opaque(mi.UInt32, n_lit)

    def step(entry, total, weights, last_w, last, dd, dx, dw, sums):
        e = [dr.gather(mi.Array4f, packets, entry * 4 + k) for k in range(4)]
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(lane))
        shading = mi.Vector3f(e[1].x, e[1].y, e[1].z)
        s = mi.Vector3f(e[0].x, e[0].y, e[0].z)
        si.sh_frame = mi.Frame3f(s, dr.cross(shading, s), mi.Normal3f(shading))
        si.n = si.sh_frame.n
        si.uv = mi.Point2f(e[0].w, e[1].w)
        si.wi = mi.Vector3f(e[2].x, e[2].y, e[2].z)
        weight, shape = e[3].x, e[2].w
        bsdf = dr.reinterpret_array(mi.BSDFPtr, dr.reinterpret_array(mi.UInt32, e[3].y))
        point = dr.reinterpret_array(mi.UInt32, e[3].z)
        step_w = weight - last_w
        sums, last, dd, dx = list(sums), list(last), list(dd), list(dx)
        begun = total > 0
        for j in range(block):
            row = dr.gather(mi.Array4f, table, dr.fma(point, light_count, index[j]))
            lit = row.w > 0
            value = bsdf.eval(lobes.full, si, si.to_local(vectors[j]), lit)
            value = weight * dr.fma(mi.Color3f(row.x, row.y, row.z), shape, dr.select(lit, value, 0))
            change = dr.select(begun, value - last[j], 0)
            dd[j] = dr.fma(change, change, dd[j])
            dx[j] = dr.fma(change, step_w, dx[j])
            last[j] = value
            sums[j] = sums[j] + value
        dw = dw + dr.select(begun, dr.square(step_w), 0)
        return (
            entry + 1,
            total + 1,
            weights + weight,
            weight,
            tuple(last),
            tuple(dd),
            tuple(dx),
            dw,
            tuple(sums),
        )

    zero = dr.zeros(mi.Float, dr.width(lane))
    colours = tuple(mi.Color3f(zero) for _ in range(block))
    state = (entry, zero + 0, zero + 0, zero + 0, colours, colours, colours, zero + 0, colours)
    state = dr.while_loop(state, lambda entry, *_: entry < end, step)
    _, _, weights, _, _, dd, dx, dw, sums = state
    inverse = dr.select(weights > 0, 1 / weights, 0)
    n = mi.Float(count)
    # n/(n−1) differences, each of twice the variance, of a sum of n.
    scale = dr.select(count > 1, n / (2 * (n - 1)), 0) * dr.square(inverse)
    means = [sums[j] * inverse for j in range(block)]
    spread = [
        dr.maximum(dd[j] - 2 * means[j] * dx[j] + dr.square(means[j]) * dw, 0) * scale for j in range(block)
    ]
    # Tin's ratio estimator (1965): the ratio's bias of order 1/n, from the same differences, is taken off.
    means = [means[j] + scale * (dx[j] - means[j] * dw) for j in range(block)]
    dr.eval(means, spread)

    mean, variance = (dr.zeros(mi.Float, n_lit * n_texels * 3) for _ in range(2))
    rows, columns = texels
    row, column = texel // columns, texel % columns
    neighbours = [
        row * columns + (column + 1) % columns,
        row * columns + (column + columns - 1) % columns,
        ((row + 1) % rows) * columns + column,
        ((row + rows - 1) % rows) * columns + column,
    ]
    base = dr.opaque(mi.UInt32, place * per_texel * n_texels)
    splats = None if photons is None else [mi.Float(part.ravel()) for part in photons]
    for j in range(block):
        inside = first + j < n_lit
        value, noise = means[j], spread[j]

        def walks(texel, j=j):
            total = mi.Color3f(0)
            for k in range(per_texel):
                at = (base + k * n_texels + texel) * n_lit + index[j]
                total += dr.gather(mi.Color3f, radiance, at)
            return total

        own = walks(texel)
        noise = noise + sum(dr.square(own - walks(other)) for other in neighbours) / 8
        value = value + own
        if splats is not None:
            at = texel * n_lit + index[j]
            value += dr.gather(mi.Color3f, splats[0], at)
            noise += dr.gather(mi.Color3f, splats[1], at)
        at = (index[j] * n_texels + texel) * 3
        for channel in range(3):
            dr.scatter(mean, value[channel], at + channel, inside)
            dr.scatter(variance, noise[channel], at + channel, inside)
    dr.eval(mean, variance)
    shape = (n_lit, n_texels, 3)
    return mean.numpy().reshape(shape), variance.numpy().reshape(shape)
