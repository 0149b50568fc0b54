"""Arguments as the commands read them: numbers, sizes, parameters, directions, names of outputs."""

from __future__ import annotations

import json
import os
import re
from argparse import ArgumentTypeError
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from btfref.errors import COUNT, INDICES, PIXELS, InputError, Limit
from btfref.types import PathLike

if TYPE_CHECKING:
    import numpy as np


def value(text: str) -> Any:
    """A parameter value as typed: what JSON reads (number, boolean, null, list), else the text itself."""
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        return text


def assignments(
    items: Iterable[str] | None, *, convert: Callable[[str], Any] = value, option: str = "--set"
) -> dict[str, Any]:
    """``key=value`` arguments as a dict.

    Raises
    ------
    InputError
        For an argument without ``=`` or without a key, and for a key given twice.
    """
    result = {}
    for item in items or ():
        key, equals, text = item.partition("=")
        if not equals or not key.isidentifier():
            raise InputError("cannot read a parameter", field=option, got=repr(item), expected="key=value")
        if key in result:
            raise InputError("parameter given twice", field=option, got=repr(item))
        result[key] = convert(text)
    return result


def size(text: str) -> tuple[int, int]:
    """``WxH`` as ``(width, height)`` in pixels, for argparse's ``type=``."""
    width, _, height = text.lower().partition("x")
    digits = [side.lstrip("0") for side in (width, height)]
    if not all(side.isascii() and side.isdecimal() for side in digits):
        raise ArgumentTypeError(f"got {text[:40]!r}, expected WxH in pixels, e.g. 640x480")
    if max(map(len, digits)) > len(str(PIXELS.most)) or int(digits[0]) * int(digits[1]) > PIXELS.most:
        raise ArgumentTypeError(f"got {text[:40]}, expected pixels of {PIXELS}")
    return int(width), int(height)


def count(minimum: int = 1, limit: Limit = COUNT) -> Callable[[str], int]:
    """A reader of integers of at least `minimum` and within a limit, for argparse's ``type=``."""

    def read(text: str) -> int:
        try:
            number: int | None = int(text)
        except ValueError:
            number = None
        if number is None or number < minimum:
            raise ArgumentTypeError(f"got {text[:40]!r}, expected an integer ≥ {minimum}")
        if number > limit.most:
            raise ArgumentTypeError(f"got {text[:40]}, expected {limit}")
        return number

    return read


def number_above(minimum: float) -> Callable[[str], float]:
    """A reader of finite numbers greater than `minimum`, for argparse's ``type=``."""

    def read(text: str) -> float:
        try:
            found: float | None = float(text)
        except ValueError:
            found = None
        if found is None or not minimum < found < float("inf"):
            raise ArgumentTypeError(f"got {text!r}, expected a number > {minimum}")
        return found

    return read


def ranges(text: str) -> tuple[int, ...]:
    """Whole numbers such as ``0,3,10-12`` as a tuple, for argparse's ``type=``."""
    found: list[int] = []
    for item in text.split(","):
        first, dash, last = item.partition("-")
        if not first.isdecimal() or (dash and not last.isdecimal()):
            raise ArgumentTypeError(f"got {text[:40]!r}, expected numbers and ranges such as 0,3,10-12")
        # Digits first: reading a number of thousands of them is refused by Python itself.
        if max(len(first), len(last)) > len(str(INDICES.most)) or int(last or first) > INDICES.most:
            raise ArgumentTypeError(f"got {item[:40]}, expected indices of {INDICES}")
        found.extend(range(int(first), int(last if dash else first) + 1))
        if len(found) > INDICES.most + 1:
            raise ArgumentTypeError(f"got more than {INDICES.most} numbers, expected {INDICES}")
    return tuple(found)


def memory_size(text: str) -> int:
    """An amount of memory such as ``2G``, ``800MiB`` in bytes, for argparse's ``type=``."""
    found = re.fullmatch(r"(\d{1,18}(?:\.\d{1,18})?)\s*([kMGT]?)(?:i?B)?", text, re.ASCII)
    if found is None or not float(found[1]):
        raise ArgumentTypeError(f"got {text!r}, expected an amount such as 800M or 2G")
    return int(float(found[1]) * 1024 ** " kMGT".index(found[2] or " "))


def numbers_or_file(text: str) -> float | tuple[float, ...] | str:
    """Numbers such as ``0.5`` or ``0.5,0.2,0.1`` (a float, a tuple), else the text itself, for argparse."""
    try:
        found = tuple(float(item) for item in text.split(","))
    except ValueError:
        return text
    return found[0] if len(found) == 1 else found


def direction_set(text: str) -> str | np.ndarray:
    """A direction set by name, or from a text file with one ``theta phi`` pair in degrees per line.

    Returns
    -------
    str or ndarray, shape (n, 3)
        What `btfref.numerics.sphere.directions.directions` takes.
    """
    if not text.endswith((".txt", ".csv")):
        return text
    if Path(text).exists() and not Path(text).is_file():
        raise InputError("cannot read directions", file=text, got="no file", expected="theta phi per line")
    import numpy as np

    try:
        rows = [
            line.partition("#")[0].replace(",", " ").split() for line in Path(text).read_text().splitlines()
        ]
        table = np.array([row for row in rows if row], float)
    except (OSError, ValueError, UnicodeDecodeError) as error:
        raise InputError(
            "cannot read directions", file=text, got=error, expected="theta phi per line"
        ) from None
    if table.ndim != 2 or table.shape[1] != 2 or not np.isfinite(table).all():
        raise InputError("cannot read directions", file=text, expected="two finite numbers per line, degrees")
    theta, phi = np.deg2rad(table.T)
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)


def output_file(text: PathLike, *suffixes: str) -> Path:
    """Path of an output, refused early when it cannot be written or has a suffix that no writer takes.

    Raises
    ------
    InputError
        For an unknown suffix, or a folder that does not exist.
    """
    path = Path(text)
    if suffixes and not path.name.endswith(suffixes):
        raise InputError(
            "cannot tell the file type", file=text, expected=f"a name ending in {' or '.join(suffixes)}"
        )
    if not path.parent.is_dir():
        raise InputError("cannot write there", file=text, got="no such folder")
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise InputError("cannot write there", file=text, got="a place that is read-only for you")
    return path
