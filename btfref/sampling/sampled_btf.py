"""A sampled BTF in memory."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from btfref.errors import InputError
from btfref.numerics.sphere.directions import DirectionSet, checked
from btfref.outputs import refuse_existing
from btfref.sampling.store.layout import TILE, remove_leftovers, replace_store
from btfref.sampling.store.store import create_store, open_store


@dataclass(frozen=True, eq=False)
class SampledBTF:
    """Values B = f · cos θ_light of a BTF at sampled directions.

    Attributes
    ----------
    values : ndarray, shape (views, lights, rows, columns, 3), float16 or float32
        1/sr, linear Rec. 709, the cosine included; axes ``btfref.conventions.AXES``.
    views, lights : DirectionSet
    variance : ndarray of the same shape, float32, or None
        Variance of the mean of each value.
    attributes : dict
        Conventions, seed, parameters, parent, versions.
    path : Path or None
        Where it was read from.

    Raises
    ------
    InputError
        Shapes that do not fit.
    """

    values: np.ndarray
    views: DirectionSet
    lights: DirectionSet
    variance: np.ndarray | None = None
    attributes: dict = field(default_factory=dict)
    path: Path | None = None

    def __post_init__(self):
        shape = np.shape(self.values)
        if len(shape) != 5 or shape[:2] != (len(self.views), len(self.lights)) or shape[4] != 3 or 0 in shape:
            raise InputError(
                "values of a sampled BTF",
                got=shape,
                expected=f"({len(self.views)}, {len(self.lights)}, rows, columns, 3)",
            )
        if self.values.dtype not in (np.float16, np.float32):
            raise InputError(
                "type of the values", field="values", got=self.values.dtype, expected="float16 or float32"
            )
        if self.variance is not None and self.variance.shape != shape:
            raise InputError("variance of a sampled BTF", got=self.variance.shape, expected=shape)

    @property
    def texels(self):
        """Rows and columns."""
        return self.values.shape[2:4]

    @classmethod
    def load(cls, path, *, views=None, lights=None, rows=None, columns=None, variance=True, partial=False):
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
        if not partial and not store.complete:
            missing = store.attributes.get("parent", {}).get("images_missing")
            raise InputError(
                f"incomplete: {missing} images are missing in what it was made from"
                if missing
                else "incomplete: its run was interrupted; start the same command again to finish it",
                file=store.path,
                field="coverage",
                got=f"{store.coverage.mean():.1%}",
                expected="100%",
            )
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

    def save(self, path, *, overwrite=False, tile=TILE):
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
