"""What several commands share: reading arguments, progress bars, printing."""

from __future__ import annotations

import json
import re
import sys
from argparse import ArgumentTypeError
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from btfref.errors import InputError
from btfref.types import PathLike

if TYPE_CHECKING:
    import numpy as np


def emit(text: str = "", *, flush: bool = False) -> None:
    """Write one line to standard output; `flush` before work that takes long or writes by itself."""
    sys.stdout.write(f"{text}\n")
    if flush:
        sys.stdout.flush()


def emit_json(data: object) -> None:
    """Write `data` to standard output as indented JSON."""
    emit(json.dumps(data, indent=2, ensure_ascii=False, default=_plain))


def _plain(value: Any) -> object:
    """NumPy scalars and arrays and paths as what JSON knows."""
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"cannot write {type(value).__name__} as JSON")


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
    if not (width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise ArgumentTypeError(f"got {text!r}, expected WxH in pixels, e.g. 640x480")
    return int(width), int(height)


def count(minimum: int = 1) -> Callable[[str], int]:
    """A reader of integers of at least `minimum`, for argparse's ``type=``."""

    def read(text: str) -> int:
        try:
            number: int | None = int(text)
        except ValueError:
            number = None
        if number is None or number < minimum:
            raise ArgumentTypeError(f"got {text!r}, expected an integer ≥ {minimum}")
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
            raise ArgumentTypeError(f"got {text!r}, expected numbers and ranges such as 0,3,10-12")
        found.extend(range(int(first), int(last if dash else first) + 1))
    return tuple(found)


def memory_size(text: str) -> int:
    """An amount of memory such as ``2G``, ``800MiB`` in bytes, for argparse's ``type=``."""
    found = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([kMGT]?)(?:i?B)?", text)
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
    return path


class Progress:
    """A progress bar on standard error that appears once the work has taken two seconds.

    Call it as ``progress(done, total, label)``; use it as a context manager so that the bar ends cleanly.
    """

    #: Seconds before a bar is worth showing.
    delay = 2.0

    def __init__(self) -> None:
        self._bar: Any = None  # tqdm, which carries no types

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def __call__(self, done: int, total: int, label: str = "") -> None:
        from tqdm import tqdm

        if self._bar is None or self._bar.desc != f"{label}: " or self._bar.total != total:
            if self._bar is not None:
                self._bar.close()
            # disable=None: no bar where nobody looks (standard error is a file or a pipe).
            self._bar = tqdm(
                desc=label, total=total, delay=self.delay, leave=False, disable=None, file=sys.stderr
            )
            self._bar.desc = f"{label}: "
        self._bar.update(done - self._bar.n)


def table(rows: Iterable[Iterable[object]], *, header: Iterable[object] | None = None) -> list[str]:
    """Rows of cells as aligned lines; numbers to the right, text to the left."""
    body = [[str(cell) for cell in row] for row in rows]
    every = [*([[str(cell) for cell in header]] if header else []), *body]
    if not every:
        return []
    widths = [max(len(row[column]) for row in every) for column in range(len(every[0]))]
    right = [all(_numeric(row[column]) for row in body) for column in range(len(every[0]))]
    lines = [
        "  ".join(
            cell.rjust(width) if flag else cell.ljust(width)
            for cell, width, flag in zip(row, widths, right, strict=True)
        ).rstrip()
        for row in every
    ]
    if header:
        lines.insert(1, "  ".join("─" * width for width in widths))
    return lines


def _numeric(text: str) -> bool:
    return not text or text[0].isdigit() or text[0] in "-+–.∞"


def number(value: float | str | None) -> str:
    """A metric for a reader: four significant digits, a dash for none."""
    if value is None:
        return "–"
    if isinstance(value, bool | str):
        return str(value)
    return f"{value:.4g}"


def bytes_text(n: float) -> str:
    """A number of bytes for a reader: ``1.9 MiB (2 012 345 bytes)``."""
    amount, unit = float(n), "bytes"
    for unit in ("bytes", "KiB", "MiB", "GiB", "TiB"):
        if amount < 1024 or unit == "TiB":
            break
        amount /= 1024
    exact = f"{int(n):,} bytes".replace(",", " ")
    return exact if unit == "bytes" else f"{amount:.3g} {unit} ({exact})"
