"""Evaluation of a representation by its GLSL port, point by point: the agreement probe."""

from __future__ import annotations

import numpy as np

from btfref.render import gl


def probe(rep, uv, w_light, w_view, lod=0.0, *, filter_type=None):
    """Values of ``rep`` computed by its shader.

    Parameters
    ----------
    rep : Representation
    uv : array_like, shape (..., 2)
    w_light, w_view : array_like, shape (..., 3)
        Unit vectors in the local frame; rounded to float32.
    lod : array_like
        Level of detail.
    filter_type : {"nearest", "bilinear"}, optional
        Overrides the file's texel filter.

    Returns
    -------
    ndarray of float32, shape (N, 3)
        B in 1/sr, cosine included; N is the size of the broadcast leading shapes.

    Raises
    ------
    MissingDependencyError
        Without an OpenGL driver.
    """
    ctx = gl.context()
    points, _ = broadcast_points(uv, w_light, w_view, lod)
    if not len(points):
        return np.zeros((0, 3), np.float32)
    tables = gl.ShaderRepresentation.upload(ctx, rep, filter_type=filter_type)
    # Without a bound framebuffer transform feedback on a surfaceless context returns zeros, without an error.
    target = ctx.simple_framebuffer((1, 1))
    target.use()
    program = tables.program(ctx, "hosts/probe.vert", varyings=("value",))
    gl.bind(program, tables.textures)
    attributes = [("uv", "2f", 0), ("w_light", "3f", 2), ("w_view", "3f", 5), ("lod", "1f", 8)]
    content = []
    buffers = []
    for name, form, start in attributes:
        if name in program:
            columns = np.ascontiguousarray(points[:, start : start + int(form[0])])
            buffers.append(ctx.buffer(columns.tobytes()))
            content.append((buffers[-1], form, name))
    vertices = ctx.vertex_array(program, content)
    result = ctx.buffer(reserve=12 * len(points))
    vertices.transform(result, mode=ctx.POINTS, vertices=len(points))
    values = np.frombuffer(result.read(), np.float32).reshape(-1, 3).copy()
    for thing in (*buffers, vertices, result, program, target, tables):
        thing.release()
    return values


def broadcast_points(uv, w_light, w_view, lod=0.0):
    """The arguments of ``evaluate`` as rows (uv, w_light, w_view, lod) of float32.

    Returns
    -------
    points : ndarray of float32, shape (N, 9)
    shape : tuple of int
        The broadcast leading shape, with N items.
    """
    parts = [np.asarray(a, np.float32) for a in (uv, w_light, w_view)]
    parts.append(np.asarray(lod, np.float32)[..., None])
    shape = np.broadcast_shapes(*(part.shape[:-1] for part in parts))
    columns = [np.broadcast_to(part, (*shape, part.shape[-1])).reshape(-1, part.shape[-1]) for part in parts]
    return np.concatenate(columns, -1), shape
