"""What a method provides. Anything with these members satisfies it; there is no class to derive from.

:class:`Representation` and :class:`FitModule` are what every method has. The other protocols are optional, one for each
thing that a method may do beside; whoever needs it asks ``isinstance(x, HasLevels)`` and never for a name in text.

Some are asked before there is an instance, of the class: what to read of a file, whether a method can be lit in some
way. A class object satisfies a protocol as an instance does (PEP 544, "Type objects and modules as implementations"),
so that is the same ``isinstance``. ``issubclass`` is of no use here: it refuses protocols with data. What is said of a
class therefore stands on the class, as a class attribute, a property or a method. Likewise a module satisfies
:class:`FitsPartially`.

What Dr.Jit ports provide stands in :mod:`mitsuba_plugins.protocol`.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Protocol, runtime_checkable

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import ArrayLike

    from btfref.representations.file.schema import Schema
    from btfref.sampling.store.store import BTFStore
    from btfref.types import Facts, Progress

#: Kinds of directions.
Kind = Literal["view", "light"]


@runtime_checkable
class Representation(Protocol):
    """A compressed BTF: maps, a definition in float64, and what the ports read."""

    @property
    def meta(self) -> Facts:
        """JSON-able facts.

        ``method``: key; ``filter_type``: "nearest" or "bilinear"; ``texels``: (rows, columns); ``views``, ``lights``:
        {"name", "count"}; ``parameters``: of the fit; ``parent``: attributes of the sampled BTF; ``versions``;
        ``constants``: scalars that become GLSL defines.
        """

    def evaluate(
        self, uv: ArrayLike, w_light: ArrayLike, w_view: ArrayLike, *, lod: ArrayLike = 0.0
    ) -> np.ndarray:
        """Value B in 1/sr, cosine included.

        Parameters
        ----------
        uv : array_like, shape (..., 2)
        w_light, w_view : array_like, shape (..., 3)
            Unit vectors in the local frame; the leading shapes broadcast.
        lod : array_like
            Level of detail, 0 = finest, a step for each halving of the resolution; methods without levels ignore it,
            those with levels also take one value a lookup.

        Returns
        -------
        ndarray of float64, shape (..., 3)
            Linear Rec. 709. Exactly 0 where a direction is below the horizon or not finite. Lossy methods may
            return small negative values; hosts count them and never clamp in silence.
        """

    def arrays(self) -> dict[str, np.ndarray]:
        """All maps, float16, float32, uint32 or uint8 (value code / 255), last axis = channels.

        Their names are the parts of the file.
        """

    def port_arrays(self) -> dict[str, np.ndarray]:
        """The maps as the ports read them: last axis a multiple of 4, what one lookup needs contiguous.

        Their names are those of samplers and of Mitsuba's parameters; several maps may become one.
        """

    def sampling_tables(self) -> tuple[np.ndarray, np.ndarray]:
        """Guide of importance sampling.

        Returns
        -------
        group : ndarray of uint32, shape (rows, columns)
            Group of each texel.
        mean : ndarray of float, shape (n_groups, n_views, n_lights)
            Mean luminance of B of the group's texels.
        """

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray], meta: Facts) -> Representation:
        """The representation whose :meth:`arrays` and ``meta`` these are."""


@runtime_checkable
class HasSchema(Protocol):
    """It says what maps and constants its files hold, so that they are checked before a port reads them.

    Asked of the class: a class method. Of a method without it only what all methods share is checked.
    """

    def schema(self, meta: Facts, names: Collection[str]) -> Schema:
        """The maps and constants of a file.

        Parameters
        ----------
        meta : dict
            Of the file; what :class:`Representation` lists was checked, all else is as it was found.
        names : collection of str
            The maps that there are.

        Raises
        ------
        InputError
            For entries of ``meta`` that are not what the method writes; without the file's name.
        """


@runtime_checkable
class KeepsDirections(Protocol):
    """Its maps have axes over views or lights, so that those of some directions can be read and kept alone."""

    @property
    def DIRECTION_AXES(self) -> Mapping[Kind, Mapping[str, int]]:  # noqa: N802 - a class attribute
        """For "view", "light" or both: names of maps (``*`` is any text), and their axis over these directions."""


@dataclass(frozen=True)
class Entries:
    """How texels name entries of codebooks.

    Attributes
    ----------
    index : str
        Map of names, uint32 [row, column, 1].
    axes : dict of str to int
        Maps, and their axis that runs over the entries.
    mark : str
        Map [row, column, …] of floats that every lookup of a texel reads.
    """

    index: str
    axes: Mapping[str, int]
    mark: str


@runtime_checkable
class DrawsViews(Protocol):
    """It interpolates tables over views, of which one can be drawn instead: so can its ports.

    In Dr.Jit ``evaluate`` and ``proposal`` then take ``draw`` too, and in GLSL views come from ``view_stencil``.
    """

    @property
    def DRAWS_VIEWS(self) -> bool:  # noqa: N802 - a class attribute
        """True."""

    def evaluate(
        self,
        uv: ArrayLike,
        w_light: ArrayLike,
        w_view: ArrayLike,
        *,
        lod: ArrayLike = 0.0,
        draw: ArrayLike | None = None,
    ) -> np.ndarray:
        """As :meth:`Representation.evaluate`, with one measured view instead of all neighbours.

        Parameters
        ----------
        uv, w_light, w_view, lod : array_like
        draw : array_like, shape (...), optional
            In [0, 1): the view is drawn by it with the interpolation's weights, as
            :func:`btfref.numerics.draws.chosen` says. The mean over uniform draws is the value without.

        Returns
        -------
        ndarray of float64, shape (..., 3)
        """


@runtime_checkable
class HasEntries(Protocol):
    """Its texels name entries of codebooks (clusters, materials), so that some can be read and kept alone."""

    @property
    def ENTRIES(self) -> Entries:  # noqa: N802 - a class attribute
        """Which map holds the names, and which maps the entries."""


@runtime_checkable
class HasExponents(Protocol):
    """Some channels of its maps are exponents of lobes: refinement moves them relative to their size."""

    @property
    def EXPONENTS(self) -> Mapping[str, tuple[int, int]]:  # noqa: N802 - a class attribute
        """Map → (first, n): every n-th channel from the first one on."""


@runtime_checkable
class KeepsRows(Protocol):
    """Axes of some maps are rows of their images, so that they can be read alone."""

    @property
    def ROWS_BY(self) -> Mapping[str, Sequence[int]]:  # noqa: N802 - a class attribute
        """Names of maps (``*`` is any text), and those axes in the order of the file."""


@runtime_checkable
class HasLevels(Protocol):
    """It has levels of detail: ``lod`` of a lookup counts, and fine levels need not be kept.

    ``meta["levels"]`` describes each, ``meta["constants"]["first_level"]`` is the finest that is kept.
    """

    @property
    def LEVELS(self) -> Sequence[str]:  # noqa: N802 - a class attribute
        """Names of the maps that a level has; ``*`` is its number."""

    @property
    def max_lod(self) -> float:
        """Level of detail of the coarsest."""

    @property
    def sampling_levels(self) -> int:
        """Number of levels that :meth:`sampling_tables` has guides for."""

    def sampling_tables(self, level: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """As :meth:`Representation.sampling_tables`, with the rows and columns of a level."""


@runtime_checkable
class Spreads(Protocol):
    """Its values jump at silhouettes and borders of shadows, and it knows where."""

    def spread(self, uv: ArrayLike, w_light: ArrayLike, w_view: ArrayLike) -> np.ndarray:
        """How much B changes when the hit moves by what a float32 port may be off.

        Parameters
        ----------
        uv, w_light, w_view : array_like
            As for :meth:`Representation.evaluate`.

        Returns
        -------
        ndarray, shape (..., 3)
        """


@runtime_checkable
class SeesTexels(Protocol):
    """Its lookups read texels elsewhere than at their texture coordinates."""

    def seen_texels(self, uv: ArrayLike, w_view: ArrayLike) -> np.ndarray:
        """Flat indices of the texels that each lookup blends, shapes (N, 2), (N, 3) -> (N, T)."""


@runtime_checkable
class SharesTables(Protocol):
    """Its texels combine a few tables over views and lights."""

    def shared_tables(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The tables, and how texels combine them.

        Returns
        -------
        tables : ndarray of float, shape (cluster, 1 + component, view, light, 3)
        cluster : ndarray of int64, shape (texels,)
        coefficient : ndarray of float64, shape (texels, 1 + component)
            ``B_x = Σ_m coefficient[x, m] tables[cluster[x], m]``; the first one is 1.
        """


@runtime_checkable
class LitByHarmonics(SharesTables, Protocol):
    """Its shared tables are lit by environments in spherical harmonics."""

    @property
    def harmonic_shader(self) -> str:
        """GLSL file, relative to the shader directory."""


@runtime_checkable
class LitByTransfer(SharesTables, Protocol):
    """Its shared tables are lit by harmonics after radiance transfer through a mesh."""

    @property
    def transfer_shader(self) -> str:
        """GLSL file, relative to the shader directory."""


@runtime_checkable
class FitModule(Protocol):
    """The module of a method that makes representations."""

    @property
    def PRESETS(self) -> Mapping[str, Facts]:  # noqa: N802 - a constant of a module
        """Named settings of :meth:`fit`; "paper" has those of the method's paper."""

    def fit(
        self, btf: Any, *, seed: int = 0, progress: Progress | None = None, **parameters: Any
    ) -> Representation:
        """A representation of a sampled BTF; same seed, same result.

        Parameters
        ----------
        btf : btfref.sampling.sampled_btf.SampledBTF or btfref.sampling.blocks.BTFBlocks
            The latter, which has no ``values``, is given to modules whose ``FIT_MEMORY`` streams and to no others.

        Raises
        ------
        InputError
            For parameters out of range.
        """


@runtime_checkable
class StatesMemory(Protocol):
    """A module that says how much memory its fit takes."""

    @property
    def FIT_MEMORY(self) -> FitMemory:  # noqa: N802 - a constant of a module
        """What it takes at its peak."""


@dataclass(frozen=True)
class FitMemory:
    """What a fit takes at its peak, beside the interpreter.

    Attributes
    ----------
    each : float
        Bytes per value of a sampled BTF of half floats; the BTF itself included, unless the fit streams.
    blocks : int
        Bytes that do not grow with the BTF, for the default parameters.
    scales : tuple of str
        Parameters that the blocks, and the bytes of a texel, are in proportion to, where they are larger than by
        default.
    tables : tuple of str
        Parameters whose product is the number of tables over pairs of directions, each with a weight for all texels.
    view : float
        Bytes per value of a single view, of a fit that reads the BTF view by view.
    rows : float
        Bytes per value of the rows that are read together, of a fit that reads the BTF so; in any case one row.
    texels : int
        As many texels as such rows have at most, where one row has not more.
    columns : int
        Further tables, whatever the parameters are.
    texel, field : float
        Bytes per texel, and per texel and view.
    sequential : bool
        Its steps follow each other, so that workers have nothing to do side by side.
    """

    each: float = 0.0
    blocks: int = 0
    scales: tuple[str, ...] = ()
    tables: tuple[str, ...] = ()
    view: float = 0.0
    rows: float = 0.0
    texels: int = 0
    columns: int = 0
    texel: float = 0.0
    field: float = 0.0
    sequential: bool = False

    @property
    def streams(self) -> bool:
        """Whether the fit reads the BTF part by part, so that it need not be in memory."""
        return self.view > 0 or self.rows > 0


@runtime_checkable
class FitsPartially(Protocol):
    """A module that also fits what is there of a store that was filled in part."""

    def fit_partial(self, store: BTFStore, **parameters: Any) -> Representation:
        """A representation of what is there.

        Raises
        ------
        InputError
            For a store without any sample.
        """


def direction_axes(made: object, kind: Kind) -> Mapping[str, int]:
    """Maps of a representation or its class, and their axis over views or lights; empty for a method without."""
    return made.DIRECTION_AXES.get(kind, {}) if isinstance(made, KeepsDirections) else {}


def max_lod(representation: object) -> float:
    """Level of detail of the coarsest level; 0 for a method without levels."""
    return representation.max_lod if isinstance(representation, HasLevels) else 0.0
