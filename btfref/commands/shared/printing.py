"""What the commands print: lines, JSON, tables, numbers, a progress bar."""

from __future__ import annotations

import json
import re
import sys
import tempfile
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from btfref.commands.shared.stdout import stdout
from btfref.errors import BtfrefError

if TYPE_CHECKING:
    from btfref.gates import GateResult
    from btfref.representations.protocol import Representation
    from btfref.types import Facts


#: Characters that a terminal obeys instead of showing: controls but for the line's end and the tab, marks that turn
#: the direction of what follows.
_CONTROLS = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")


def printable(text: str) -> str:
    """Text whose control characters are written out as escapes: names and attributes come from files."""
    return _CONTROLS.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def emit(text: str = "", *, flush: bool = False, coloured: bool = False) -> None:
    """Write lines to standard output.

    Parameters
    ----------
    text : str
    flush : bool
        Before work that takes long or writes by itself.
    coloured : bool
        Whether the text has colours of ours; its parts then went through `printable`.
    """
    stdout().write(f"{text if coloured else printable(text)}\n")
    if flush:
        stdout().flush()


def emit_json(data: object) -> None:
    """Write `data` to standard output as indented JSON."""
    utf8 = (getattr(stdout(), "encoding", None) or "utf-8").lower().replace("-", "") == "utf8"
    text = json.dumps(data, indent=2, ensure_ascii=not utf8, default=_plain)
    # Controls that JSON leaves as they are stand in strings alone.
    emit(_CONTROLS.sub(lambda found: f"\\u{ord(found[0]):04x}" if found[0] != "\r" else found[0], text))


def say_area_lights(meta: Facts) -> None:
    """Write how many points stand for the area lights of a picture, if any, from its ``meta``."""
    if "area_light_points" in meta:
        points, error = meta["area_light_points"], meta["area_light_error"]
        emit(f"area lights: {points} points, estimated error {100 * error:.2g} %")


def _plain(value: Any) -> object:
    """NumPy scalars and arrays and paths as what JSON knows."""
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"cannot write {type(value).__name__} as JSON")


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
        """Show that `done` of `total` are done; see `btfref.types.Progress`."""
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


def absent_line(name: str) -> str:
    """Why an evaluator took no part."""
    return f"not run: {name}; this machine lacks what it needs (btfref doctor)"


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


def write_representation(representation: Representation, out: Path, *, json: bool) -> None:
    """Write a representation's file and say what is in it, as one line or as JSON."""
    from btfref.representations.file.container import read_info, save

    try:
        save(representation, out)
    except OSError as error:
        place = _elsewhere(representation, out)
        if place is None:
            raise
        raise BtfrefError(
            f"{out}: {error.strerror}; what was made is in {place}, move it from there"
        ) from error
    info = read_info(out)
    if json:
        emit_json(info)
    else:
        emit(f"{out}: {info['method']}, maps {bytes_text(info['payload_bytes'])}, 1:{info['ratio']:.3g}")


def _elsewhere(representation: Representation, out: Path) -> Path | None:
    """Where a representation was written that its own place would not take: it may have taken hours to make."""
    from btfref.representations.file.container import save

    for folder in (Path(tempfile.gettempdir()), Path.cwd(), Path.home()):
        if folder.resolve() == out.absolute().parent.resolve():
            continue
        with suppress(OSError, BtfrefError):
            place = Path(tempfile.mkdtemp(prefix="btfref-", dir=folder))
            try:
                save(representation, place / out.name)
            except BaseException:
                place.rmdir()
                raise
            return place / out.name
    return None


#: What :func:`gate_cells` gives, as the head of a table.
GATE_HEADER = ("gate", "pixels", "measure", "value", "limit", "")


def gate_cells(gate: GateResult) -> list[str]:
    """A gate's result as cells of a table: what it judges, of which class of pixels, the limit and the verdict."""
    from btfref.gates.verdicts import limit_name

    verdict = "pass" if gate.passed else "FAIL" if gate.outcome == "fail" else gate.outcome.upper()
    limit = f"{gate.sign} {gate.limit:g}"
    return [gate.gate, gate.pixels or "–", limit_name(gate.entry), number(gate.value), limit, verdict]


def bytes_text(n: float) -> str:
    """A number of bytes for a reader: ``1.9 MiB (2 012 345 bytes)``."""
    amount, unit = float(n), "bytes"
    for unit in ("bytes", "KiB", "MiB", "GiB", "TiB"):
        if amount < 1024 or unit == "TiB":
            break
        amount /= 1024
    exact = f"{int(n):,} bytes".replace(",", " ")
    return exact if unit == "bytes" else f"{amount:.3g} {unit} ({exact})"
