"""Checks of parameters that several mesostructures share."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from btfref.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


def number(owner: str, name: str, value: float, low: float, high: float) -> float:
    """A finite number within limits.

    Parameters
    ----------
    owner : str
        Name of the mesostructure, for the message.
    name : str
        Name of the parameter.
    value : float
    low, high : float
        Smallest and largest allowed value.

    Returns
    -------
    float

    Raises
    ------
    InputError
        Not a number, or outside the limits.
    """
    if isinstance(value, bool) or not np.isfinite(value) or not low <= value <= high:
        raise InputError(
            f"parameter of {owner}", field=name, got=value, expected=f"a number in [{low}, {high}]"
        )
    return float(value)


def whole(owner: str, name: str, value: float, low: int, high: int, multiple: int = 1) -> int:
    """A whole number within limits, a multiple of another; arguments and errors as of `number`.

    Returns
    -------
    int
    """
    if isinstance(value, bool) or value != int(value) or not low <= value <= high or value % multiple:
        kind = "a whole number" if multiple == 1 else f"a multiple of {multiple}"
        raise InputError(
            f"parameter of {owner}", field=name, got=value, expected=f"{kind} in [{low}, {high}]"
        )
    return int(value)


def colour(owner: str, name: str, value: ArrayLike) -> list[float]:
    """Three reflectances in [0, 1], linear RGB; arguments and errors as of `number`.

    Returns
    -------
    list of float
    """
    values = np.asarray(value, dtype=np.float64)
    if values.shape != (3,) or not ((values >= 0) & (values <= 1)).all():
        raise InputError(f"parameter of {owner}", field=name, got=value, expected="3 values in [0, 1]")
    return values.tolist()


def sweep_faces(n_along: int, n_around: int) -> np.ndarray:
    """Triangles of a tube whose vertices are numbered ``along · n_around + around``; closed around only.

    Parameters
    ----------
    n_along : int
        Rings of vertices.
    n_around : int
        Vertices of one ring.

    Returns
    -------
    ndarray, shape (2 (n_along − 1) n_around, 3), int64
        Counter-clockwise seen from outside where along × around points outward.
    """
    along, around = (index.ravel() for index in np.mgrid[0 : n_along - 1, 0:n_around])
    here, beside = along * n_around + around, along * n_around + (around + 1) % n_around
    ahead, across = here + n_around, beside + n_around
    return np.concatenate([np.stack([here, ahead, across], 1), np.stack([here, across, beside], 1)])


def grid_faces(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of a grid of quads whose vertices are numbered ``row · (columns + 1) + column``.

    The diagonals alternate: a fixed one would give slopes a handedness.

    Parameters
    ----------
    rows, columns : int
        Quads.

    Returns
    -------
    first, second : ndarray, shape (rows · columns, 3), int64
        Two triangles of each quad, counter-clockwise where rows go along y and columns along x.
    """
    row, column = (index.ravel() for index in np.mgrid[0:rows, 0:columns])
    corner = row * (columns + 1) + column
    turned = ((row + column) % 2 == 1)[:, None]
    quad = np.stack([corner, corner + 1, corner + columns + 2, corner + columns + 1], axis=1)
    first = np.where(turned, quad[:, [0, 1, 3]], quad[:, [0, 1, 2]])
    second = np.where(turned, quad[:, [1, 2, 3]], quad[:, [0, 2, 3]])
    return first, second
