"""Evaluation of a representation by its port package in Chromium's WebGL 2, point by point."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from btfref.errors import BtfrefError
from btfref.rendering.ports.folder import webgl_script
from btfref.rendering.web import chromium
from btfref.types import Facts

if TYPE_CHECKING:
    from btfref.rendering.ports.package import PortPackage
    from btfref.rendering.web.chromium import Browser

#: What the name of the renderer must hold: any other one (a GPU, say) is not what the figures were measured on.
RENDERER = "SwiftShader"


class Device:
    """A WebGL 2 context of a page of its own; a context manager.

    Parameters
    ----------
    browser : btfref.rendering.web.chromium.Browser
    before : str
        JavaScript that runs first: what tests break is broken here.

    Raises
    ------
    BtfrefError
        Without WebGL 2, or with another renderer than :data:`RENDERER`.
    """

    def __init__(self, browser: Browser, before: str = "") -> None:
        self.page = browser.page()
        try:
            self.page.evaluate(before)
            self.page.evaluate(f"{webgl_script()}; globalThis.BtfPort = BtfPort; 0")
            self.page.evaluate("globalThis.gl = BtfPort.connect(new OffscreenCanvas(1, 1)); 0")
            self.renderer = str(self.page.evaluate("BtfPort.renderer(gl)"))
            if RENDERER not in self.renderer:
                raise BtfrefError(f"the browser draws with {self.renderer}, not with {RENDERER}")
        except BaseException:
            self.page.close()
            raise

    def __enter__(self) -> Device:
        return self

    def __exit__(self, *_: object) -> None:
        self.page.close()

    @property
    def facts(self) -> dict[str, str]:
        """Renderer and browser, as a dict of str."""
        return {"webgl_renderer": self.renderer, "browser": self.page.browser.version}


@cache
def _kept() -> list[Device]:
    return []


def device() -> Device:
    """The process's WebGL 2 context: a new one after an error, which may have cost the last one.

    Raises
    ------
    MissingDependencyError
        Without Chromium.
    BtfrefError
    """
    if not _kept():
        _kept().append(Device(chromium.shared()))
    return _kept()[0]


class WebProbe:
    """Lookups of a package in the browser; a context manager.

    Parameters
    ----------
    package : btfref.rendering.ports.package.PortPackage
    rows : ndarray of float32, shape (N, 9)
        As of :func:`btfref.rendering.gl.probe.broadcast_points`; N at least 1.
    where : Device, optional
        Default: the process's own.
    """

    def __init__(self, package: PortPackage, rows: np.ndarray, where: Device | None = None) -> None:
        self._own = where is None
        self._device = device() if where is None else where
        text = base64.b64encode(np.ascontiguousarray(rows, "<f4").tobytes()).decode("ascii")
        with self._alive():
            taken = [self._device.page.taken(texture.data) for texture in package.textures]
        self._do(
            f"globalThis.port = (() => {{ const bytes = [{', '.join(taken)}];"
            " return BtfPort.open(gl, {}, () => bytes.shift()); })(); 0",
            package.embedded(data=False),
        )
        self._do(
            "globalThis.lookups = BtfPort.prepare(gl, port, new Float32Array(BtfPort.decode({}).buffer)); 0",
            text,
        )

    def __enter__(self) -> WebProbe:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is None:
            self._do("BtfPort.release(lookups); BtfPort.close(gl, port); 0")

    def _do(self, expression: str, value: object = None) -> Facts:
        """The value of an expression; a pair of braces in it stands for a value."""
        page = self._device.page
        with self._alive():
            if value is not None:
                expression = expression.replace("{}", page.given(value), 1)
            return page.evaluate(expression)

    @contextmanager
    def _alive(self) -> Iterator[None]:
        """After an error the process's own device is another one."""
        try:
            yield
        except BtfrefError:
            if self._own:
                _kept().clear()
                self._device.page.close()
            raise

    def run(self) -> None:
        """Evaluate all lookups, and wait."""
        self._do("BtfPort.run(lookups); 0")

    def _read(self) -> Facts:
        return self._do(
            "(() => { const found = BtfPort.read(lookups);"
            " return { values: BtfPort.encode(found.values), malformed: found.malformed }; })()"
        )

    def values(self) -> np.ndarray:
        """What the last run found, float32 (N, 3).

        Raises
        ------
        BtfrefError
            For a lost device or a blank frame.
        """
        return np.frombuffer(base64.b64decode(self._read()["values"]), "<f4").reshape(-1, 3).copy()

    def malformed(self) -> dict[str, int]:
        """How many lookups the shader called malformed in the last run, by kind."""
        return dict(zip(("directions", "coordinates"), self._read()["malformed"], strict=True))
