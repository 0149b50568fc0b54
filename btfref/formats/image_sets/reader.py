"""Folders and archives with one image per pair of directions: what UBO2003, UTIA and SPECTRAL share."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from btfref.errors import InputError
from btfref.formats.image_sets.angles import angles_of, grid, style_of
from btfref.formats.image_sets.files import Archive, Candidate, Folder, files_of
from btfref.formats.image_sets.pattern import angles_by
from btfref.formats.source import Source
from btfref.images import decoding
from btfref.types import Facts, PathLike

#: ``to_linear(pixels, channels, where)``: linear Rec. 709, float32 (rows, columns, 3).
ToLinear = Callable[[np.ndarray, tuple[str, ...], PathLike], np.ndarray]

#: Our own note beside exported images: what 8 bits and names cannot say. Other readers pass it over.
NOTE = "btfref.json"


def recogniser(style: str) -> Callable[[Candidate], bool]:
    """``recognises(candidate)`` of folders and archives whose names are of that style."""

    def recognises(candidate: Candidate) -> bool:
        return candidate.files is not None and style_of(candidate.files.images()) == style

    return recognises


def opener(name: str, to_linear: ToLinear, *, cosine_included: bool, scale: float) -> Callable[..., Source]:
    """``open(path, *, allow_missing=False, pattern=None)`` of a format without other options; as `image_source`."""
    return partial(image_source, name=name, to_linear=to_linear, cosine_included=cosine_included, scale=scale)


def image_source(
    path: PathLike,
    name: str,
    to_linear: ToLinear,
    *,
    cosine_included: bool,
    scale: float,
    allow_missing: bool = False,
    pattern: str | None = None,
    facts: Mapping[str, Any] | None = None,
) -> Source:
    """A source of one image per pair.

    Parameters
    ----------
    path : path-like
        Folder or zip archive.
    name : str
        Of the format.
    to_linear : callable
        ``to_linear(pixels, channels, where)``: linear Rec. 709, float32 (rows, columns, 3), of what
        `btfref.images.decoding.decode` gives.
    cosine_included, scale
        As of `Source`, where no note of ours says otherwise.
    allow_missing : bool
    pattern : str, optional
        Of the names, see `btfref.formats.image_sets.pattern.angles_by`.
    facts : dict, optional

    Returns
    -------
    Source
    """
    files = files_of(path)
    angles_in = angles_of if pattern is None else angles_by(pattern)
    found = grid(files.images(), path, allow_missing=allow_missing, angles_in=angles_in)
    first = next(iter(found.images.values()))
    kind, rows, columns, channels = decoding.header(files.read(first), files.where(first))
    note = _note(files)
    texels = rows, columns

    def colours(view: int, start: int, stop: int) -> np.ndarray:
        result = np.zeros((stop - start, rows, columns, 3), np.float32)
        for slot, light in enumerate(range(start, stop)):
            image = found.images.get((view, light))
            if image is not None:
                where = files.where(image)
                result[slot] = to_linear(*decoding.decode(files.read(image), where, texels), where)
        return result

    return Source(
        path=files.path,
        format=name,
        views=found.views,
        lights=found.lights,
        texels=texels,
        colours=colours,
        cosine_included=note.get("cosine_included", cosine_included),
        scale=note.get("scale", scale),
        facts={
            "images": len(found.images),
            "pictures": {"8bit": "8 bits", "hdr": "Radiance", "exr": "OpenEXR"}[kind],
            "channels": list(channels),
            "file_bytes": sum(files.sizes.values()),
            **(facts or {}),
        },
        present=found.present,
        moved=found.moved,
        fingerprint=files.fingerprint,
    )


def _note(files: Folder | Archive) -> Facts:
    """Entries of our note that are valid, or none."""
    if NOTE not in files.sizes:
        return {}
    try:
        note = json.loads(files.read(NOTE))
        scale, included = float(note["scale"]), note["cosine_included"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError("damaged note", file=files.where(NOTE), got=repr(error)) from None
    if not (1e-12 < scale < 1e12 and isinstance(included, bool)):
        raise InputError("damaged note", file=files.where(NOTE), got=str(note)[:200])
    return {"scale": scale, "cosine_included": included}


def pick(channels: Sequence[str], names: Sequence[str], where: PathLike) -> list[int]:
    """Indices of named channels.

    Raises
    ------
    InputError
        When one is missing.
    """
    if not set(names) <= set(channels):
        raise InputError(
            "channels of a picture", file=where, got=", ".join(channels)[:200], expected=", ".join(names)
        )
    return [channels.index(name) for name in names]
