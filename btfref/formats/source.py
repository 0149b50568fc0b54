"""What every importer provides, and the row that a format has in the registry."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from btfref.errors import InputError
from btfref.numerics.sphere.directions import (
    NAMED_RINGS,
    RING_TOLERANCE,
    DirectionSet,
    checked,
    directions,
    spherical,
)
from btfref.outputs import refuse_existing, require_folder_of
from btfref.sampling.sampled_btf import SampledBTF
from btfref.types import Facts, PathLike

if TYPE_CHECKING:
    from btfref.formats.image_sets.files import Candidate
    from btfref.sampling.store.store import BTFStore

#: Bytes that a conversion may hold at a time, unless told otherwise.
MEMORY = 2 << 30

#: More directions than any measured set has; headers beyond it are damaged.
LARGEST_COUNT = 1 << 16


@dataclass
class Source:
    """A measured BTF whose headers were read and whose values are read part by part.

    Parameters
    ----------
    path : Path
    format : str
        Name of its format.
    views, lights : DirectionSet
    texels : tuple of int
        Rows and columns.
    colours : callable
        ``colours(view, first, last)``: linear Rec. 709 of the lights ``first … last − 1`` of a view, float32,
        shape (last − first, rows, columns, 3), row 0 the first of the picture, in the quantity of the file.
        Where `present` is False the values are arbitrary.
    cosine_included : bool
        Whether that quantity holds cos θ_light.
    scale : float
        Factor from that quantity to 1/sr.
    facts : dict
        What ``btfref info`` says beyond the above; JSON types.
    present : ndarray of bool, shape (views, lights), optional
        What was measured; all by default.
    moved : dict of (int, int) to (float, float)
        Pairs measured with the light elsewhere: (view, light) -> polar angle and azimuth in degrees.
    fingerprint : callable or str
        ``() -> str``: changes with the content, every byte of it; a resumed run checks it. Asked by conversions alone,
        since it reads the whole. Archives have checksums of their files already.
    release : callable, optional
        Gives back what memory the file takes without being asked for, after each view.
    memory : int
        Bytes that a conversion may hold at a time.
    """

    path: Path
    format: str
    views: DirectionSet
    lights: DirectionSet
    texels: tuple[int, int]
    colours: Callable[[int, int, int], np.ndarray]
    cosine_included: bool
    scale: float = 1.0
    facts: Facts = field(default_factory=dict)
    present: np.ndarray = field(default_factory=lambda: np.array(True))
    moved: dict[tuple[int, int], tuple[float, float]] = field(default_factory=dict)
    fingerprint: Callable[[], str] | str = ""
    release: Callable[[], None] | None = None
    memory: int = MEMORY

    def __post_init__(self) -> None:
        # Damaged values may be infinite or NaN: whoever stores them checks; arithmetic with them is no error here.
        self.colours = np.errstate(over="ignore", invalid="ignore")(self.colours)
        self.present = np.array(np.broadcast_to(self.present, (len(self.views), len(self.lights))))

    def digest(self) -> str:
        """The fingerprint."""
        return self.fingerprint if isinstance(self.fingerprint, str) else self.fingerprint()

    def info(self) -> Facts:
        """Facts from the headers; JSON types, keys as those of a store where they mean the same."""
        shape = [len(self.views), len(self.lights), *self.texels, 3]
        return {
            "kind": "measured-btf",
            "format": self.format,
            "shape": shape,
            "directions": {
                "views": {"name": self.views.name, "count": len(self.views)},
                "lights": {"name": self.lights.name, "count": len(self.lights)},
            },
            "cosine": "included" if self.cosine_included else "not included",
            "scale": self.scale,
            "images_missing": int((~self.present).sum()),
            "lights_moved": len(self.moved),
            "raw_bytes": 4 * int(np.prod([int(n) for n in shape], dtype=object)),
            **self.facts,
        }


@dataclass(frozen=True)
class Format:
    """A row of the registry.

    Parameters
    ----------
    name, title : str
    recognises : callable
        ``recognises(candidate) -> bool``, from the first bytes and the names of a
        `btfref.formats.image_sets.files.Candidate`.
    open : callable
        ``open(path, **options) -> Source``; raises InputError.
    options : frozenset of str
        What `open` takes.
    export : callable, optional
        ``export(btf, path, **settings) -> dict``; None for a format that is only read.
    settings : frozenset of str
        What `export` takes.
    peak : callable, optional
        ``peak(shape, itemsize, settings) -> int``: bytes that `export` holds at most of a BTF of that shape and type,
        beside the interpreter; None where it is not known, and no budget can be kept.
    """

    name: str
    title: str
    recognises: Callable[[Candidate], bool]
    open: Callable[..., Source]
    options: frozenset[str] = frozenset()
    export: Callable[..., Facts] | None = None
    settings: frozenset[str] = frozenset()
    peak: Callable[[tuple[int, ...], int, Facts], int] | None = None

    def open_checked(self, path: PathLike, options: Mapping[str, object]) -> Source:
        """`open` with options that were given (None counts as not given) and that the format knows."""
        return self.open(path, **self._known(options, self.options))

    def export_checked(
        self,
        btf: BTFStore | SampledBTF,
        path: PathLike,
        settings: Mapping[str, object],
        *,
        memory: int | None = None,
    ) -> Facts:
        """`export` likewise, to a path that does not exist; ``memory`` in bytes is what it may hold at most."""
        if self.export is None:
            raise InputError("this format is only read", field="format", got=repr(self.name))
        settings = self._known(settings, self.settings | {"progress"})
        if memory is not None:
            self._check(memory, btf, settings)
            if "memory" in self.settings:
                settings = {"memory": memory, **settings}
        path = Path(path)
        refuse_existing(path)
        require_folder_of(path)
        return self.export(btf, path, **settings)

    def _check(self, memory: int, btf: BTFStore | SampledBTF, settings: Facts) -> None:
        """InputError for a budget that cannot be kept."""
        if self.peak is None:
            return
        shape = (len(btf.views), len(btf.lights), *btf.texels, 3)
        dtype = btf.values.dtype if isinstance(btf, SampledBTF) else btf.dtype
        need = self.peak(shape, np.dtype(dtype).itemsize, settings)
        if need > memory:
            raise InputError(
                f"writing {self.name} holds more than the memory allowed",
                field="memory",
                got=f"{memory / 2**20:.0f} MiB for the BTF",
                expected=f"at least {need / 2**20:.0f} MiB",
            )

    def _known(self, given: Mapping[str, object], known: frozenset[str]) -> Facts:
        given = {key: value for key, value in given.items() if value is not None}
        for key in given:
            if key not in known:
                raise InputError(
                    f"format '{self.name}' has no such option",
                    field=key,
                    expected=f"one of {', '.join(sorted(known)) or 'none'}",
                )
        return given


def direction_set(theta: ArrayLike, phi: ArrayLike, file: PathLike) -> DirectionSet:
    """Directions of a file, by name where they are a known set.

    Parameters
    ----------
    theta, phi : array_like, shape (n,)
        Radians.
    file : path-like
        For errors.

    Returns
    -------
    DirectionSet
        Of a named set exactly, when every direction is within the tolerance of rings.

    Raises
    ------
    InputError
        Below the horizon, twice the same, or a set that cannot be interpolated.
    """
    vectors = spherical(np.asarray(theta, float), np.asarray(phi, float))
    for name in NAMED_RINGS:
        known = directions(name)
        if len(known) == len(vectors) and np.abs(known.vectors - vectors).max() < RING_TOLERANCE:
            return known
    # A horizon in degrees or float32 lies a rounding below z = 0.
    vectors[:, 2] = np.where(np.abs(vectors[:, 2]) < 1e-6, np.maximum(vectors[:, 2], 0), vectors[:, 2])
    return checked(vectors, "custom", file=file)
