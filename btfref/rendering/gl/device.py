"""OpenGL without a window: context, tables as textures, programs whose errors name files.

Nothing here knows a method: a representation comes as its port arrays and its GLSL file.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from btfref.errors import BtfrefError, InputError, MissingDependencyError
from btfref.rendering.gl import composer
from btfref.representations.lookup import packed_arrays
from btfref.scene.surfaces.materials import PlainMaterial
from btfref.types import JitArray, PathLike

if TYPE_CHECKING:
    from btfref.rendering.environment_light.prepared import Prepared
    from btfref.representations.protocol import Representation


#: Texels of a row of a table's texture; shaders/lib/lookup/table.glsl takes the index apart with the same number.
TABLE_WIDTH = 4096

#: moderngl's name of each type's texture; 8-bit codes are read as code / 255.
_DTYPES = {"float16": "f2", "float32": "f4", "uint32": "u4", "uint8": "f1"}


#: Without a window; apart, because moderngl declares the value of "backend" as a dictionary.
EGL: dict[str, Any] = {"backend": "egl"}


#: What draws in place of the process's own context.
_OTHER: ContextVar[JitArray] = ContextVar("other context", default=None)


@contextmanager
def drawing_with(other: JitArray) -> Iterator[None]:
    """Let another context draw inside a ``with``: one with the methods of moderngl's that are used here."""
    token = _OTHER.set(other)
    try:
        yield
    finally:
        _OTHER.reset(token)


def context() -> JitArray:
    """What draws: the process's OpenGL context (EGL, no window), or that of :func:`drawing_with`.

    Returns
    -------
    moderngl.Context

    Raises
    ------
    MissingDependencyError
        When no OpenGL 3.3 driver can be reached.
    """
    other = _OTHER.get()
    return _own_context() if other is None else other


@cache
def _own_context() -> JitArray:
    # Mesa's llvmpipe otherwise filters 8-bit textures on a path whose rounding differs between processors.
    os.environ.setdefault("GALLIVM_PERF", "no_aos_sampling")
    import moderngl

    try:
        return moderngl.create_context(standalone=True, require=330, **EGL)
    except Exception as error:  # moderngl and glcontext raise bare Exception
        raise MissingDependencyError(
            f"no OpenGL 3.3 context through EGL ({error})",
            "install libegl1 libgl1-mesa-dri libgles2, or a GPU driver with EGL",
        ) from error


def facts(ctx: JitArray) -> dict[str, str]:
    """Vendor, renderer and version of the driver, as a dict of str."""
    names = {"gl_vendor": "GL_VENDOR", "gl_renderer": "GL_RENDERER", "gl_version": "GL_VERSION"}
    return {key: ctx.info[name] for key, name in names.items()}


@dataclass(frozen=True)
class FoldedTable:
    """A table as the texels of a 2D array texture, without a context.

    Parameters
    ----------
    width, height, layers : int
        Texel i is at x = i mod 4096, y = (i div 4096) mod 4096, layer = i div 4096²; a short table is narrower.
    values : ndarray, shape (layers * height * width * 4,)
        RGBA, zeros beyond the table's end.
    """

    width: int
    height: int
    layers: int
    values: np.ndarray


def folded(array: np.ndarray, name: str) -> FoldedTable:
    """The texels of a table, in C order.

    Parameters
    ----------
    array : ndarray of float16, float32, uint32 or uint8 (normalized), shape (..., k)
        k is a multiple of 4.
    name : str
        For error messages.

    Returns
    -------
    FoldedTable

    Raises
    ------
    InputError
        For another type or shape, or more texels than shaders can count.
    """
    if array.dtype.name not in _DTYPES or array.shape[-1] % 4 or not array.size:
        raise InputError(
            "a table that GLSL cannot read",
            field=name,
            got=f"{array.dtype} {array.shape}",
            expected=f"{', '.join(_DTYPES)}, last axis a multiple of 4",
        )
    texels = array.size // 4
    if texels > np.iinfo(np.int32).max:
        raise InputError("a table is too large for a shader", field=name, got=f"{texels} RGBA texels")
    width = min(texels, TABLE_WIDTH)
    rows = -(-texels // width)
    layers = -(-rows // TABLE_WIDTH)
    height = min(rows, TABLE_WIDTH)
    flat = np.ascontiguousarray(array).reshape(-1)
    padded = layers * height * width * 4
    if padded != flat.size:
        flat = np.concatenate([flat, np.zeros(padded - flat.size, flat.dtype)])
    return FoldedTable(width, height, layers, flat)


def upload(ctx: JitArray, array: np.ndarray, name: str) -> JitArray:
    """A table as an array texture of RGBA texels in C order.

    Parameters
    ----------
    ctx : moderngl.Context
    array : ndarray of float16, float32, uint32 or uint8 (normalized), shape (..., k)
        k is a multiple of 4.
    name : str
        For error messages.

    Returns
    -------
    moderngl.TextureArray
        As :func:`folded` lays it out.

    Raises
    ------
    InputError
        For another type or shape, or a table larger than the driver's textures.
    """
    table = folded(array, name)
    limit = ctx.info["GL_MAX_ARRAY_TEXTURE_LAYERS"]
    if table.layers > limit:
        got = f"{table.layers} layers of {TABLE_WIDTH}² RGBA texels"
        raise InputError("a table is too large for this driver", field=name, got=got, expected=limit)
    size = (table.width, table.height, table.layers)
    texture = ctx.texture_array(size, 4, table.values.data, dtype=_DTYPES[array.dtype.name])
    # Unfiltered, without mipmaps: texelFetch of an incomplete texture would return zeros.
    texture.filter = (ctx.NEAREST, ctx.NEAREST)
    return texture


@dataclass
class ShaderRepresentation:
    """A representation on the GPU: its tables, its constants and its GLSL file.

    Parameters
    ----------
    textures : dict of str to moderngl.TextureArray
        By sampler name.
    defines : dict
        Constants for the composer.
    shader : str
        File with ``btf_eval``.
    directories : list of path-like
        Where to look for it before the library.
    texels : (int, int)
        Rows and columns of the finest level.
    environment : str or None
        File with ``btf_environment``.
    """

    textures: dict[str, JitArray]
    defines: dict[str, Any]
    shader: str
    directories: Sequence[PathLike]
    texels: tuple[int, int] = (1, 1)
    environment: str | None = None

    @classmethod
    def upload(
        cls,
        ctx: JitArray,
        rep: Representation,
        *,
        filter_type: str | None = None,
        light: Prepared | None = None,
    ) -> ShaderRepresentation:
        """Put ``rep`` on the GPU.

        Parameters
        ----------
        ctx : moderngl.Context
        rep : Representation
        filter_type : {"nearest", "bilinear"}, optional
            Overrides the file's texel filter.
        light : btfref.rendering.environment_light.prepared.Prepared, optional
            How an environment lights it: its tables come along.
        """
        arrays, defines = shader_tables(rep, filter_type=filter_type, light=light)
        shader, directories = shader_file(rep)
        textures = {name: upload(ctx, array, name) for name, array in arrays.items()}
        rows, columns = rep.meta.get("texels", (1, 1))
        return cls(textures, defines, shader, directories, (rows, columns), light.shader if light else None)

    def program(
        self,
        ctx: JitArray,
        vertex: str,
        fragment: str | None = None,
        *,
        varyings: Sequence[str] = (),
        defines: Mapping[str, object] | None = None,
    ) -> JitArray:
        """Compile hosts with this representation; see :func:`compile_program`."""
        return compile_program(
            ctx,
            vertex,
            fragment,
            varyings=varyings,
            defines={**self.defines, **(defines or {})},
            representation=self.shader,
            environment=self.environment,
            directories=self.directories,
        )

    def release(self) -> None:
        """Give the textures back."""
        for texture in self.textures.values():
            texture.release()


def shader_tables(
    rep: Representation, *, filter_type: str | None = None, light: Prepared | None = None
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """What a representation's shader reads: tables by sampler name, and constants; those of a light come along."""
    arrays, defines = rep.port_arrays(), shader_defines(rep, filter_type=filter_type)
    if light is not None:
        defines |= light_defines(light.tables, light.constants)
        arrays = {**arrays, **packed_arrays(light.tables)}
    return arrays, defines


def shader_defines(rep: Representation, *, filter_type: str | None = None) -> dict[str, Any]:
    """Constants of a representation's shader, the texel filter included; for the composer."""
    filter_type = filter_type or rep.meta["filter_type"]
    return {**composer.representation_defines(rep), "FILTER_BILINEAR": filter_type == "bilinear"}


def light_defines(
    tables: Mapping[str, np.ndarray], constants: Mapping[str, object] | None = None
) -> dict[str, Any]:
    """Constants of the shader that reads the tables of a way to light: their shapes and strides, and its own."""
    defines: dict[str, Any] = {"HAS_ENVIRONMENT": True, **(constants or {})}
    for name, table in tables.items():
        defines |= {f"{name}_DIM{axis}".upper(): n for axis, n in enumerate(table.shape)}
        defines[f"{name}_STRIDE".upper()] = -(-table.shape[-1] // 4)
    return defines


def shader_file(rep: Representation) -> tuple[str, list[Path]]:
    """The GLSL file of a representation's method and the directories to look for it."""
    from importlib.resources import files

    from btfref.registry import method

    if isinstance(rep, PlainMaterial):
        return rep.SHADER, []
    row = method(rep.meta["method"])
    return row.shader, [Path(str(files(row.shader_package)))] if row.shader_package else []


def compile_program(
    ctx: JitArray,
    vertex: str,
    fragment: str | None = None,
    *,
    varyings: Sequence[str] = (),
    **composition: Any,
) -> JitArray:
    """Compose, compile and link two hosts.

    Parameters
    ----------
    ctx : moderngl.Context
    vertex, fragment : str
        Host files.
    varyings : sequence of str
        Outputs for transform feedback.
    **composition
        For :func:`btfref.rendering.gl.composer.compose`.

    Returns
    -------
    moderngl.Program

    Raises
    ------
    BtfrefError
        With the compiler's message in terms of files and lines.
    """
    composition = {"target": getattr(ctx, "glsl", "330 core"), **composition}
    stages = {"vertex_shader": composer.compose(vertex, **composition)}
    if fragment:
        stages["fragment_shader"] = composer.compose(fragment, **composition)
    try:
        return ctx.program(**{name: str(source) for name, source in stages.items()}, varyings=varyings)
    except Exception as error:  # moderngl.Error, whose text holds the log of one stage
        source = stages["fragment_shader" if "fragment_shader" in str(error) else "vertex_shader"]
        raise BtfrefError(f"shader {vertex} {fragment or ''}: {source.explain(str(error))}") from error


def bind(program: JitArray, textures: Mapping[str, JitArray], *, first: int = 0) -> None:
    """Give every texture a unit and tell the samplers; samplers that the compiler dropped are skipped."""
    for unit, (name, texture) in enumerate(sorted(textures.items()), start=first):
        if name in program:
            texture.use(unit)
            program[name].value = unit


def set_uniforms(program: JitArray, values: Mapping[str, Any]) -> None:
    """Set uniforms by name; those that the compiler dropped are skipped."""
    for name, value in values.items():
        if name in program:
            array = np.ascontiguousarray(value)
            if array.dtype.kind == "f":
                program[name].write(array.astype(np.float32).tobytes())
            else:
                program[name].value = value
