"""Writing Bonn's ``.btf``: DFMF by a streaming factorization, BDI as it is; the light's cosine is in the data."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from btfref.errors import InputError
from btfref.formats.bonn import bdi, colour
from btfref.formats.parts import PartReader, open_parts
from btfref.formats.source import MEMORY
from btfref.numerics.solvers.threads import one_blas_thread
from btfref.outputs import new_file
from btfref.provenance import __version__
from btfref.types import Facts, PathLike, Progress

if TYPE_CHECKING:
    from btfref.sampling.sampled_btf import SampledBTF
    from btfref.sampling.store.store import BTFStore

#: Scan lines per chunk that the owners' writer uses.
SCAN_LINES = 4

LARGEST_RANK = 512

#: Columns of a subspace beyond the rank that is wanted.
OVERSAMPLED = 8

#: Passes over the data after the first: each sharpens the subspace.
_PASSES = 2


def export_bonn(
    btf: BTFStore | SampledBTF,
    path: PathLike,
    *,
    family: str = "DFMF",
    components: int | None = None,
    error: float | None = None,
    colour_model: int = 0,
    scalar: int = 2,
    texels: int | None = None,
    memory: int = MEMORY,
    progress: Progress | None = None,
) -> Facts:
    """Write a ``.btf`` file.

    Parameters
    ----------
    btf : BTFStore or SampledBTF
    path : path-like
    family : {"DFMF", "BDI"}
        DFMF factors, BDI holds every value as a half float.
    components : int, optional
        K of each channel (DFMF); 64 when neither this nor `error` is given, at most what the data has.
    error : float, optional
        Root mean square error of a channel over its root mean square at which to stop, in the colour model's
        own values (for model 0, in B); K is what that takes.
    colour_model : {0, 11}
        0: R, G, B. 11: log Y, U/Y, V/Y, as UBO2014; values must have positive luminance.
    scalar : {2, 4}
        Bytes of a factor.
    texels : int, optional
        Rows and columns of the file, if not those of the BTF: its tile is repeated. A BTF of known values then stands
        for one as large as those that are measured.
    memory : int
        Bytes to hold at a time (BDI).

    Returns
    -------
    dict
        ``family``, and for DFMF ``components`` and ``error`` (as above, of the factors before rounding) per channel.

    Raises
    ------
    InputError
        Settings or values that the file cannot hold.
    """
    if family not in ("DFMF", "BDI"):
        raise InputError("family", field="family", got=repr(family), expected="DFMF or BDI")
    if texels is not None and (isinstance(texels, bool) or not isinstance(texels, int) or texels < 1):
        raise InputError("texels of the file", field="texels", got=texels, expected="at least 1")
    source, path = open_parts(btf, texels), Path(path)
    with new_file(path) as draft, draft.open("wb") as stream:
        if family == "BDI":
            facts = _write_bdi(stream, source, memory, progress)
        else:
            facts = _write_dfmf(stream, source, components, error, colour_model, scalar, progress)
    return {"format": "bonn", "family": family, **facts, "file_bytes": path.stat().st_size}


def _header(source: PartReader, signature: bytes) -> bytes:
    """Signature, measurement block (version 4) and directions."""
    text = [f"btfref {__version__}", "path traced or imported", "directional"]
    block = b"".join(line.encode()[:79].ljust(80, b"\0") for line in text)
    block += struct.pack("<ffffII", 1.0, 1.0, 1.0, 1.0, 1, 0)  # pixels per mm, RGB scale, cosine flag, no XML
    block += struct.pack("<I", 3) + b"".join(struct.pack("<I", 1) + name for name in (b"R", b"G", b"B"))
    block = struct.pack("<II", len(block) + 8, 4) + block
    angles = {
        name: np.stack([getattr(source, name).theta, getattr(source, name).phi], -1).astype("<f4")
        for name in ("views", "lights")
    }
    lights = struct.pack("<I", len(source.lights)) + angles["lights"].tobytes()
    table = b"".join(view.tobytes() + lights for view in angles["views"])
    return signature + block + struct.pack("<I", len(source.views)) + table


def _write_bdi(stream: BinaryIO, source: PartReader, memory: int, progress: Progress | None) -> Facts:
    rows, columns = source.texels
    stream.write(_header(source, b"!BDIF06R2!"))
    stream.write(struct.pack("<IIIB", columns, rows, SCAN_LINES, bdi.FULL))
    stream.write(np.ones(rows * columns, np.uint8).tobytes())
    stream.write(struct.pack("<I", 0))
    line = len(source.views) * len(source.lights) * columns * 3 * 2
    # Values as read, their transpose in half floats, and the bytes of a chunk.
    step = max(SCAN_LINES, memory // (4 * line) // SCAN_LINES * SCAN_LINES)
    for first in range(0, rows, step):
        # Row 0 of a picture is its top, v = 1, as in every format that we write.
        last = min(first + step, rows)
        with np.errstate(over="ignore"):
            values = source.rows(rows - last, rows - first)[:, :, ::-1].astype("<f2")
        if not np.isfinite(values).all():
            raise InputError("value beyond half floats", field="rows", got=f"{rows - last} to {rows - first}")
        for start in range(0, last - first, SCAN_LINES):
            part = values[:, :, start : start + SCAN_LINES]
            chunk = np.ascontiguousarray(part.transpose(2, 3, 0, 1, 4)).tobytes()
            stream.write(struct.pack("<I", len(chunk)))
            stream.write(chunk)
        if progress is not None:
            progress(last, rows, "export")
    return {"scan_lines_per_chunk": SCAN_LINES}


def _write_dfmf(
    stream: BinaryIO,
    source: PartReader,
    components: int | None,
    error: float | None,
    model: int,
    scalar: int,
    progress: Progress | None,
) -> Facts:
    if model not in (0, 11):
        raise InputError("colour model", field="colour_model", got=model, expected="0 or 11")
    if scalar not in (2, 4):
        raise InputError("bytes of a factor", field="scalar", got=scalar, expected="2 or 4")
    if components is not None and error is not None:
        raise InputError("components and error both given", field="components", expected="one of them")
    largest = min(len(source.views) * len(source.lights), source.texels[0] * source.texels[1], LARGEST_RANK)
    if components is not None and (isinstance(components, bool) or not 1 <= components):
        raise InputError("components", field="components", got=components, expected="at least 1")
    if error is not None and not 0 < error < 1:
        raise InputError("target error", field="error", got=error, expected="between 0 and 1")
    rank = min(components or 64, largest) if error is None else min(16, largest)
    while True:
        factors, reached = _factors(source, model, rank, progress)
        if error is None or rank == largest or max(reached[:, -1]) <= error:
            break
        rank = min(2 * rank, largest)
    ranks = [rank] * 3
    if error is not None:
        ranks = [int(np.argmax(curve <= error)) + 1 if curve[-1] <= error else rank for curve in reached]
        if max(reached[:, -1]) > error:
            raise InputError(
                "error that cannot be reached",
                field="error",
                got=error,
                expected=f"≥ {max(reached[:, -1]):.3g}, reached with {rank} components",
            )
    stream.write(_header(source, b"!DFMF08FCR"))
    rows, columns = source.texels
    stream.write(struct.pack("<III", columns, rows, 0))
    stream.write(struct.pack("<Ii", max(ranks), model))
    stream.write(np.zeros(3, "<f4").tobytes() + np.eye(3, dtype="<f4").tobytes())
    kind = np.dtype(f"<f{scalar}")
    for (left, singular, right), k in zip(factors, ranks, strict=True):
        stream.write(struct.pack("<BIII", scalar, k, len(left), len(right)))
        # Half floats hold neither large singular values nor small entries of long unit vectors: both sides
        # get the root of the singular values; readers multiply U and SxV only.
        for array in (singular[:k], left[:, :k], right[:, :k]):
            with np.errstate(over="ignore"):
                stored = np.minimum(array, np.finfo(kind).max).astype(kind)
            stream.write(np.ascontiguousarray(stored).tobytes())
    return {
        "colour_model": model,
        "components": ranks,
        "error": [float(curve[k - 1]) for curve, k in zip(reached, ranks, strict=True)],
    }


def _factors(
    source: PartReader, model: int, rank: int, progress: Progress | None
) -> tuple[list[tuple[np.ndarray, np.ndarray, np.ndarray]], np.ndarray]:
    """Balanced factors of each channel and the relative error after 1 … rank components, shape (3, rank).

    Subspace iteration over the texels' side, view by view (Halko, Martinsson, Tropp 2011, algorithm 4.4), so that
    no more than one view is held beside the factors.
    """
    n_views, n_lights = len(source.views), len(source.lights)
    n_texels = source.texels[0] * source.texels[1]
    width = min(rank + OVERSAMPLED, n_texels, n_views * n_lights)
    rng = np.random.default_rng(0)
    bases = [rng.standard_normal((n_texels, width), dtype=np.float32) for _ in range(3)]
    total, steps = np.zeros(3), 0
    for turn in range(_PASSES + 1):
        sums = [np.zeros((n_texels, width), np.float32) for _ in range(3)]
        with one_blas_thread():
            bases = [np.linalg.qr(basis)[0] for basis in bases]
        for view in range(n_views):
            for c, matrix in enumerate(_matrices(source, view, model)):
                sums[c] += matrix.T @ (matrix @ bases[c])
                if turn == 0:
                    total[c] += float((matrix.astype(np.float64) ** 2).sum())
            steps += 1
            if progress is not None:
                progress(steps, (_PASSES + 2) * n_views, "factorization")
        bases = sums
    with one_blas_thread():
        bases = [np.linalg.qr(basis)[0] for basis in bases]
    lefts = [np.zeros((n_views * n_lights, width), np.float32) for _ in range(3)]
    for view in range(n_views):
        for c, matrix in enumerate(_matrices(source, view, model)):
            lefts[c][view * n_lights : (view + 1) * n_lights] = matrix @ bases[c]
        steps += 1
        if progress is not None:
            progress(steps, (_PASSES + 2) * n_views, "factorization")
    factors, reached = [], np.zeros((3, rank))
    for c, (left, basis) in enumerate(zip(lefts, bases, strict=True)):
        with one_blas_thread():
            u, s, vt = np.linalg.svd(left.astype(np.float64), full_matrices=False)
        root = np.sqrt(s[:rank])
        factors.append((u[:, :rank] * root, s[:rank], (basis @ vt[:rank].T) * root))
        missing = np.maximum(total[c] - np.cumsum(s[:rank] ** 2), 0)
        reached[c] = np.sqrt(missing / total[c]) if total[c] > 0 else 0
    return factors, reached


def _matrices(source: PartReader, view: int, model: int) -> list[np.ndarray]:
    """Each channel of a view in the colour model: (lights, texels) float32, the picture's top first."""
    values = source.view(view)[:, ::-1].astype(np.float32)
    if model == 11:
        try:
            values = colour.log_yuv(values)
        except ValueError as found:
            raise InputError(str(found), field="colour_model", got=11, expected="0 for such values") from None
    return [np.ascontiguousarray(values[..., c]).reshape(len(values), -1) for c in range(3)]
