"""What is handed in: a JSON file for each method and setting, and answers to the test queries as NumPy files beside it.

======== ============================================================================================
field    what
======== ============================================================================================
kind     "btfref-board-row"; ``schema``: 1
method   name, and ``setting``: what tells its rows apart, such as "clusters 16"
set      such as "btf-1", and ``set_version``, ``tier``: what was answered
fitted   what it was fitted to: "grid 4x9", "training queries"
by       who hands it in; ``link``: where the method is described (both may be left out)
suite    version of btfref, where it is a method of the suite (may be left out)
materials for each, by name: ``answers``, a ``.npy`` file of (rows, 3) float32: B in 1/sr of all test queries, point,
         texel and wide footprints behind each other; and, where they are known, ``bytes``, ``fit_seconds``, ``energy``
         (largest share of light that is reflected), ``reciprocity`` (relative difference of swapped directions) and
         ``picture``, a ``.png`` file
evaluate_ns nanoseconds of an evaluation by evaluator (may be left out)
======== ============================================================================================
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from btfref.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from btfref.types import Facts, PathLike

KIND, SCHEMA = "btfref-board-row", 1

#: How files of rows end.
ENDING = ".row.json"

#: Text that every row has, and numbers that a material may have.
TEXTS = ("method", "setting", "set", "set_version", "tier", "fitted")
NUMBERS = ("bytes", "fit_seconds", "energy", "reciprocity")

#: Letters of a text, and rows of a board.
_LONGEST, _MOST = 200, 1000


@dataclass(frozen=True)
class Row:
    """A method with one setting.

    Attributes
    ----------
    path : Path
        Its file.
    facts : dict
        Texts by name: `TEXTS`, ``by``, ``link``, ``suite``.
    materials : dict
        By name: `NUMBERS` that are known, ``answers`` and ``picture`` as paths.
    evaluate_ns : dict of str to float
    """

    path: Path
    facts: dict[str, str]
    materials: dict[str, Facts]
    evaluate_ns: dict[str, float] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Method and setting."""
        return " · ".join(part for part in (self.facts["method"], self.facts["setting"]) if part)


def read_rows(paths: Iterable[PathLike]) -> list[Row]:
    """Rows of files, and of all files ``*.row.json`` in folders, sorted by their names.

    Raises
    ------
    InputError
        A file that is missing or no row; no rows at all; two rows of one name.
    """
    rows = [read_row(path) for path in _files(paths)]
    if not rows:
        raise InputError("no rows of a board there", field="RESULTS", expected=f"files *{ENDING}")
    if len(rows) > _MOST:
        raise InputError("more rows than a page can show", field="RESULTS", got=len(rows), expected=_MOST)
    seen: dict[tuple[str, ...], Path] = {}
    for row in rows:
        key = (*(row.facts[name] for name in TEXTS),)
        if key in seen:
            raise InputError(
                "two rows of one method and setting", file=row.path, field="method, setting", got=seen[key]
            )
        seen[key] = row.path
    return rows


def _files(paths: Iterable[PathLike]) -> Iterator[Path]:
    for path in map(Path, paths):
        if path.is_dir():
            yield from sorted(path.rglob(f"*{ENDING}"))
        elif path.is_file():
            yield path
        else:
            raise InputError("no such file", file=path)


def read_row(path: PathLike) -> Row:
    """A row; see the module.

    Raises
    ------
    InputError
        A field that is missing or cannot be used.
    """
    path = Path(path)
    try:
        found = json.loads(path.read_text("utf-8"))
    except UnicodeDecodeError:
        raise InputError("cannot be read", file=path, got="no UTF-8 text", expected="JSON") from None
    except (OSError, ValueError) as error:
        raise InputError("cannot be read", file=path, got=error, expected="JSON") from None
    if not isinstance(found, dict) or found.get("kind") != KIND:
        raise InputError("no row of a board", file=path, field="kind", expected=KIND)
    if found.get("schema") != SCHEMA:
        raise InputError(
            "schema that this version cannot read",
            file=path,
            field="schema",
            got=found.get("schema"),
            expected=SCHEMA,
        )
    facts = {name: _text(found, name, path) for name in TEXTS}
    facts |= {name: _text(found, name, path) for name in ("by", "link", "suite") if name in found}
    if not facts["method"]:
        raise InputError("a method without a name", file=path, field="method")
    if facts.get("link") and not facts["link"].startswith("https://"):
        raise InputError("not a link", file=path, field="link", got=facts["link"], expected="https://…")
    given = found.get("materials")
    if not isinstance(given, dict) or not given:
        raise InputError("a row without materials", file=path, field="materials")
    materials = {str(name): _material(str(name), entry, path) for name, entry in given.items()}
    times = found.get("evaluate_ns", {})
    if not isinstance(times, dict):
        raise InputError("no times", file=path, field="evaluate_ns", expected="names and numbers")
    return Row(
        path, facts, materials, {str(k)[:40]: _number(v, "evaluate_ns", path) for k, v in times.items()}
    )


def _text(found: Facts, name: str, path: Path) -> str:
    value = found.get(name)
    if not isinstance(value, str) or len(value) > _LONGEST:
        raise InputError(
            "not a text", file=path, field=name, got=str(value)[:40], expected=f"at most {_LONGEST} letters"
        )
    return value


def _number(value: Any, name: str, path: Path) -> float:
    usable = (
        isinstance(value, int | float) and not isinstance(value, bool) and np.isfinite(value) and value >= 0
    )
    if not usable:
        raise InputError("not a number", file=path, field=name, got=str(value)[:40], expected="at least 0")
    return float(value)


def _material(name: str, entry: Any, path: Path) -> Facts:
    if not isinstance(entry, dict):
        raise InputError("no entry of a material", file=path, field=f"materials.{name}")
    made: Facts = {
        key: _number(entry[key], f"materials.{name}.{key}", path)
        for key in NUMBERS
        if entry.get(key) is not None
    }
    made["answers"] = _beside(entry.get("answers"), f"materials.{name}.answers", ".npy", path)
    if entry.get("picture") is not None:
        made["picture"] = _beside(entry["picture"], f"materials.{name}.picture", ".png", path)
    return made


def _beside(value: Any, name: str, ending: str, path: Path) -> Path:
    """A file that lies with a row, and nowhere else."""
    if not isinstance(value, str) or not value.endswith(ending):
        raise InputError(
            "not the name of a file", file=path, field=name, got=str(value)[:40], expected=f"*{ending}"
        )
    found = path.parent / value
    if not found.resolve().is_relative_to(path.parent.resolve()):
        raise InputError(
            "a file that lies elsewhere", file=path, field=name, got=value, expected="one beside"
        )
    if not found.is_file():
        raise InputError("no such file", file=found, field=name)
    return found


def write_row(path: Path, facts: Facts) -> None:
    """Write a row's file; ``materials`` name their files relative to it."""
    from btfref.outputs import new_file

    with new_file(path) as draft:
        draft.write_text(json.dumps({**facts, "kind": KIND, "schema": SCHEMA}, indent=1) + "\n", "utf-8")
