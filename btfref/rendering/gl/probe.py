"""Evaluation of a representation by its GLSL port, point by point: the agreement probe."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from btfref.rendering.gl import device
from btfref.types import JitArray

if TYPE_CHECKING:
    from btfref.rendering.environment_light.prepared import Prepared
    from btfref.representations.protocol import Representation


#: Numbers of a lookup without a draw.
LOOKUP = 9


def probe(
    rep: Representation,
    uv: ArrayLike,
    w_light: ArrayLike,
    w_view: ArrayLike,
    lod: ArrayLike = 0.0,
    *,
    filter_type: str | None = None,
    draw: ArrayLike | None = None,
) -> np.ndarray:
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
    draw : array_like, optional
        See :meth:`btfref.representations.protocol.DrawsViews.evaluate`.

    Returns
    -------
    ndarray of float32, shape (N, 3)
        B in 1/sr, cosine included; N is the size of the broadcast leading shapes.

    Raises
    ------
    MissingDependencyError
        Without an OpenGL driver.
    """
    points, _ = broadcast_points(uv, w_light, w_view, lod, *(() if draw is None else (draw,)))
    if not len(points):
        return np.zeros((0, 3), np.float32)
    with probe_points(rep, points, filter_type=filter_type) as made:
        made.run()
        return made.values()


def probe_malformed(
    rep: Representation, uv: ArrayLike, w_light: ArrayLike, w_view: ArrayLike
) -> dict[str, int]:
    """How many lookups the shader counts as malformed: what `btfref.conventions.malformed` counts in NumPy.

    Parameters
    ----------
    rep : Representation
    uv, w_light, w_view : array_like
        As for :func:`probe`.

    Returns
    -------
    dict of str to int
        ``directions``, ``coordinates``.

    Raises
    ------
    MissingDependencyError
        Without an OpenGL driver.
    """
    points, _ = broadcast_points(uv, w_light, w_view)
    found = np.zeros(2, int)
    if len(points):
        with probe_points(rep, points, result=("unusable", 2)) as made:
            made.run()
            found = made.values().sum(0).astype(int)
    return dict(zip(("directions", "coordinates"), found.tolist(), strict=True))


def probe_environment(
    rep: Representation,
    light: Prepared,
    uv: ArrayLike,
    w_view: ArrayLike,
    to_world: ArrayLike,
    *,
    filter_type: str | None = None,
) -> np.ndarray:
    """Radiance of ``rep`` under an environment, computed by its shader.

    Parameters
    ----------
    rep : Representation
    light : btfref.rendering.environment_light.prepared.Prepared
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
    tables = device.ShaderRepresentation.upload(device.context(), rep, filter_type=filter_type, light=light)
    if not len(points):
        tables.release()
        return np.zeros((0, 3), np.float32)
    with PointProbe(tables, "hosts/probe_environment.vert", names, points) as made:
        total = np.zeros((len(points), 3), np.float32)
        for values in light.passes:
            made.run(values)
            total = total + made.values()
        return total


class PointProbe:
    """A vertex host on the GPU, with points to evaluate: a result of each; a context manager.

    Parameters
    ----------
    tables : btfref.rendering.gl.device.ShaderRepresentation
        Owned from here on.
    host : str
        Vertex shader that writes the result.
    names : dict of str to int
        Attributes in the order of the points' columns, and how many columns each has.
    points : ndarray of float32, shape (N, sum of the columns)
        N at least 1.
    result : (str, int)
        Name of the result, and how many floats it has.
    """

    def __init__(
        self,
        tables: device.ShaderRepresentation,
        host: str,
        names: Mapping[str, int],
        points: np.ndarray,
        result: tuple[str, int] = ("value", 3),
    ) -> None:
        self.ctx = device.context()
        self._owned, self._n = [tables], len(points)
        # Without a bound framebuffer transform feedback on a surfaceless context returns zeros, without an error.
        self._target = self._own(self.ctx.simple_framebuffer((1, 1)))
        self._target.use()
        defines = {"DRAWN_VIEWS": 1} if "draw" in names else {}
        self._program = self._own(tables.program(self.ctx, host, varyings=result[:1], defines=defines))
        self._textures = tables.textures
        content, start = [], 0
        for name, width in names.items():
            if name in self._program:
                columns = np.ascontiguousarray(points[:, start : start + width])
                content.append((self._own(self.ctx.buffer(columns.tobytes())), f"{width}f", name))
            start += width
        self._vertices = self._own(self.ctx.vertex_array(self._program, content))
        self._result = self._own(self.ctx.buffer(reserve=4 * result[1] * self._n))
        self._width = result[1]

    def __enter__(self) -> PointProbe:
        return self

    def __exit__(self, *_: object) -> None:
        while self._owned:
            self._owned.pop().release()

    def _own(self, thing: JitArray) -> JitArray:
        self._owned.append(thing)
        return thing

    def run(self, uniforms: Mapping[str, Any] | None = None) -> None:
        """Evaluate all points, with uniforms by name, and wait."""
        self._target.use()
        device.bind(self._program, self._textures)
        device.set_uniforms(self._program, uniforms or {})
        self._vertices.transform(self._result, mode=self.ctx.POINTS, vertices=self._n)
        self.ctx.finish()

    def values(self) -> np.ndarray:
        """What the last run found, float32 (N, width of the result)."""
        return np.frombuffer(self._result.read(), np.float32).reshape(-1, self._width).copy()


def probe_points(
    rep: Representation,
    points: np.ndarray,
    *,
    filter_type: str | None = None,
    result: tuple[str, int] = ("value", 3),
) -> PointProbe:
    """A :class:`PointProbe` of ``rep`` at rows of :func:`broadcast_points`; the caller runs and releases it."""
    names = {"uv": 2, "w_light": 3, "w_view": 3, "lod": 1} | ({"draw": 1} if points.shape[1] > LOOKUP else {})
    tables = device.ShaderRepresentation.upload(device.context(), rep, filter_type=filter_type)
    return PointProbe(tables, "hosts/probe.vert", names, points, result)


def broadcast_points(
    uv: ArrayLike, w_light: ArrayLike, w_view: ArrayLike, lod: ArrayLike = 0.0, *draws: ArrayLike
) -> tuple[np.ndarray, tuple[int, ...]]:
    """The arguments of ``evaluate`` as rows (uv, w_light, w_view, lod, and the draw if there is one) of float32.

    Returns
    -------
    points : ndarray of float32, shape (N, 9), or (N, 10) with a draw
    shape : tuple of int
        The broadcast leading shape, with N items.
    """
    parts = [np.asarray(a, np.float32) for a in (uv, w_light, w_view)]
    parts += [np.asarray(a, np.float32)[..., None] for a in (lod, *draws)]
    shape = np.broadcast_shapes(*(part.shape[:-1] for part in parts))
    columns = [np.broadcast_to(part, (*shape, part.shape[-1])).reshape(-1, part.shape[-1]) for part in parts]
    return np.concatenate(columns, -1), shape
