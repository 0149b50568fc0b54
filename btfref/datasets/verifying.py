"""Whether packages are what their manifests say, what this version makes, and what was published.

Published are the digests of all files as one machine made them, in ``published/SET.json``. Another machine's processor
may round otherwise: then the means of the true values decide, within `dataset.published` of the tolerances.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from btfref.datasets import sets
from btfref.datasets.making import IDENTITY, differences, expected, place
from btfref.datasets.manifest import digest, files_of, read_manifest, sha256
from btfref.errors import InputError
from btfref.gates.tolerances import tolerance

if TYPE_CHECKING:
    from btfref.datasets.sets import DataSet, Material
    from btfref.types import Facts, PathLike, Progress


def verify(
    name: str, folder: PathLike, *, tier: str = "toy", progress: Progress | None = None
) -> list[Facts]:
    """Check packages.

    Parameters
    ----------
    name : str
        "MATERIAL", "SET/MATERIAL", or "all": those of the set that are there.
    folder : path-like
    tier : str
    progress : callable, optional

    Returns
    -------
    list of dict
        ``name``, ``passed``, ``problems``: a line each, and ``published``: "same bytes", "same values", "other values",
        or "not published".

    Raises
    ------
    InputError
        An unknown name or tier, or no package there.
    """
    chosen, materials = sets.find(name)
    chosen.tier(tier)
    if len(materials) > 1:
        materials = [one for one in materials if place(folder, chosen, tier, one).is_dir()]
        if not materials:
            raise InputError("no packages there", file=Path(folder) / chosen.name / tier)
    result = []
    for number, material in enumerate(materials):
        if progress is not None:
            progress(number, len(materials), f"verify {material.name}")
        where = place(folder, chosen, tier, material)
        if len(materials) == 1 and not where.is_dir():
            raise InputError("no such package", file=where)
        result.append(_verified(where, chosen, tier, material))
    return result


def problems_of(where: Path) -> list[str]:
    """What of a package is not as its manifest says: files missing, damaged or strange; a line each."""
    try:
        manifest = read_manifest(where)
    except InputError as error:
        return [str(error)]
    wanted, there = manifest["files"], files_of(where)
    lines = [f"{name}: missing" for name in wanted if name not in set(there)]
    lines += [f"{name}: not in the manifest" for name in there if name not in wanted]
    for name in there:
        if name in wanted and sha256(where / name) != wanted[name]["sha256"]:
            size = (where / name).stat().st_size
            lines.append(
                f"{name}: other bytes than the manifest says"
                if size == wanted[name]["bytes"]
                else f"{name}: {size} bytes, expected {wanted[name]['bytes']}"
            )
    if digest(wanted) != manifest.get("digest"):
        lines.append("manifest.json: its digest is not that of its files")
    return sorted(lines)


def _verified(where: Path, chosen: DataSet, tier: str, material: Material) -> Facts:
    from btfref.mesostructure import build

    problems = problems_of(where)
    notes: list[str] = []
    published = "not published"
    try:
        manifest = read_manifest(where)
    except InputError:
        manifest = None
    if manifest is not None:
        wanted = expected(chosen, tier, material, build(material.mesostructure, **material.parameters))
        differ = differences(wanted, manifest)
        problems += [
            f"another version: {key} is {_short(manifest.get(key))}, expected {_short(wanted[key])}"
            for key in differ
            if key in IDENTITY
        ]
        if "versions" in differ:
            notes += [
                f"made with {key} {manifest['versions'].get(key)}, here {value}"
                for key, value in wanted["versions"].items()
                if manifest.get("versions", {}).get(key) != value
            ]
        if not problems:
            published, wrong = against_published(manifest)
            problems += wrong
    return {
        "name": f"{chosen.name}/{material.name}",
        "tier": tier,
        "passed": not problems,
        "problems": problems,
        "notes": notes,
        "published": published,
    }


def _short(value: object) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}…"


def published_of(name: str) -> Facts:
    """What was published of a set: tier → material → ``digest``, ``means``, ``versions``."""
    path = Path(__file__).parent / "published" / f"{name}.json"
    return json.loads(path.read_text("utf-8")) if path.is_file() else {}


def against_published(manifest: Facts) -> tuple[str, list[str]]:
    """Which of bytes and values of a package are as published, and what is wrong."""
    known = published_of(manifest["set"]).get(manifest["tier"], {}).get(manifest["material"])
    if known is None:
        return "not published", []
    if known["digest"] == manifest["digest"]:
        return "same bytes", []
    limit = tolerance("dataset.published.relative")
    wrong = []
    for footprint, means in known["means"].items():
        ours, theirs = np.asarray(manifest["means"][footprint]), np.asarray(means)
        off = float(np.abs(ours - theirs).max() / theirs.max())
        if not off <= limit:
            wrong.append(
                f"means of the {footprint} queries are {off:.2g} off those published, above {limit:g}"
            )
    return ("other values" if wrong else "same values"), wrong
