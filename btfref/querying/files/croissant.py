"""Metadata of a set of queries in MLCommons Croissant 1.1 (JSON-LD), beside its file."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import TYPE_CHECKING

from btfref.outputs import new_file
from btfref.provenance import __version__
from btfref.querying.files.plain import parquet_columns
from btfref.querying.files.zarr_file import COLUMNS

if TYPE_CHECKING:
    from btfref.querying.files.zarr_file import QueryFile
    from btfref.types import Facts

#: What stands behind the file's name.
ENDING = ".croissant.json"

#: MIME types by ending.
TYPES = {
    ".h5": "application/x-hdf5",
    ".hdf5": "application/x-hdf5",
    ".npz": "application/x-npz",
    ".parquet": "application/x-parquet",
}

#: Terms of the format, as its specification wants them in every file.
CONTEXT: Facts = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "citeAs": "cr:citeAs",
    "column": "cr:column",
    "conformsTo": "dct:conformsTo",
    "cr": "http://mlcommons.org/croissant/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "equivalentProperty": "cr:equivalentProperty",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "extract": "cr:extract",
    "field": "cr:field",
    "fileObject": "cr:fileObject",
    "fileProperty": "cr:fileProperty",
    "fileSet": "cr:fileSet",
    "format": "cr:format",
    "includes": "cr:includes",
    "isLiveDataset": "cr:isLiveDataset",
    "jsonPath": "cr:jsonPath",
    "key": "cr:key",
    "md5": "cr:md5",
    "parentField": "cr:parentField",
    "path": "cr:path",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "recordSet": "cr:recordSet",
    "references": "cr:references",
    "regex": "cr:regex",
    "repeated": "cr:repeated",
    "replace": "cr:replace",
    "samplingRate": "cr:samplingRate",
    "sc": "https://schema.org/",
    "separator": "cr:separator",
    "source": "cr:source",
    "subField": "cr:subField",
    "transform": "cr:transform",
}

#: What the numbers of a row are.
MEANING = {
    "uv": "place on the tile, [0, 1)",
    "radius": "radius of the footprint, tiles; 0 is a point",
    "w_light": "unit vector to the light, local frame",
    "w_view": "unit vector to the viewer, local frame",
    "density": "density of the laws that the row was drawn from",
    "B": "f cos(theta_light) in 1/sr, linear Rec. 709, mean over the footprint",
    "variance": "variance of that mean",
    "samples": "samples that the mean is of",
}


def write_croissant(queries: QueryFile, path: Path) -> Path:
    """Describe a finished file of queries.

    Parameters
    ----------
    queries : QueryFile
        Its rows.
    path : Path
        The file, of any kind.

    Returns
    -------
    Path
        ``path`` with `ENDING`.
    """
    out = path.with_name(path.name + ENDING)
    with new_file(out) as draft:
        draft.write_text(json.dumps(described(queries, path), indent=1) + "\n", "utf-8")
    return out


def described(queries: QueryFile, path: Path) -> Facts:
    """The metadata as a dict."""
    source, settings = queries.attributes["source"], queries.attributes["settings"]
    name = source.get("name") or source.get("method")
    laws = settings["laws"]
    text = (
        f"{queries.n} queries of B = f cos(theta_light) of {name}: light {laws['light']}, view {laws['view']}, "
        f"radius {laws['radius']} ({settings['footprint']} footprint), {settings['spp']} samples at most, "
        f"seed {settings['seed']}."
    )
    data: Facts = {
        "@context": CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.1",
        "name": path.name,
        "description": text,
        "version": "1.0.0",
        "isLiveDataset": False,
        "creator": {"@type": "sc:Organization", "name": f"btfref {__version__}"},
        "distribution": _distribution(path),
    }
    if path.suffix == ".parquet":
        # Other formats are no tables that the format can point into.
        data["recordSet"] = [
            {
                "@type": "cr:RecordSet",
                "@id": "rows",
                "name": "rows",
                "field": [
                    {
                        "@type": "cr:Field",
                        "@id": f"rows/{label}",
                        "name": label,
                        "description": MEANING[column],
                        "dataType": "sc:Float" if COLUMNS[column][1] == "float32" else "sc:Integer",
                        "source": {"fileObject": {"@id": path.name}, "extract": {"column": label}},
                    }
                    for label, column, _ in parquet_columns()
                ],
            }
        ]
    else:
        data["variableMeasured"] = [f"{column}: {meaning}" for column, meaning in MEANING.items()]
    return data


def _distribution(path: Path) -> list[Facts]:
    """The file, or the files of a folder."""
    if path.is_dir():
        files = sorted(p for p in path.rglob("*") if p.is_file())
        size = sum(p.stat().st_size for p in files)
        folder: Facts = {
            "@type": "cr:FileSet",
            "@id": path.name,
            "name": path.name,
            "description": f"{len(files)} files, {size} bytes; SHA-256 of names and bytes: {_sha256(files, path)}",
            "encodingFormat": "application/vnd.zarr",
            "includes": f"{path.name}/**",
        }
        return [folder]
    return [
        {
            "@type": "cr:FileObject",
            "@id": path.name,
            "name": path.name,
            "contentUrl": path.name,
            "contentSize": f"{path.stat().st_size} B",
            "encodingFormat": TYPES[path.suffix],
            "sha256": _sha256([path], None),
        }
    ]


def _sha256(files: list[Path], below: Path | None) -> str:
    """Of a file's bytes; of a folder, of its files' names and bytes in their order."""
    state = hashlib.sha256()
    for file in files:
        if below is not None:
            state.update(file.relative_to(below).as_posix().encode())
        with file.open("rb") as stream:
            while block := stream.read(1 << 20):
                state.update(block)
    return state.hexdigest()
