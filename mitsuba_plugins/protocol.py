"""What the Dr.Jit port of a method provides: anything with these members satisfies it, no base class is needed.

:class:`Evaluator` is what the class of that name in a method's ``plugin`` module satisfies. The others are optional;
whoever needs one asks ``isinstance(x, Displaced)``, also of the class: see :mod:`btfref.representations.protocol`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from btfref.types import JitArray

if TYPE_CHECKING:
    from btfref.numerics.sphere.frames import Turn
    from btfref.representations.protocol import Representation
    from mitsuba_plugins.base import Maps


@runtime_checkable
class Evaluator(Protocol):
    """Evaluates a representation in Dr.Jit: made with the maps, ``Evaluator(maps)``."""

    def update(self, maps: Maps) -> None:
        """Take over changed maps, such as differentiable ones of an optimization."""

    def evaluate(
        self, uv: JitArray, w_light: JitArray, w_view: JitArray, active: JitArray, **known: Any
    ) -> JitArray:
        """B in 1/sr, cosine included, as the definition says in float64.

        Parameters
        ----------
        uv : Point2f
        w_light, w_view : Vector3f
            Unit vectors of the upper hemisphere, in the texture's frame.
        active : Bool
        **known
            ``lod``, ``step`` and ``ratio`` of a :class:`LevelledEvaluator`; ``hit`` of a :class:`Displaced` one;
            ``draw`` of a method that is :class:`btfref.representations.protocol.DrawsViews`. All may be missing; others
            are given none of them.

        Returns
        -------
        Color3f
        """


@runtime_checkable
class LevelledEvaluator(Evaluator, Protocol):
    """Blends levels of detail: ``evaluate`` takes ``lod``, ``step`` and ``ratio``.

    See :class:`mitsuba_plugins.lib.footprint.LevelOfDetail` for these.

    Attributes
    ----------
    max_lod : float
        Level of detail of the coarsest level, to which ``lod`` is clamped.
    """

    max_lod: float


@runtime_checkable
class Displaced(Evaluator, Protocol):
    """Finds its values on a geometry of its own: ``evaluate`` takes the ``hit``, where it is known."""

    def hit(self, uv: JitArray, w_view: JitArray, active: JitArray) -> tuple[Any, JitArray]:
        """Where a view ray meets the geometry.

        Returns
        -------
        hit
            For ``evaluate`` and ``proposal``.
        place : Point2f
            Its texture coordinates, where the guide of importance sampling is looked up.
        """


@runtime_checkable
class HoldsFixed(Evaluator, Protocol):
    """Has maps of floats that its values are not differentiated by, such as heights that rays are marched through.

    Attributes
    ----------
    fixed : tuple of str
        Their names. They are not offered by ``mi.traverse``.
    """

    fixed: tuple[str, ...]


class Proposal(Protocol):
    """Proposes light directions for one view."""

    def pdf(self, w_light: JitArray, active: JitArray) -> JitArray:
        """Density with respect to solid angle in 1/sr, Float; integrates to 1 over the upper hemisphere."""

    def sample(self, sample1: JitArray, sample2: JitArray) -> JitArray:
        """A direction of that density, Vector3f, from a Float and a Point2f that are uniform in [0, 1)."""


@runtime_checkable
class Proposes(Evaluator, Protocol):
    """Has lobes or microfacets of its own that propose light directions.

    Attributes
    ----------
    sampling : {"data", "lobes", "both"}
        What proposes directions unless the material says otherwise: tables of the data, :meth:`proposal`, or half of
        each. On the class; measured by ``btfref bench proposals``.
    """

    sampling: str

    def proposal(self, uv: JitArray, w_view: JitArray, active: JitArray, **known: Any) -> Proposal:
        """What the method proposes at a place for a view; ``known`` as for :meth:`Evaluator.evaluate`."""


@runtime_checkable
class ShowsMethod(Protocol):
    """A BSDF that evaluates a method by its port: what the plugin ``btf`` makes.

    Attributes
    ----------
    evaluator : Evaluator
    turn : Turn
        Of the local frame, by the transform of the texture.
    """

    evaluator: Evaluator
    turn: Turn

    def representation(self) -> Representation:
        """What it shows now; see :func:`mitsuba_plugins.representation_of`."""


def shown_by(bsdf: JitArray) -> list[ShowsMethod]:
    """Those of a BSDF and of the ones inside of it that are BTFs.

    BSDFs of Mitsuba, such as ``twosided``, tell the ones inside of them by their traversal, which hands out the Python
    objects that were put there.
    """
    import mitsuba as mi

    class Inner(mi.TraversalCallback):
        """Gathers the objects inside of one."""

        def put(self, name: str, value: JitArray, *flags: object) -> None:
            if isinstance(value, mi.BSDF):
                found.append(value)

    found = [bsdf]
    for one in found:
        if not isinstance(one, ShowsMethod):
            one.traverse(Inner())
    return [one for one in found if isinstance(one, ShowsMethod)]


def is_displaced(bsdf: JitArray) -> bool:
    """Whether a BSDF, or one inside of it, finds its values on a geometry of its own."""
    return any(isinstance(one.evaluator, Displaced) for one in shown_by(bsdf))
