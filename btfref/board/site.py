"""The board as a static page: one HTML file with its numbers, and pictures beside it."""

from __future__ import annotations

import json
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

from btfref.board.ranking import ranked
from btfref.board.rows import read_rows
from btfref.board.scoring import Truth, scored
from btfref.datasets import sets
from btfref.errors import InputError, Limit
from btfref.outputs import new_file
from btfref.provenance import __version__

if TYPE_CHECKING:
    from collections.abc import Iterable

    from btfref.board.rows import Row
    from btfref.types import Facts, PathLike, Progress

#: Bytes of a site.
LARGEST = Limit(5_000_000, "the page is read by mail and telephone; leave pictures out")

#: Errors of the page, and what they are.
METRICS = {
    "nrmse": "RMSE over the true values' root mean square",
    "rmse": "RMSE, 1/sr",
    "mae": "mean absolute error, 1/sr",
    "delta_e00": "ΔE00, root mean square",
    "psnr_log": "PSNR of log(1 + B), dB",
}

#: Significant digits of a number on the page.
_DIGITS = 4


def write_site(
    results: Iterable[PathLike], out: PathLike, *, folder: PathLike, progress: Progress | None = None
) -> Facts:
    """Judge rows and write the page.

    Parameters
    ----------
    results : iterable of path-like
        Files ``*.row.json`` and folders of them.
    out : path-like
        Folder of the site; an older page in it is replaced.
    folder : path-like
        Of the set's packages, which hold the true values.
    progress : callable, optional

    Returns
    -------
    dict
        ``file``, ``rows``, ``materials``, ``bytes``, and ``board``: what the page holds.

    Raises
    ------
    InputError
        Rows that cannot be judged, or of several sets or tiers; a site of more than 5 MB.
    """
    rows = read_rows(results)
    kinds = {tuple(row.facts[name] for name in ("set", "set_version", "tier")) for row in rows}
    if len(kinds) != 1:
        said = ", ".join(sorted(" ".join(kind) for kind in kinds))
        raise InputError("rows of several sets or tiers", field="RESULTS", got=said, expected="one")
    truth = Truth(folder)
    board = described(rows, scored(rows, truth, progress), truth)
    out = Path(out)
    pictures = _pictures(rows, board["materials"], truth)
    page = _page(board).encode()
    size = len(page) + sum(path.stat().st_size for path in pictures.values())
    if size > LARGEST.most:
        raise InputError("a site too large", file=out, got=f"{size} bytes", expected=LARGEST)
    (out / "pictures").mkdir(parents=True, exist_ok=True)
    for name, path in pictures.items():
        with new_file(out / name) as draft:
            draft.write_bytes(path.read_bytes())
    with new_file(out / "index.html") as draft:
        draft.write_bytes(page)
    return {
        "file": str(out / "index.html"),
        "rows": len(rows),
        "materials": len(board["materials"]),
        "bytes": size,
        "board": board,
    }


def described(rows: list[Row], errors: list[dict[str, Facts]], truth: Truth) -> Facts:
    """What the page shows, JSON types.

    Parameters
    ----------
    rows : list of Row
    errors : list of dict
        Of `btfref.board.scoring.scored`.
    truth : Truth
    """
    facts = rows[0].facts
    chosen, _ = sets.find(facts["set"])
    known = [one for one in chosen.materials if any(one.name in row.materials for row in rows)]
    places = {footprint: ranked(errors, footprint=footprint) for footprint in sets.FOOTPRINTS}
    lines = []
    for k, row in enumerate(rows):
        lines.append(
            {
                **row.facts,
                "name": row.name,
                "evaluate_ns": {name: _short(value) for name, value in row.evaluate_ns.items()},
                "rank": {footprint: _rounded(found[k]) for footprint, found in places.items()},
                "materials": {
                    name: {
                        "errors": {
                            footprint: {metric: _rounded(found[metric]) for metric in METRICS}
                            for footprint, found in errors[k][name].items()
                        },
                        **{
                            key: _short(value)
                            for key, value in entry.items()
                            if key not in ("answers", "picture")
                        },
                        **({"picture": f"pictures/{k}-{name}.png"} if "picture" in entry else {}),
                    }
                    for name, entry in row.materials.items()
                },
            }
        )
    return {
        "set": facts["set"],
        "set_version": facts["set_version"],
        "tier": facts["tier"],
        "suite": __version__,
        "metrics": METRICS,
        "footprints": list(sets.FOOTPRINTS),
        "materials": {one.name: _material(one, truth, facts["tier"], facts["set"]) for one in known},
        "rows": lines,
    }


def _material(material: sets.Material, truth: Truth, tier: str, name: str) -> Facts:
    manifest = truth.package(name, tier, material.name).manifest
    return {
        "family": material.kind,
        "difficulty": material.difficulty,
        "numbers": _rounded(manifest["difficulty"]),
        "noise": _rounded(manifest["noise"]),
        "picture": f"pictures/{material.name}.png",
    }


def _pictures(rows: list[Row], materials: Iterable[str], truth: Truth) -> dict[str, Path]:
    """Pictures of the site: name in it → file."""
    facts = rows[0].facts
    found = {
        f"pictures/{name}.png": truth.package(facts["set"], facts["tier"], name).path / "picture.png"
        for name in materials
    }
    for k, row in enumerate(rows):
        for name, entry in row.materials.items():
            if "picture" in entry:
                found[f"pictures/{k}-{name}.png"] = entry["picture"]
    return found


def _short(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")


def _rounded(value: object) -> object:
    if isinstance(value, dict):
        return {key: _rounded(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_rounded(entry) for entry in value]
    return _short(value) if isinstance(value, float) else value


def _page(board: Facts) -> str:
    folder = resources.files("btfref.board") / "assets"
    text = (folder / "board.html").read_text("utf-8")
    # Inside a script no text may close it.
    data = json.dumps(board, separators=(",", ":")).replace("<", "\\u003c")
    for slot, content in (
        ("{{css}}", (folder / "board.css").read_text("utf-8")),
        ("{{js}}", (folder / "board.js").read_text("utf-8")),
        ("{{data}}", data),
    ):
        text = text.replace(slot, content, 1)
    return text
