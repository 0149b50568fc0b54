"""Say what a representation, a sampled or measured BTF or an image holds, from its headers only.

With --plot a picture of a sampled BTF: view × light contact sheet, one texel's apparent BRDF, albedo, noise.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from btfref.commands.shared.options import add_json, add_overwrite
from btfref.commands.shared.printing import bytes_text, emit, emit_json
from btfref.commands.shared.reading import output_file, ranges
from btfref.errors import InputError
from btfref.types import Facts, PathLike

#: Longer lists are counted; --json has them all.
MOST_LISTED = 16

_BYTES = (
    *("payload_bytes", "file_bytes", "raw_bytes", "eigen_bytes", "weight_bytes"),
    *("float_bytes", "half_bytes", "code_bytes", "published_bytes"),
)

#: Arguments that are written, and as what: :func:`btfref.commands.shared.paths.check_paths`.
OUTPUTS = {"plot": "picture"}


def add_arguments(parser: ArgumentParser) -> None:
    """Describe the command's arguments."""
    parser.add_argument(
        "file",
        metavar="FILE",
        help="representation (.exr), sampled BTF (.btf.zarr), queries, measured BTF, or image",
    )
    add_json(parser, "the facts")
    add_overwrite(parser)
    parser.add_argument("--plot", metavar="OUT.png", help="draw a sampled BTF")
    parser.add_argument(
        "--texel",
        type=ranges,
        metavar="ROW,COLUMN",
        help="whose apparent BRDF is drawn (default: the middle)",
    )


def run(args: Namespace) -> int:
    """Carry the command out."""
    plot = output_file(args.plot, ".png") if args.plot else None
    if args.texel is not None and (plot is None or len(args.texel) != 2):
        raise InputError(
            "texel of a plot", field="--texel", got=args.texel, expected="ROW,COLUMN with --plot"
        )
    facts = read(args.file)
    if plot is not None:
        if facts["kind"] != "sampled-btf":
            raise InputError("only sampled BTFs are drawn", file=args.file, field="--plot", got=facts["kind"])
        from btfref.report.btf_plot import plot_btf

        plot_btf(args.file, plot, texel=args.texel)
    if args.json:
        emit_json(facts)
    else:
        for line in lines(facts):
            emit(line)
    return 0


def read(path: PathLike) -> Facts:
    """Facts about a file, whatever its kind.

    Returns
    -------
    dict
        With ``kind``: "representation", "sampled-btf", "measured-btf", "image", or "foreign" for a file of others that
        is known and not read: ``what`` it is and what serves ``instead``.

    Raises
    ------
    InputError
        When the file is missing or none of these.
    """
    path = Path(path)
    if path.is_dir():
        from btfref.commands.shared.paths import kind_of
        from btfref.sampling import open_store

        if kind_of(path) == "queries":
            from btfref.querying import open_queries

            return open_queries(path).facts()
        store = (path / "zarr.json").exists() or path.name.endswith(".zarr")
        if not store and (found := _measured(path) or _foreign(path)):
            return found
        return open_store(path).info()
    if path.suffix.lower() == ".png":
        return _png(path)
    if path.suffix.lower() == ".exr" and _plain_exr(path):
        return _exr(path)
    if path.is_file() and path.suffix.lower() != ".exr" and (found := _measured(path) or _foreign(path)):
        return found
    from btfref.representations.file.container import read_info

    return read_info(path)


def _measured(path: Path) -> Facts | None:
    """Facts about a measured BTF in a format of others, or None when it is none; missing images are counted."""
    from btfref.formats import format_named, identify, open_source

    if path.is_file() and path.stat().st_size == 0:
        return None
    name = identify(path)
    if name is None:
        return None
    missing = {"allow_missing": True} if "allow_missing" in format_named(name).options else {}
    return open_source(path, format=name, **missing).info()


def _foreign(path: Path) -> Facts | None:
    """What a file or folder is that btfref does not read, and what to do; None when nobody knows it."""
    from btfref.formats.foreign import foreign

    if path.is_file() and path.stat().st_size == 0:
        return None
    found = foreign(path)
    if found is None or (path.is_dir() and found.name in ("empty", "files")):  # any folder is that
        return None
    if path.is_dir() and found.name != "maps":
        raise InputError(
            f"no store, and not a BTF of a known format: {found.what}", file=path, expected=found.cure
        )
    return {"kind": "foreign", "format": found.name, "what": found.what, "instead": found.cure}


def _headers(path: Path) -> list[Facts] | None:
    """Headers of an OpenEXR file, or None when it cannot be read as one."""
    if not path.is_file() or path.stat().st_size == 0:
        return None
    from btfref.images.openexr import opened

    try:
        with opened(path, header_only=True) as file:
            return [dict(part.header) for part in file.parts]  # closing the file empties them
    except (RuntimeError, ValueError, OSError):
        return None


def _plain_exr(path: Path) -> bool:
    """Whether this is an OpenEXR image rather than a representation; broken files count as the latter."""
    from btfref.representations.file.manifest import ATTRIBUTE

    headers = _headers(path)
    return headers is not None and ATTRIBUTE not in headers[0]


def _exr(path: Path) -> Facts:
    from btfref.rendering.picture import read_picture_facts

    headers = _headers(path) or []
    shown = read_picture_facts(path)
    low, high = (corner.tolist() for corner in headers[0]["dataWindow"])
    return {
        "kind": "image",
        "size": [high[0] - low[0] + 1, high[1] - low[1] + 1],
        "channels": [channel.name for channel in headers[0]["channels"]],
        "parts": len(headers),
        "file_bytes": path.stat().st_size,
        **({"picture": shown} if shown else {}),
    }


def _png(path: Path) -> Facts:
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path) as image:
            size, channels = list(image.size), list(image.getbands())
    except (FileNotFoundError, IsADirectoryError):
        raise InputError("no such file", file=path) from None
    except (UnidentifiedImageError, OSError, SyntaxError):
        raise InputError("not a PNG image", file=path) from None
    return {"kind": "image", "size": size, "channels": channels, "file_bytes": path.stat().st_size}


def lines(facts: Facts, indent: str = "") -> Iterator[str]:
    """Facts as aligned ``key  value`` lines; nested ones are indented."""
    width = max(len(key) for key in facts)
    for key, fact in facts.items():
        if key == "attributes":  # what matters of them stands above; --json has them all
            continue
        if isinstance(fact, dict) and fact and not _short(fact):
            yield f"{indent}{key}"
            yield from lines(fact, indent + "  ")
        else:
            yield f"{indent}{key:<{width}}  {_text(key, fact)}"


def _short(fact: Facts) -> bool:
    """Whether a nested fact (a map, a direction set) fits one line."""
    return set(fact) in ({"dtype", "shape", "bytes"}, {"name", "count"})


def _text(key: str, fact: Any) -> str:
    if isinstance(fact, dict) and fact and not _short(fact):
        return ", ".join(f"{name} {_text('', entry)}" for name, entry in fact.items())
    if isinstance(fact, dict) and fact:
        shape = fact.get("shape")
        size = f", {bytes_text(fact['bytes'])}" if shape else ""
        return (
            f"{fact['dtype']}  {_text('shape', shape)}{size}"
            if shape
            else f"{fact['name']} ({fact['count']})"
        )
    if key in _BYTES and fact is not None:
        return bytes_text(fact)
    if key == "ratio" and fact is not None:
        return f"1:{fact:.4g}"
    if key in ("shape", "size") and isinstance(fact, list | tuple):
        return " × ".join(map(str, fact))
    if isinstance(fact, list | tuple):
        if any(isinstance(entry, dict | list) for entry in fact):
            return "; ".join(_text("", entry) for entry in fact)
        if len(fact) > MOST_LISTED:
            return f"{len(fact)} values"
        return ", ".join(map(str, fact)) or "none"
    return "–" if fact is None or fact == {} else str(fact)
