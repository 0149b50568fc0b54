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
    points, _ = broadcast_points(uv, w_light, w_view, lod)
    names = {"uv": 2, "w_light": 3, "w_view": 3, "lod": 1}
    tables = gl.ShaderRepresentation.upload(gl.context(), rep, filter_type=filter_type)
    return _transformed(tables, "hosts/probe.vert", names, points)


def probe_environment(rep, light, uv, w_view, to_world, *, filter_type=None):
    """Radiance of ``rep`` under an environment, computed by its shader.

    Parameters
    ----------
    rep : Representation
    light : btfref.render.lighting.Prepared
        How the environment lights it.
    uv : array_like, shape (N, 2)
    w_view : array_like, shape (N, 3)
        Local frame.
    to_world : array_like, shape (N, 3, 3)
        Columns: the local axes in world space.
    filter_type : {"nearest", "bilinear"}, optional

    Returns
    -------
    ndarray of float32, shape (N, 3)

    Raises
    ------
    MissingDependencyError
        Without an OpenGL driver.
    """
    axes = np.swapaxes(np.asarray(to_world, np.float32), 1, 2).reshape(-1, 9)
    points = np.concatenate([np.asarray(uv, np.float32), np.asarray(w_view, np.float32), axes], 1)
    names = {"uv": 2, "w_view": 3, "axis_x": 3, "axis_y": 3, "axis_z": 3}
    tables = gl.ShaderRepresentation.upload(gl.context(), rep, filter_type=filter_type, light=light)
    return _transformed(tables, "hosts/probe_environment.vert", names, points)


def _transformed(tables, host, names, points):
    """``value`` of a vertex host for rows of attributes; the tables are released."""
    ctx = gl.context()
    if not len(points):
        tables.release()
        return np.zeros((0, 3), np.float32)
    # Without a bound framebuffer transform feedback on a surfaceless context returns zeros, without an error.
    target = ctx.simple_framebuffer((1, 1))
    target.use()
    program = tables.program(ctx, host, varyings=("value",))
    gl.bind(program, tables.textures)
    content, buffers, start = [], [], 0
    for name, width in names.items():
        if name in program:
            columns = np.ascontiguousarray(points[:, start : start + width])
            buffers.append(ctx.buffer(columns.tobytes()))
            content.append((buffers[-1], f"{width}f", name))
        start += width
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
