"""Bonn's binary BTFs ``.btf``: DFMF (the form of UBO2014), FMF, PVF and BDI, read view by view in NumPy.

Values are f, or f · cos θ_light where the cosine flag is set; colours are linear. Nothing is flipped or clipped.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from btfref.errors import InputError
from btfref.formats.bonn import colour
from btfref.formats.bonn.bdi import BDI
from btfref.formats.bonn.header import Header, read_header, signature_of, to_rgb
from btfref.formats.parts import one_view
from btfref.formats.reading import Reader
from btfref.formats.source import LARGEST_COUNT, Format, Source
from btfref.types import Facts, PathLike

if TYPE_CHECKING:
    from btfref.formats.image_sets.files import Candidate
    from btfref.sampling.sampled_btf import SampledBTF
    from btfref.sampling.store.store import BTFStore

_SCALARS = {2: "<f2", 4: "<f4", 8: "<f8"}
_LARGEST_RANK = 1 << 16

#: Sizes of a block of scan lines that BDI is written by, the least: as read, in the file's order, and a chunk's bytes.
BLOCK_COPIES = 4


def recognises(candidate: Candidate) -> bool:
    """Whether the file starts with one of Bonn's signatures."""
    return signature_of(candidate.head) is not None


def open_bonn(path: PathLike) -> Source:
    """Open a file of any of the four families.

    Parameters
    ----------
    path : path-like

    Returns
    -------
    Source

    Raises
    ------
    InputError
        Truncated or damaged, with field and offset; sizes are compared with the file before anything is made.
    """
    reader = Reader(path)
    header = read_header(reader)
    values = _FAMILIES[header.family](reader, header)
    if reader.offset != reader.size:
        reader.fail("more bytes than the header explains", "end", got=reader.size, expected=reader.offset)
    weights = to_rgb(header.channels, reader.path)

    def colours(view: int, first: int, last: int) -> np.ndarray:
        with np.errstate(over="ignore", invalid="ignore"):
            found = values.decode(view, first, last)
            if weights is not None:
                found = found @ weights
        return found.reshape(last - first, *header.texels, 3)

    source = Source(
        path=reader.path,
        format="bonn",
        views=header.views,
        lights=header.lights,
        texels=header.texels,
        colours=colours,
        cosine_included=header.cosine_included,
        facts={
            "family": header.family,
            "signature": header.signature.decode(),
            "channels": list(header.channels),
            "file_bytes": reader.size,
            **header.facts,
            **values.facts,
        },
        fingerprint=reader.digest,
        release=reader.release,
    )
    if isinstance(values, BDI):
        values.source = source  # which says how much memory there is
    return source


class _Values(Protocol):
    """What follows a header."""

    facts: Facts

    def decode(self, view: int, first: int, last: int) -> np.ndarray:
        """Values of the lights ``first … last − 1`` of a view, float32 (lights, texels, channels)."""
        ...


class _Factors:
    """S[K], U[rows][K] and SxV[columns][K] with their sizes in front, looking into the file."""

    def __init__(self, reader: Reader, name: str, pairs: int, texels: int) -> None:
        at = reader.offset
        self.scalar = _scalar(reader, name)
        rank = reader.number("u32", f"components of {name}", 1, _LARGEST_RANK)
        rows = reader.number("u32", f"rows of {name}")
        columns = reader.number("u32", f"columns of {name}")
        # Rows are pairs of directions, or, in transposed files, texels.
        self.transposed = (rows, columns) != (pairs, texels)
        if self.transposed and (rows, columns) != (texels, pairs):
            reader.fail(
                "matrix that does not fit the directions and texels",
                f"rows, columns of {name}",
                at=at + 5,
                got=(rows, columns),
                expected=f"{(pairs, texels)} or {(texels, pairs)}",
            )
        reader.array(f"singular values of {name}", _SCALARS[self.scalar], (rank,))
        left = reader.array(f"U of {name}", _SCALARS[self.scalar], (rows, rank))
        right = reader.array(f"SxV of {name}", _SCALARS[self.scalar], (columns, rank))
        self.rank = rank
        self.of_pairs, self.of_texels = (right, left) if self.transposed else (left, right)

    def cut(self, rank: int) -> None:
        """Use no more than the first ``rank`` components."""
        self.rank = min(self.rank, rank)
        self.of_pairs, self.of_texels = self.of_pairs[:, : self.rank], self.of_texels[:, : self.rank]

    @cached_property
    def texels(self) -> np.ndarray:
        """Rows of the texels' side in float32, converted once: every view needs all of them."""
        return self.of_texels.astype(np.float32)


def _scalar(reader: Reader, name: str) -> int:
    size = reader.number("u8", f"scalar size of {name}")
    if size not in _SCALARS:
        reader.fail(
            "scalar size", f"scalar size of {name}", at=reader.offset - 1, got=size, expected="2, 4 or 8"
        )
    return size


class _DFMF:
    """One factorization per decorrelated channel."""

    def __init__(self, reader: Reader, header: Header) -> None:
        self._header = header
        reader.number("u32", "components")
        at = reader.offset
        self.model = reader.number("i32", "colour model")
        n = len(header.channels)
        if self.model not in colour.NAMES or (n != 3 and self.model not in colour.ANY_CHANNELS):
            known = ", ".join(map(str, colour.NAMES if n == 3 else colour.ANY_CHANNELS))
            reader.fail(
                "colour model", "colour model", at=at, got=f"{self.model} of {n} channels", expected=known
            )
        self._mean = reader.floats("colour mean", (3,))
        self._matrix = reader.floats("colour matrix", (3, 3))
        self._factors = [_Factors(reader, f"channel {c}", header.n_pairs, header.n_texels) for c in range(n)]
        self.facts: Facts = {
            "colour_model": f"{self.model} ({colour.NAMES[self.model]})",
            "components": [one.rank for one in self._factors],
            "scalar_bytes": [one.scalar for one in self._factors],
        }

    def decode(self, view: int, first: int, last: int) -> np.ndarray:
        start = view * len(self._header.lights)
        planes = [
            one.of_pairs[start + first : start + last].astype(np.float32) @ one.texels.T
            for one in self._factors
        ]
        return colour.undo(np.stack(planes, -1), self.model, self._mean, self._matrix)


class _FMF:
    """One factorization; channels are the fastest part of the rows."""

    def __init__(self, reader: Reader, header: Header) -> None:
        self._header, n = header, len(header.channels)
        version = (
            reader.number("u8", "version of the extended header", 0, 2) if b"ER" in header.signature else 0
        )
        self._log = version >= 1 and reader.number("u32", "dynamic range reduction") != 0
        self.facts: Facts = {"dynamic_range": "log" if self._log else "linear"}
        if version >= 2:
            width = reader.number("u32", "width of the height map", 0, 1 << 16)
            height = reader.number("u32", "height of the height map", 0, 1 << 16)
            reader.array("height map", "<f2", (height, width))
            self.facts["height_map"] = [width, height]
        largest = reader.number("u32", "components", 1)
        # In the transposed form the channels stand with the texels.
        at = reader.offset
        try:
            self._factors = _Factors(reader, "FMF", n * header.n_pairs, header.n_texels)
            self._with_texels = self._factors.transposed
            if self._with_texels:
                reader.fail("matrix that does not fit the directions and texels", "rows of FMF", at=at)
        except InputError:
            reader.offset = at
            self._factors = _Factors(reader, "FMF", header.n_pairs, n * header.n_texels)
            if not self._factors.transposed:
                reader.fail("matrix that does not fit the directions and texels", "rows of FMF", at=at)
            self._with_texels = True
        # The owners' reader takes no more components than the header says.
        self._factors.cut(largest)
        self.facts |= {"components": self._factors.rank, "scalar_bytes": self._factors.scalar}

    def decode(self, view: int, first: int, last: int) -> np.ndarray:
        n, start = len(self._header.channels), view * len(self._header.lights)
        first, last = start + first, start + last
        if self._with_texels:
            rows = self._factors.of_pairs[first:last].astype(np.float32)
            values = (rows @ self._factors.texels.T).reshape(last - first, -1, n)
        else:
            rows = self._factors.of_pairs[first * n : last * n].astype(np.float32)
            values = (rows @ self._factors.texels.T).reshape(last - first, n, -1).transpose(0, 2, 1)
        return np.exp(values) - np.float32(colour.EPSILON) if self._log else values


class _PVF:
    """A principal component analysis per view."""

    def __init__(self, reader: Reader, header: Header) -> None:
        self._header, n = header, len(header.channels)
        if "legacy_slots" in header.facts:
            slots = header.facts.pop("legacy_slots")
        else:
            reader.number("u32", "components")
            slots = reader.number("u32", "view slots", 1, LARGEST_COUNT)
        if slots != len(header.views):
            reader.fail(
                "view slots", "view slots", at=reader.offset - 4, got=slots, expected=len(header.views)
            )
        self._n_channels = n
        self._views: list[tuple[bool, np.ndarray, np.ndarray, np.ndarray]] = []
        sizes = n * len(header.lights), n * header.n_texels
        for view in range(slots):
            name = f"view {view}"
            kind = _SCALARS[_scalar(reader, name)]
            at = reader.offset
            rank = reader.number("u32", f"components of {name}", 1, _LARGEST_RANK)
            n_weights = reader.number("u32", f"weights of {name}")
            dimension = reader.number("u32", f"dimension of {name}")
            of_lights = (dimension, n_weights) == (sizes[0], header.n_texels)
            if not of_lights and (dimension, n_weights) != (sizes[1], len(header.lights)):
                reader.fail(
                    "matrix that does not fit the lights and texels",
                    f"weights, dimension of {name}",
                    at=at + 4,
                    got=(n_weights, dimension),
                    expected=f"{(header.n_texels, sizes[0])} or {(len(header.lights), sizes[1])}",
                )
            reader.array(f"eigenvalues of {name}", kind, (rank,))
            mean, components, weights = (
                reader.array(f"{part} of {name}", kind, shape)
                for part, shape in (
                    ("mean", (dimension,)),
                    ("components", (dimension, rank)),
                    ("weights", (n_weights, rank)),
                )
            )
            self._views.append((of_lights, mean, components, weights))
        self.facts: Facts = {"components": max(components.shape[1] for _, _, components, _ in self._views)}

    def decode(self, view: int, first: int, last: int) -> np.ndarray:
        of_lights, mean, components, weights = self._views[view]
        n = self._n_channels
        if of_lights:
            part = slice(first * n, last * n)
            values = components[part].astype(np.float32) @ weights.astype(np.float32).T
            values = (values + mean[part].astype(np.float32)[:, None]).reshape(last - first, n, -1)
            return values.transpose(0, 2, 1)
        values = weights[first:last].astype(np.float32) @ components.astype(np.float32).T
        return (values + mean.astype(np.float32)).reshape(last - first, -1, n)


_FAMILIES: dict[str, Callable[[Reader, Header], _Values]] = {
    "DFMF": _DFMF,
    "FMF": _FMF,
    "PVF": _PVF,
    "BDI": BDI,
}


def export(btf: BTFStore | SampledBTF, path: PathLike, **settings: Any) -> Facts:
    """Write DFMF or BDI: `btfref.formats.bonn.export`."""
    from btfref.formats.bonn.export import export_bonn

    return export_bonn(btf, path, **settings)


def peak(shape: tuple[int, ...], itemsize: int, settings: Facts) -> int:
    """Bytes that :func:`export` holds at its peak: ``peak`` of a `btfref.formats.source.Format`."""
    from btfref.formats.bonn.export import LARGEST_RANK, OVERSAMPLED, SCAN_LINES

    if settings.get("texels"):
        shape = (*shape[:2], settings["texels"], settings["texels"], 3)
    n_views, n_lights, rows, columns, _ = shape
    pairs, texels = n_views * n_lights, rows * columns
    if settings.get("family") == "BDI":
        return BLOCK_COPIES * itemsize * pairs * 3 * SCAN_LINES * columns
    rank = settings.get("components") or (LARGEST_RANK if "error" in settings else 64)
    width = min(rank + OVERSAMPLED, texels, pairs)
    # A view as read, as float32 in the colour model and as three matrices; bases and sums of the texels' side of all
    # channels, factors of the other side, one of which is decomposed in float64.
    view = one_view(shape, itemsize, settings) + 3 * 4 * 3 * n_lights * texels
    return view + 3 * 4 * width * (3 * texels + pairs) + 3 * 8 * width * pairs


FORMAT = Format(
    "bonn",
    "Bonn's binary BTFs: DFMF, FMF, PVF, BDI",
    recognises,
    open_bonn,
    export=export,
    peak=peak,
    settings=frozenset({"family", "components", "error", "colour_model", "scalar", "texels", "memory"}),
)
