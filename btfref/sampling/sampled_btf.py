"""A sampled BTF in memory."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from btfref.conventions import in_one_line
from btfref.errors import InputError
from btfref.numerics.sphere.directions import DirectionSet, checked, directions
from btfref.outputs import refuse_existing
from btfref.sampling.blocks import refuse_incomplete
from btfref.sampling.store.layout import TILE, check_finite, remove_leftovers, replace_store
from btfref.sampling.store.store import create_store, open_store
from btfref.types import Facts

#: By how much the length of a direction may differ from 1: vectors written with four digits are let through.
UNIT_TOLERANCE = 1e-3

if TYPE_CHECKING:
    from btfref.sampling.store.arrays import Choice
    from btfref.types import PathLike


@dataclass(frozen=True, eq=False, init=False)
class SampledBTF:
    """Values B = f · cos θ_light of a BTF at sampled directions.

    Parameters
    ----------
    values : array_like, shape (views, lights, rows, columns, 3)
        1/sr, linear Rec. 709, the cosine included; axes ``btfref.conventions.AXES``. float16 and float32 are kept
        without a copy; float64 becomes float32.
    views, lights : DirectionSet, str or array_like
        A set, its name as `btfref.numerics.sphere.directions.directions` takes it, or unit vectors, shape (n, 3), with
        z ≥ 0 in the frame of the surface.
    variance : array_like of the same shape, optional
        Variance of the mean of each value; becomes float32.
    attributes : dict
        Conventions, seed, parameters, parent, versions.
    path : Path or None
        Where it was read from.

    Raises
    ------
    InputError
        Shapes that do not fit, values that are not finite or no floats, directions that are no unit vectors.

    Examples
    --------
    A grey Lambertian surface of 8 × 8 texels, seen from one direction and lit from 81:

    >>> import numpy as np
    >>> import btfref
    >>> lights = btfref.DirectionSet.of("ubo81")
    >>> cosines = lights.vectors[:, 2]
    >>> values = np.broadcast_to(0.5 / np.pi * cosines[None, :, None, None, None], (1, 81, 8, 8, 3))
    >>> btfref.SampledBTF(values, [[0, 0, 1]], lights)
    <SampledBTF float32: 8 × 8 texels, 1 views (custom) × 81 lights (ubo81), 62208 bytes>
    """

    values: np.ndarray
    views: DirectionSet
    lights: DirectionSet
    variance: np.ndarray | None = None
    attributes: Facts = field(default_factory=dict)
    path: Path | None = None

    # Written out, since what it takes is more than what the fields are.
    def __init__(
        self,
        values: ArrayLike,
        views: DirectionSet | str | ArrayLike,
        lights: DirectionSet | str | ArrayLike,
        variance: ArrayLike | None = None,
        attributes: Facts | None = None,
        path: Path | None = None,
    ) -> None:
        found: dict[str, object] = {
            "values": _floats(values, "values"),
            "views": _directions(views, "views"),
            "lights": _directions(lights, "lights"),
            "variance": None if variance is None else _floats(variance, "variance"),
            "attributes": {} if attributes is None else attributes,
            "path": path,
        }
        for name, value in found.items():
            object.__setattr__(self, name, value)
        shape = self.values.shape
        if len(shape) != 5 or shape[:2] != (len(self.views), len(self.lights)) or shape[4] != 3 or 0 in shape:
            raise InputError(
                "values of a sampled BTF",
                got=shape,
                expected=f"({len(self.views)}, {len(self.lights)}, rows, columns, 3)",
            )
        if self.variance is not None and self.variance.shape != shape:
            raise InputError("variance of a sampled BTF", got=self.variance.shape, expected=shape)
        if path is None:  # a store checks what is read from it
            for name in ("values", "variance"):
                array = getattr(self, name)
                if array is not None:
                    check_finite(array, None, name)

    def __repr__(self) -> str:
        kind = f"SampledBTF {self.values.dtype}"
        return in_one_line(kind, self.texels, self.views.facts, self.lights.facts, self.values.nbytes)

    @property
    def texels(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.values.shape[2:4]

    @property
    def dtype(self) -> np.dtype:
        """Type of the values."""
        return self.values.dtype

    def claim(self, size: int) -> bool:
        """Always: who holds all values may hold more; see :class:`btfref.sampling.blocks.BTFBlocks`."""
        return True

    def view(self, view: int) -> np.ndarray:
        """Values of a view, shape (lights, rows, columns, 3), without a copy."""
        return self.values[view]

    def rows(self, first: int, last: int) -> np.ndarray:
        """Values of the rows ``first … last − 1``, shape (views, lights, last − first, columns, 3), without a copy."""
        return self.values[:, :, first:last]

    @classmethod
    def load(
        cls,
        path: PathLike,
        *,
        views: Choice = None,
        lights: Choice = None,
        rows: Choice = None,
        columns: Choice = None,
        variance: bool = True,
        partial: bool = False,
    ) -> SampledBTF:
        """Read a store, or a part of it.

        Parameters
        ----------
        path : path-like
        views, lights, rows, columns : None, int, slice or sequence of int
            The part; None for all.
        variance : bool
            Whether to read the variance.
        partial : bool
            Accept a store that an interrupted run left, provided that the part asked for is there.

        Returns
        -------
        SampledBTF

        Raises
        ------
        InputError
            Not a store, an incomplete or damaged one, or one that holds values which are not finite.
        """
        store = open_store(path)
        if not partial:
            refuse_incomplete(store)
        values, spread = store.read(views=views, lights=lights, rows=rows, columns=columns, variance=variance)
        parts = {}
        for name, index in (("views", views), ("lights", lights)):
            directions = getattr(store, name)
            if index is not None:
                vectors = np.atleast_2d(directions.vectors[index])
                # A part need not be a set that can be interpolated, so it is not checked as one.
                directions = DirectionSet(
                    vectors, "custom" if len(vectors) < len(directions) else directions.name
                )
            parts[name] = directions
        return cls(values, **parts, variance=spread, attributes=store.attributes, path=store.path)

    def save(self, path: PathLike, *, overwrite: bool = False, tile: int = TILE) -> None:
        """Write a store; it appears under its name only when it is complete.

        Parameters
        ----------
        path : path-like
        overwrite : bool
            Replace a store of that name.
        tile : int
            Texels along one side of a chunk.

        Raises
        ------
        InputError
            The path exists, or a value is not finite.
        """
        path = Path(path)
        if not overwrite:
            refuse_existing(path)
        remove_leftovers(path)
        for name in ("views", "lights"):
            checked(getattr(self, name).vectors, "custom")
        draft = path.with_name(path.name + ".saving.partial")
        shutil.rmtree(draft, ignore_errors=True)
        try:
            store = create_store(
                draft,
                views=self.views,
                lights=self.lights,
                texels=self.texels,
                dtype=str(self.values.dtype),
                variance=self.variance is not None,
                tile=tile,
                attributes=self.attributes,
            )
            for index, values in enumerate(self.values):
                store.write_view(index, values, None if self.variance is None else self.variance[index])
            replace_store(draft, path)
        finally:
            shutil.rmtree(draft, ignore_errors=True)


def _floats(array: ArrayLike, field: str) -> np.ndarray:
    """An array of half or single floats, without a copy where it is one.

    Raises
    ------
    InputError
        For integers, which would be codes and no values in 1/sr, and whatever else is no float.
    """
    found = np.asarray(array)
    if found.dtype in (np.float16, np.float32):
        return found
    if found.dtype.kind != "f":
        raise InputError(
            f"type of the {field}", field=field, got=found.dtype, expected="float16, float32 or float64"
        )
    with np.errstate(over="ignore"):  # what becomes infinite is refused with its place
        return found.astype(np.float32)


def _directions(given: DirectionSet | str | ArrayLike, field: str) -> DirectionSet:
    """A set of directions; unlike `directions`, never of vectors that are no unit vectors.

    Raises
    ------
    InputError
    """
    if isinstance(given, str):
        return directions(given)
    if isinstance(given, DirectionSet):
        vectors = given.vectors
    else:
        try:
            vectors = np.asarray(given, float)
        except (TypeError, ValueError):
            raise InputError(
                "cannot read directions", field=field, expected="numbers, shape (n, 3)"
            ) from None
    if np.ndim(vectors) == 2:
        length = np.linalg.norm(vectors, axis=-1)
        odd = ~(np.abs(length - 1) <= UNIT_TOLERANCE)
        if odd.any():
            index = int(np.flatnonzero(odd)[0])
            raise InputError(
                "a direction is no unit vector",
                field=f"{field}[{index}]",
                got=f"length {length[index]:.4g}",
                expected="1",
            )
    return given if isinstance(given, DirectionSet) else directions(vectors)
