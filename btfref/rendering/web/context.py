"""WebGL 2 in place of a moderngl context: what :mod:`btfref.rendering.gl` asks of one, as commands for a page.

The renderer itself is the same code, and its shaders are the same files, composed as GLSL ES 3.00. Commands are sent
together when something is to be read.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import numpy as np

from btfref.errors import BtfrefError
from btfref.rendering.gl import device
from btfref.rendering.gl.realtime import realtime
from btfref.rendering.web import chromium
from btfref.rendering.web.probe import Device

if TYPE_CHECKING:
    from btfref.rendering import RenderResult
    from btfref.types import SceneLike

#: Float targets, and adding to them.
EXTENSIONS = ("EXT_color_buffer_float", "EXT_float_blend")


class WebContext:
    """A WebGL 2 context with the methods and attributes of moderngl's that the renderer uses.

    Parameters
    ----------
    where : btfref.rendering.web.probe.Device

    Raises
    ------
    BtfrefError
        For a missing extension.
    """

    #: Dialect of its shaders: see :func:`btfref.rendering.gl.device.compile_program`.
    glsl = "300 es"
    BLEND, CULL_FACE, DEPTH_TEST = 1, 2, 4
    NEAREST, ONE, TRIANGLES, POINTS = "NEAREST", "ONE", "TRIANGLES", "POINTS"

    def __init__(self, where: Device) -> None:
        self._page, self._last = where.page, 0
        self._commands: list[list[Any]] = []
        names = json.dumps(EXTENSIONS)
        self._page.evaluate(f"globalThis.gl = BtfPort.connect(new OffscreenCanvas(1, 1), {names}); 0")
        text = files(__package__).joinpath("webgl.js").read_text("utf-8")
        self._page.evaluate(
            f"{text}; globalThis.given = new Map(); globalThis.run = BtfGl.renderer(gl, given); 0"
        )
        asked = (
            "['MAX_RENDERBUFFER_SIZE', 'MAX_ARRAY_TEXTURE_LAYERS', 'MAX_TEXTURE_SIZE', 'VENDOR', 'VERSION']"
        )
        found = self._page.evaluate(
            f"Object.fromEntries({asked}.map((n) => ['GL_' + n, gl.getParameter(gl[n])]))"
        )
        self.info: dict[str, Any] = {**found, "GL_RENDERER": where.renderer}

    def add(self, name: str, *arguments: object) -> None:
        """A command for later."""
        self._commands.append([name, *arguments])

    def ask(self, name: str, *arguments: object) -> Any:
        """All commands so far, then one whose answer is wanted."""
        self.add(name, *arguments)
        commands, self._commands = self._commands, []
        return self._page.evaluate(f"run({self._page.given(commands)})")

    def give(self, number: int, data: memoryview | bytes) -> None:
        """The data of a thing to come."""
        self._page.evaluate(f"given.set({number}, {self._page.taken(data)}); 0")

    def number(self) -> int:
        """A name for a new object."""
        self._last += 1
        return self._last

    def texture(self, size: tuple[int, int], components: int, dtype: str = "f4") -> _Texture:
        """A texture to draw to."""
        return _Texture(self, "TEXTURE_2D", size, components, dtype, None)

    def texture_array(
        self, size: tuple[int, int, int], components: int, data: memoryview | bytes, *, dtype: str
    ) -> _Texture:
        """A table."""
        return _Texture(self, "TEXTURE_2D_ARRAY", size, components, dtype, data)

    def depth_renderbuffer(self, size: tuple[int, int]) -> _Thing:
        """Depths of 24 bits."""
        made = _Thing(self)
        self.add("depth", made.id, list(size))
        return made

    def framebuffer(self, colours: Sequence[_Texture], depth: _Thing) -> _Framebuffer:
        """A target of one texture."""
        return _Framebuffer(self, colours[0], depth)

    def program(self, *, vertex_shader: str, fragment_shader: str, varyings: Sequence[str] = ()) -> _Program:
        """A program; errors say "fragment_shader" where its text is at fault, as moderngl's do."""
        return _Program(self, vertex_shader, fragment_shader)

    def vertex_array(self, program: _Program, content: Sequence[object]) -> _Vertices:
        """Vertices without attributes."""
        return _Vertices(self, program)

    def query(self, *, time: bool) -> _Query:
        """A timer that knows nothing: that of the browser is coarse."""
        return _Query()

    def enable(self, flags: int) -> None:
        """States to be on."""
        self.add("state", _states(flags), True)

    def disable(self, flags: int) -> None:
        """States to be off."""
        self.add("state", _states(flags), False)

    def finish(self) -> None:
        """Nothing: whoever reads waits."""

    def __setattr__(self, name: str, value: object) -> None:
        if name == "depth_func":
            self.add("depth_func", value)
        elif name == "blend_func":
            self.add("add")
        else:
            object.__setattr__(self, name, value)


def _states(flags: int) -> list[str]:
    return [name for name in ("BLEND", "CULL_FACE", "DEPTH_TEST") if flags & getattr(WebContext, name)]


class _Thing:
    """Something on the device."""

    def __init__(self, context: WebContext) -> None:
        self.context, self.id = context, context.number()

    def release(self) -> None:
        self.context.add("release", self.id)


class _Texture(_Thing):
    def __init__(
        self,
        context: WebContext,
        target: str,
        size: Sequence[int],
        components: int,
        dtype: str,
        data: memoryview | bytes | None,
    ) -> None:
        super().__init__(context)
        self.size, self.filter = tuple(size), ("NEAREST", "NEAREST")
        if data is not None:
            context.give(self.id, data)
        context.add("texture", self.id, target, list(size), components, dtype, data is not None)

    def use(self, unit: int) -> None:
        self.context.add("bind", self.id, unit)


class _Framebuffer(_Thing):
    def __init__(self, context: WebContext, colour: _Texture, depth: _Thing) -> None:
        super().__init__(context)
        self._size = colour.size
        self._viewport = (0, 0, *colour.size)
        context.add("framebuffer", self.id, colour.id, depth.id)

    def use(self) -> None:
        self.context.add("use", self.id, list(self._viewport))

    @property
    def viewport(self) -> tuple[int, ...]:
        return self._viewport

    @viewport.setter
    def viewport(self, value: Sequence[int]) -> None:
        self._viewport = tuple(int(n) for n in value)
        self.use()

    def __setattr__(self, name: str, value: object) -> None:
        if name == "depth_mask":
            self.context.add("depth_mask", value)
        else:
            object.__setattr__(self, name, value)

    def clear(self, *colour: float) -> None:
        self.use()
        self.context.add("clear", list(colour))

    def read(self, *, components: int, dtype: str) -> bytes:
        width, height = self._size
        text = self.context.ask("read", self.id, width, height)
        pixels = np.frombuffer(base64.b64decode(text), "<f4").reshape(-1, 4)
        if (pixels[:, 3] == -1).all():  # as it was cleared
            raise BtfrefError("the browser drew a blank frame: no pixel sees a surface")
        return np.ascontiguousarray(pixels[:, :components]).tobytes()


class _Program(_Thing):
    def __init__(self, context: WebContext, vertex: str, fragment: str) -> None:
        super().__init__(context)
        self._uniforms = {
            name: _Uniform(context, self.id, name)
            for name in context.ask("program", self.id, str(vertex), str(fragment))
        }

    def __contains__(self, name: str) -> bool:
        return name in self._uniforms

    def __getitem__(self, name: str) -> _Uniform:
        return self._uniforms[name]


class _Uniform:
    def __init__(self, context: WebContext, program: int, name: str) -> None:
        self._context, self._program, self._name = context, program, name

    def _set(self, values: np.ndarray) -> None:
        self._context.add("uniform", self._program, self._name, values.ravel().tolist())

    def write(self, data: bytes) -> None:
        self._set(np.frombuffer(data, np.float32))

    @property
    def value(self) -> object:
        raise AttributeError("values of uniforms are not read back")

    @value.setter
    def value(self, value: object) -> None:
        self._set(np.asarray(value).astype(int))


class _Vertices(_Thing):
    def __init__(self, context: WebContext, program: _Program) -> None:
        super().__init__(context)
        self._program = program

    def render(self, mode: str, *, vertices: int, first: int = 0) -> None:
        self.context.add("draw", self._program.id, int(first), int(vertices))

    def release(self) -> None:
        """Nothing on the device."""


class _Query:
    elapsed = 0

    def __enter__(self) -> _Query:
        return self

    def __exit__(self, *_: object) -> None:
        return None


@contextmanager
def drawing(where: Device | None = None) -> Iterator[WebContext]:
    """Let everything of :mod:`btfref.rendering.gl` draw in the browser, in this thread, inside a ``with``.

    Parameters
    ----------
    where : btfref.rendering.web.probe.Device, optional
        Default: a new page of the process's browser.
    """
    own = Device(chromium.shared()) if where is None else where
    try:
        made = WebContext(own)
        with device.drawing_with(made):
            yield made
    finally:
        if where is None:
            own.page.close()


def webgl(
    scene: SceneLike, *, parameters: Mapping[str, object] | None = None, **settings: Any
) -> RenderResult:
    """Render a scene with WebGL 2 in a headless Chromium: the real-time picture of another driver.

    Parameters
    ----------
    scene, parameters, **settings
        As of :func:`btfref.rendering.gl.realtime.realtime`.

    Returns
    -------
    RenderResult
        Floats that were read back; ``meta`` as there, without frame times of a GPU.

    Raises
    ------
    BtfrefError
        For a lost device, a blank frame, a missing extension or another renderer than SwiftShader.
    MissingDependencyError
        Without Chromium.
    """
    with drawing():
        result = realtime(scene, parameters=parameters, **settings)
    result.meta["renderer"] = "webgl"
    return result
