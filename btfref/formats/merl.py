"""MERL ``.binary``: an isotropic BRDF over half and difference angles, as a BTF of one texel.

Three i32 counts (θ_h 90, θ_d 90, φ_d 180 over half a turn), then doubles [channel][θ_h][θ_d][φ_d]; R, G and B times
1/1500, 1.15/1500 and 1.66/1500 give f in 1/sr (Matusik et al. 2003, "A data-driven reflectance model"). θ_h is
sampled by the square root of its share of a right angle. Negative entries mark angles without data; they count as 0.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from btfref.formats.reading import Reader
from btfref.formats.source import Format, Source
from btfref.numerics.sphere.directions import DirectionSet, directions
from btfref.types import PathLike

if TYPE_CHECKING:
    from btfref.formats.image_sets.files import Candidate

SCALE = np.array([1.0, 1.15, 1.66]) / 1500

_LARGEST = 4096


def recognises(candidate: Candidate) -> bool:
    """Whether the counts in front explain the size of the file."""
    if len(candidate.head) < 12:
        return False
    counts = struct.unpack_from("<3i", candidate.head)
    return all(0 < n <= _LARGEST for n in counts) and (
        candidate.path.suffix == ".binary" or 12 + 24 * counts[0] * counts[1] * counts[2] == candidate.size
    )


def open_merl(
    path: PathLike,
    *,
    views: str | DirectionSet | ArrayLike = "ubo81",
    lights: str | DirectionSet | ArrayLike = "ubo81",
) -> Source:
    """Open a BRDF file.

    Parameters
    ----------
    path : path-like
    views, lights : str, DirectionSet or array_like (n, 3)
        Directions of the BTF; see `btfref.numerics.sphere.directions.directions`.

    Returns
    -------
    Source
        Of one texel. Values are those of the cell that a pair falls into, as MERL's own reader takes them.
    """
    reader = Reader(path)
    counts = [reader.number("i32", name, 1, _LARGEST) for name in ("theta_h", "theta_d", "phi_d")]
    table = reader.array("values", "<f8", (3, *counts))
    if reader.offset != reader.size:
        reader.fail("more bytes than the counts explain", "end", got=reader.size, expected=reader.offset)
    views, lights = directions(views), directions(lights)

    def colours(view: int, first: int, last: int) -> np.ndarray:
        index = cell(lights.vectors[first:last], views.vectors[view], counts)
        with np.errstate(over="ignore"):
            f = (np.maximum(table[:, *index], 0) * SCALE[:, None]).astype(np.float32)
        return f.T[:, None, None, :]

    return Source(
        path=reader.path,
        format="merl",
        views=views,
        lights=lights,
        texels=(1, 1),
        colours=colours,
        cosine_included=False,
        facts={"table": counts, "file_bytes": reader.size},
        fingerprint=reader.digest,
    )


def cell(
    w_light: ArrayLike, w_view: ArrayLike, counts: Sequence[int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cell of the table for pairs of directions.

    Parameters
    ----------
    w_light, w_view : ndarray, shape (..., 3)
        Broadcast together.
    counts : sequence of int
        θ_h, θ_d, φ_d.

    Returns
    -------
    tuple of three int arrays

    Notes
    -----
    Rusinkiewicz 1998, "A new change of variables for efficient BRDF representation": the half vector is turned to
    the normal (by −φ_h about z, then −θ_h about y); what the light then is gives θ_d and φ_d, which repeats after
    half a turn by reciprocity.
    """
    light, view = np.broadcast_arrays(np.asarray(w_light, float), np.asarray(w_view, float))
    half = light + view
    length = np.linalg.norm(half, axis=-1, keepdims=True)
    half = np.where(length > 1e-9, half / np.maximum(length, 1e-9), [0.0, 0.0, 1.0])
    sine = np.hypot(half[..., 0], half[..., 1])
    theta_h = np.arctan2(sine, half[..., 2])
    at_pole = sine < 1e-12
    c, s = (np.where(at_pole, 1 - k, half[..., k] / np.maximum(sine, 1e-12)) for k in (0, 1))
    x, y = c * light[..., 0] + s * light[..., 1], c * light[..., 1] - s * light[..., 0]
    x, z = half[..., 2] * x - sine * light[..., 2], sine * x + half[..., 2] * light[..., 2]
    theta_d, phi_d = np.arctan2(np.hypot(x, y), z), np.mod(np.arctan2(y, x), np.pi)
    shares = np.sqrt(theta_h / (np.pi / 2)), theta_d / (np.pi / 2), phi_d / np.pi
    return tuple(
        np.clip((share * n).astype(np.int64), 0, n - 1) for share, n in zip(shares, counts, strict=True)
    )


FORMAT = Format(
    "merl",
    "MERL BRDFs, as BTFs of one texel",
    recognises,
    open_merl,
    options=frozenset({"views", "lights"}),
)
