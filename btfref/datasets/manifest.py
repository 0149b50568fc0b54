"""The manifest of a package: what it was made from, and the SHA-256 of every file; and its metadata in Croissant."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import TYPE_CHECKING

from btfref.errors import InputError
from btfref.outputs import new_file
from btfref.provenance import __version__

if TYPE_CHECKING:
    from btfref.datasets.sets import DataSet, Material
    from btfref.types import Facts

KIND, SCHEMA = "btfref-dataset", 1

#: Of the manifest, and of what stands in its place while a package is made.
MANIFEST, BEGUN = "manifest.json", "manifest.partial"

CROISSANT = "croissant.json"

LICENCE = "CC0-1.0"

STATEMENT = (
    "To the extent possible under law, the makers of this data have waived all copyright and related or "
    "neighbouring rights to it (CC0 1.0 Universal, https://creativecommons.org/publicdomain/zero/1.0/). It is "
    "computed from modelled geometry; nothing in it was measured, photographed or taken from others."
)

_BLOCK = 1 << 20


def sha256(path: Path) -> str:
    """Of a file's bytes."""
    state = hashlib.sha256()
    with path.open("rb") as stream:
        while block := stream.read(_BLOCK):
            state.update(block)
    return state.hexdigest()


def files_of(folder: Path) -> list[str]:
    """Names of a package's files, sorted; the manifest and what is not finished are none."""
    names = (path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    return sorted(name for name in names if name != MANIFEST and not name.endswith(".partial"))


def digest(files: Facts) -> str:
    """One number for all files of a manifest."""
    lines = (f"{name} {facts['sha256']}\n" for name, facts in sorted(files.items()))
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def write_manifest(folder: Path, facts: Facts) -> Facts:
    """Name all files of a finished package.

    Parameters
    ----------
    folder : Path
    facts : dict
        What it was made from.

    Returns
    -------
    dict
        The manifest.
    """
    files: Facts = {
        name: {"bytes": (folder / name).stat().st_size, "sha256": sha256(folder / name)}
        for name in files_of(folder)
    }
    found = {
        **facts,
        "bytes": sum(entry["bytes"] for entry in files.values()),
        "digest": digest(files),
        "files": files,
    }
    with new_file(folder / MANIFEST) as draft:
        draft.write_text(json.dumps(found, indent=1) + "\n", "utf-8")
    return found


def read_manifest(folder: Path) -> Facts:
    """A package's manifest.

    Raises
    ------
    InputError
        None there, or one that cannot be read.
    """
    path = folder / MANIFEST
    if not path.is_file():
        begun = (folder / BEGUN).exists()
        raise InputError(
            "a package that is not finished: start the same btfref dataset make again"
            if begun
            else "no package of a data set",
            file=folder,
            expected=MANIFEST,
        )
    try:
        found = json.loads(path.read_text("utf-8"))
        kind, schema, files = found["kind"], found["schema"], found["files"]
        sound = isinstance(files, dict) and all(
            bool(isinstance(entry["sha256"], str) and isinstance(entry["bytes"], int))
            for entry in files.values()
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError("manifest cannot be read", file=path, got=error) from None
    if kind != KIND or not sound:
        raise InputError("not the manifest of a data set", file=path, field="kind", got=kind, expected=KIND)
    if schema != SCHEMA:
        raise InputError(
            "schema that this version cannot read", file=path, field="schema", got=schema, expected=SCHEMA
        )
    return found


def write_croissant(folder: Path, chosen: DataSet, tier: str, material: Material) -> None:
    """Describe a package in Croissant 1.1: its single files each, its stores as sets of files.

    Parameters
    ----------
    folder : Path
    chosen : DataSet
    tier : str
    material : Material
    """
    from btfref.querying.files.croissant import CONTEXT

    distribution: list[Facts] = []
    for name in files_of(folder):
        store = next((part for part in Path(name).parts if part.endswith(".zarr")), None)
        if store is None and name != CROISSANT:
            distribution.append(
                {
                    "@type": "cr:FileObject",
                    "@id": name,
                    "name": name,
                    "contentUrl": name,
                    "contentSize": f"{(folder / name).stat().st_size} B",
                    "encodingFormat": TYPES.get(Path(name).suffix, "application/octet-stream"),
                    "sha256": sha256(folder / name),
                }
            )
        elif store is not None and name.endswith(f"{store}/zarr.json"):
            place = name.removesuffix("/zarr.json")
            distribution.append(
                {
                    "@type": "cr:FileSet",
                    "@id": place,
                    "name": place,
                    "description": "Zarr v3; SHA-256 of its files are in manifest.json",
                    "encodingFormat": "application/vnd.zarr",
                    "includes": f"{place}/**",
                }
            )
    data = {
        "@context": CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.1",
        "name": f"{chosen.name}-{tier}-{material.name}",
        "description": f"Synthetic BTF of {material.kind} with known truth. {material.difficulty}",
        "version": chosen.version,
        "license": "https://creativecommons.org/publicdomain/zero/1.0/",
        "isLiveDataset": False,
        "creator": {"@type": "sc:Organization", "name": f"btfref {__version__}"},
        "distribution": distribution,
    }
    with new_file(folder / CROISSANT) as draft:
        draft.write_text(json.dumps(data, indent=1) + "\n", "utf-8")


#: MIME types by ending.
TYPES = {
    ".json": "application/json",
    ".npy": "application/x-npy",
    ".ply": "application/x-ply",
    ".png": "image/png",
    ".txt": "text/plain",
}
