"""The evaluators of a representation: one table that stress, validation, benchmarks and the tests share.

A new evaluator is a class below and a row of :data:`EVALUATORS`; nothing else lists them. Who wants only some of them
chooses by what the rows say.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from functools import partial
from types import ModuleType
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from btfref import conventions
from btfref.errors import InputError
from btfref.numerics.device_arrays import to_device
from btfref.precision import computing_in
from btfref.system import chromium

if TYPE_CHECKING:
    from btfref.rendering.web.probe import WebProbe
    from btfref.representations.protocol import Representation
    from btfref.types import JitArray, PathLike


class Evaluation(Protocol):
    """Lookups that are set up once and evaluated as often as wanted: what a benchmark times."""

    def run(self) -> None:
        """Evaluate all lookups, and wait for them."""

    def values(self) -> np.ndarray:
        """What the last run found: B in 1/sr, shape (n, 3)."""


class Evaluator(ABC):
    """A representation as one evaluator computes it.

    Parameters
    ----------
    representation : Representation
    path : path-like, optional
        Its file, for evaluators that load one.
    filter_type : {"nearest", "bilinear"}, optional
        In place of the representation's own texel filter.
    """

    def __init__(
        self,
        representation: Representation,
        path: PathLike | None = None,
        *,
        filter_type: str | None = None,
    ) -> None:
        self.representation, self.path, self.filter_type = representation, path, filter_type

    @abstractmethod
    def prepare(
        self, uv: np.ndarray, w_light: np.ndarray, w_view: np.ndarray, *, lod: ArrayLike | None = None
    ) -> AbstractContextManager[Evaluation]:
        """Set up lookups.

        Parameters
        ----------
        uv : ndarray, shape (n, 2)
        w_light, w_view : ndarray, shape (n, 3)
            Local frame; ports round to float32. n is at least 1.
        lod : array_like, optional
            Level of detail of all lookups or of each, shape (n,); default the finest.

        Returns
        -------
        context manager of Evaluation
        """

    @abstractmethod
    def malformed(self, uv: np.ndarray, w_light: np.ndarray, w_view: np.ndarray) -> dict[str, int]:
        """How many lookups ask for what is none, as :func:`btfref.conventions.malformed` counts them."""

    def evaluate(
        self, uv: np.ndarray, w_light: np.ndarray, w_view: np.ndarray, *, lod: ArrayLike | None = None
    ) -> np.ndarray:
        """Values of B in 1/sr, shape (n, 3), at the lookups of :meth:`prepare`."""
        with self.prepare(uv, w_light, w_view, lod=lod) as evaluation:
            evaluation.run()
            return evaluation.values()


class _Call:
    """An `Evaluation` that is a function call, and its own context manager."""

    def __init__(self, compute: Callable[[], JitArray], fetch: Callable[[JitArray], np.ndarray]) -> None:
        self._compute, self._fetch, self._found = compute, fetch, None

    def __enter__(self) -> _Call:
        return self

    def __exit__(self, *_: object) -> None:
        self._found = None

    def run(self) -> None:
        self._found = self._compute()

    def values(self) -> np.ndarray:
        return self._fetch(self._found)


class Definition(Evaluator):
    """NumPy: the definition in float64, or what it gives where all its numbers are float32."""

    def __init__(
        self,
        representation: Representation,
        path: PathLike | None = None,
        *,
        filter_type: str | None = None,
        dtype: DTypeLike = np.float64,
    ) -> None:
        if filter_type is not None:
            meta = {**representation.meta, "filter_type": filter_type}
            representation = type(representation).from_arrays(representation.arrays(), meta)
        super().__init__(representation, path, filter_type=filter_type)
        self._dtype = np.dtype(dtype)

    def prepare(
        self, uv: np.ndarray, w_light: np.ndarray, w_view: np.ndarray, *, lod: ArrayLike | None = None
    ) -> _Call:
        """Lookups, rounded to the precision; each run is one call of the definition."""
        points = [np.asarray(a, self._dtype) for a in (uv, w_light, w_view)]
        further = {} if lod is None else {"lod": lod}

        def compute() -> np.ndarray:
            with computing_in(self._dtype):
                return self.representation.evaluate(*points, **further)

        return _Call(compute, np.asarray)

    def malformed(self, uv: np.ndarray, w_light: np.ndarray, w_view: np.ndarray) -> dict[str, int]:
        """As NumPy counts them in that precision."""
        with computing_in(self._dtype):
            return conventions.malformed(uv, w_light, w_view)


class DrJit(Evaluator):
    """The plugin ``btf`` in Mitsuba, as the reference calls it.

    Parameters
    ----------
    representation, path, filter_type
        As of :class:`Evaluator`; the file is what is loaded.
    fast : bool
        Whether Dr.Jit may use approximate arithmetic (its flag ``FastMath``).
    **parameters
        Further ones of the plugin.
    """

    def __init__(
        self,
        representation: Representation,
        path: PathLike | None = None,
        *,
        filter_type: str | None = None,
        fast: bool = True,
        **parameters: object,
    ) -> None:
        super().__init__(representation, path, filter_type=filter_type)
        import mitsuba_plugins

        if path is None:
            raise InputError("the plugin loads a file, and none is given", field="path")
        if filter_type is not None:
            parameters["filter_type"] = filter_type
        self._mi, self._fast = mitsuba_plugins.ready(), fast
        # Nothing is sampled here: tables to sample by would take most of the time to load.
        self.plugin = mitsuba_plugins.load(path, **{"sampling": "cosine", **parameters})

    def prepare(
        self, uv: np.ndarray, w_light: np.ndarray, w_view: np.ndarray, *, lod: ArrayLike | None = None
    ) -> _Call:
        """Interactions on the device; each run evaluates the BSDF and waits."""
        import drjit as dr

        from mitsuba_plugins.protocol import LevelledEvaluator

        mi, context = self._mi, self._mi.BSDFContext()
        si = surface(mi, len(uv), np.asarray(uv).T, np.asarray(w_view).T)
        light = to_device(mi.Vector3f, np.asarray(w_light).T)
        # A level for each lookup is no parameter of the plugin: it goes to the plugin's evaluator directly.
        own_levels = lod is not None and isinstance(self.plugin.evaluator, LevelledEvaluator)
        levels = to_device(mi.Float, np.broadcast_to(np.asarray(lod), len(uv))) if own_levels else None
        dr.eval(si, light, levels)

        def compute() -> JitArray:
            with dr.scoped_set_flag(dr.JitFlag.FastMath, self._fast):
                value = (
                    self._at_levels(si, light, levels) if own_levels else self.plugin.eval(context, si, light)
                )
                dr.eval(value)
                dr.sync_thread()
            return value

        return _Call(compute, lambda value: np.array(value).T)

    def _at_levels(self, si: JitArray, light: JitArray, levels: JitArray) -> JitArray:
        import drjit as dr

        from mitsuba_plugins.lib.lookup import valid_directions

        valid = valid_directions(light) & valid_directions(si.wi)
        up = self._mi.Vector3f(0, 0, 1)
        light, view = dr.select(valid, light, up), dr.select(valid, si.wi, up)
        return dr.select(valid, self.plugin.evaluator.evaluate(si.uv, light, view, valid, lod=levels), 0)

    def malformed(self, uv: np.ndarray, w_light: np.ndarray, w_view: np.ndarray) -> dict[str, int]:
        """As the plugin counts them."""
        import drjit as dr

        from mitsuba_plugins.lib.lookup import malformed

        mi = self._mi
        at, light, view = (np.ascontiguousarray(np.asarray(a).T) for a in (uv, w_light, w_view))
        with dr.scoped_set_flag(dr.JitFlag.FastMath, self._fast):
            found = malformed(mi.Point2f(at), mi.Vector3f(light), mi.Vector3f(view))
            counts = [int(np.count_nonzero(np.array(mask))) for mask in found]
        return dict(zip(("directions", "coordinates"), counts, strict=True))


class Glsl(Evaluator):
    """The shaders in OpenGL, one vertex a lookup."""

    def prepare(
        self, uv: np.ndarray, w_light: np.ndarray, w_view: np.ndarray, *, lod: ArrayLike | None = None
    ) -> AbstractContextManager[Evaluation]:
        """Buffers and a program on the GPU; each run draws them."""
        from btfref.rendering.gl.probe import broadcast_points, probe_points

        rows, _ = broadcast_points(uv, w_light, w_view, 0.0 if lod is None else lod)
        return probe_points(self.representation, rows, filter_type=self.filter_type)

    def malformed(self, uv: np.ndarray, w_light: np.ndarray, w_view: np.ndarray) -> dict[str, int]:
        """As the shader counts them."""
        from btfref.rendering.gl.probe import probe_malformed

        return probe_malformed(self.representation, uv, w_light, w_view)


class WebGl(Evaluator):
    """The port package in Chromium's WebGL 2, one pixel a lookup."""

    def prepare(
        self, uv: np.ndarray, w_light: np.ndarray, w_view: np.ndarray, *, lod: ArrayLike | None = None
    ) -> WebProbe:
        """Textures and a program in the browser; each run draws them."""
        from btfref.rendering.gl.probe import broadcast_points
        from btfref.rendering.ports.package import port_package
        from btfref.rendering.web.probe import WebProbe

        rows, _ = broadcast_points(uv, w_light, w_view, 0.0 if lod is None else lod)
        return WebProbe(port_package(self.representation, filter_type=self.filter_type), rows)

    def malformed(self, uv: np.ndarray, w_light: np.ndarray, w_view: np.ndarray) -> dict[str, int]:
        """As the shader counts them."""
        if not len(uv):
            return {"directions": 0, "coordinates": 0}
        with self.prepare(uv, w_light, w_view) as evaluation:
            evaluation.run()
            return evaluation.malformed()


@dataclass(frozen=True)
class Row:
    """One evaluator of the table.

    Attributes
    ----------
    title : str
        For people.
    make : callable
        As :class:`Evaluator`: ``(representation, path, *, filter_type=None) -> Evaluator``.
    port : bool
        Whether a renderer runs it. The others show what precision and compiler make of the same code.
    compiles : bool
        Whether every material is compiled first, which takes seconds.
    needs : str or None
        What it needs beyond the package: "llvm", "gl", "chromium".
    there : callable
        Whether this machine has it; runs that choose no evaluators do without those that are not there, and say so.
    """

    title: str
    make: Callable[..., Evaluator]
    port: bool = False
    compiles: bool = False
    needs: str | None = None
    there: Callable[[], bool] = field(default=lambda: True)


#: What all others are measured against.
DEFINITION = "numpy"

#: All evaluators by name, the definition first.
EVALUATORS = {
    DEFINITION: Row("NumPy", Definition),
    "numpy float32": Row("NumPy in single precision", partial(Definition, dtype=np.float32)),
    "drjit": Row("Dr.Jit", DrJit, port=True, compiles=True, needs="llvm"),
    "drjit without FastMath": Row(
        "Dr.Jit without fast math", partial(DrJit, fast=False), compiles=True, needs="llvm"
    ),
    "glsl": Row("GLSL", Glsl, port=True, needs="gl"),
    # Nothing else asks a user for a browser.
    "webgl": Row("WebGL 2", WebGl, port=True, needs="chromium", there=lambda: chromium() is not None),
}


def present(names: Iterable[str]) -> tuple[str, ...]:
    """Those evaluators that this machine can run."""
    return tuple(name for name in names if EVALUATORS[name].there())


#: Those that are measured against the definition.
MEASURED = tuple(name for name in EVALUATORS if name != DEFINITION)

#: Those that renderers run.
PORTS = tuple(name for name, row in EVALUATORS.items() if row.port)


def evaluator(
    name: str, representation: Representation, path: PathLike | None = None, **parameters: object
) -> Evaluator:
    """An evaluator of a representation.

    Parameters
    ----------
    name : str
        Key of :data:`EVALUATORS`.
    representation : Representation
    path : path-like, optional
        Its file: Dr.Jit loads it.
    **parameters
        ``filter_type``, and what else that evaluator takes.

    Returns
    -------
    Evaluator

    Raises
    ------
    InputError
        Unknown name.
    MissingDependencyError
        Without LLVM, OpenGL or Chromium, here or when it is first used.
    """
    if name not in EVALUATORS:
        raise InputError(
            "unknown evaluator", field="--evaluator", got=repr(name), expected=", ".join(EVALUATORS)
        )
    return EVALUATORS[name].make(representation, path, **parameters)


def surface(mi: ModuleType, n: int, uv: ArrayLike, w_view: ArrayLike) -> JitArray:
    """Surface interactions in their own frame.

    Parameters
    ----------
    mi : module
        Mitsuba with a JIT variant.
    n : int
        How many.
    uv : array_like, shape (2,) or (2, n)
    w_view : array_like, shape (3,) or (3, n)

    Returns
    -------
    mitsuba.SurfaceInteraction3f
    """
    import drjit as dr

    def column(values: np.ndarray) -> JitArray:
        # A single place is data, not code: one kernel serves all.
        return dr.opaque(mi.Float, float(values)) if np.ndim(values) == 0 else to_device(mi.Float, values)

    si = dr.zeros(mi.SurfaceInteraction3f, n)
    si.uv = mi.Point2f(*map(column, np.asarray(uv)))
    si.wi = mi.Vector3f(*map(column, np.asarray(w_view)))
    return si
