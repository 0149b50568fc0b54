"""Names of files on a command line: what is read is never written, and what is written takes no other thing's place.

A command says in ``OUTPUTS`` which of its arguments are written and as what; every other argument that names an
existing file or folder is an input.
"""

from __future__ import annotations

import os
import re
import stat
from argparse import Namespace
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path

from btfref.errors import InputError

#: What an output is, for messages.
KINDS = {
    "representation": "a representation",
    "picture": "a picture",
    "page": "a report",
    "store": "a sampled BTF",
    "queries": "queries",
    "folder": "a folder",
    "file": "a file of another kind",
}

#: Arguments that are neither: folders that commands keep things in, results that a page is written beside.
_NEITHER = ("cache", "folders", "run")

#: References of a scene file to other files.
_FILENAMES = re.compile(rb"""\bvalue\s*=\s*["']([^"'$]{1,1000})["']""")

#: Bytes of a scene file that are searched.
_MOST = 1 << 22


def check_paths(args: Namespace, outputs: Mapping[str, str]) -> None:
    """Refuse an output that is an input, inside one, of another kind than what is there, or no file at all.

    Parameters
    ----------
    args : argparse.Namespace
    outputs : dict of str to str
        Arguments that are written, and as what: a key of :data:`KINDS`, "text", or "" for what its name tells.

    Raises
    ------
    InputError
        With the name, the argument and what it is.
    """
    written = {name: str(getattr(args, name)) for name in outputs if getattr(args, name, None) is not None}
    inputs = list(_inputs(args, written.keys()))
    for path in inputs:
        _refuse_pipe(path)
    for name, text in written.items():
        option = "-o" if name == "output" else f"--{name}"
        wanted = outputs[name] or _kind_by_name(text)
        _refuse_input(Path(text), option, inputs, store=wanted in ("store", "queries"))
        _refuse_other(Path(text), option, wanted, overwrite=getattr(args, "overwrite", False))
        if name == "output" and getattr(args, "png", False):
            _refuse_input(Path(text).with_suffix(".png"), "--png", inputs)
    names = list(written.values())
    if getattr(args, "png", False) and "output" in written:
        names.append(str(Path(written["output"]).with_suffix(".png")))
    if len({os.path.realpath(name) for name in names}) < len(names):
        raise InputError("two outputs have one name", field="-o", got=", ".join(names))


def _inputs(args: Namespace, written: Collection[str]) -> Iterator[Path]:
    """Existing files and folders that arguments name, and those that scene files among them name."""
    for name, value in vars(args).items():
        if name in _NEITHER or name in written:
            continue
        for text in _texts(value):
            for word in {text, text.partition("=")[2], *text.partition("=")[2].split(",")}:
                # Parameters of a scene name files beside it, too.
                for path in (Path(word), *(folder / word for folder in _scene_folders(args))):
                    if not word or not _exists(path):
                        continue
                    yield path
                    if path.suffix.lower() == ".xml":
                        yield from _of_scene(path)


def _scene_folders(args: Namespace) -> Iterator[Path]:
    """Folders of the scene files that a command reads."""
    for text in _texts([getattr(args, name, None) for name in ("scene", "scenes", "reference")]):
        if text.endswith(".xml"):
            yield Path(text).parent


def _texts(value: object) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, list | tuple):
        for one in value:
            yield from _texts(one)


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except (OSError, ValueError):  # longer than a name may be, or with a NUL
        return False


def _of_scene(path: Path) -> Iterator[Path]:
    if not path.is_file():
        return
    with path.open("rb") as stream:
        data = stream.read(_MOST)
    for match in _FILENAMES.finditer(data):
        name = match[1].decode("utf-8", "replace")
        for folder in (path.resolve().parent, Path.cwd()):
            if _exists(folder / name) and (folder / name).is_file():
                yield folder / name


def _refuse_pipe(path: Path) -> None:
    mode = path.stat().st_mode
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise InputError("a pipe or device, not a file", file=path)


def _refuse_input(path: Path, option: str, inputs: list[Path], *, store: bool = False) -> None:
    """InputError for an output that is an input by any name, lies in a store that is one, or holds one."""
    real = Path(os.path.realpath(path))
    above = [real, *real.parents]
    for one in inputs:
        if _exists(path) and os.path.samefile(path, one):
            raise InputError(
                "the output is an input", file=path, field=option, got=one, expected="another name"
            )
        if one.is_dir() and (one / "zarr.json").is_file() and Path(os.path.realpath(one)) in above:
            raise InputError(
                "the output lies in an input", file=path, field=option, got=one, expected="elsewhere"
            )
        if store and real in Path(os.path.realpath(one)).parents:
            raise InputError(
                "an input lies in the output", file=path, field=option, got=one, expected="elsewhere"
            )


def _refuse_other(path: Path, option: str, wanted: str, *, overwrite: bool) -> None:
    """InputError for an output in whose place another kind of thing stands."""
    if not _exists(path):
        return
    mode = path.stat().st_mode
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise InputError("a pipe or device, not a file", file=path, field=option)
    if stat.S_ISDIR(mode) and wanted not in ("store", "queries", "folder", ""):
        raise InputError("a folder has that name", file=path, field=option, expected="the name of a file")
    if stat.S_ISREG(mode) and wanted == "folder":
        raise InputError("a file has that name", file=path, field=option, expected="the name of a folder")
    found = kind_of(path)
    if overwrite or not wanted or found in (wanted, ""):
        return
    if wanted == "folder" and found not in ("store", "queries"):
        return
    if wanted == "text" and found == "file":
        return
    raise InputError(
        f"{KINDS.get(found, found)} stands there",
        file=path,
        field=option,
        got=f"{KINDS.get(wanted, wanted)} to write",
        expected="another name, or --overwrite",
    )


def _kind_by_name(text: str) -> str:
    """What a name stands for where a command writes several kinds."""
    ends = {
        ".btf.zarr": "store",
        ".queries.zarr": "queries",
        ".exr": "representation",
        ".png": "picture",
        ".html": "page",
        ".jsonl": "text",
    }
    return next((kind for end, kind in ends.items() if text.endswith(end)), "")


def kind_of(path: Path) -> str:
    """What stands under a name, by its first bytes: a key of :data:`KINDS`; "" for an empty file.

    Parameters
    ----------
    path : pathlib.Path
        Exists.

    Returns
    -------
    str
    """
    if path.is_dir():
        return _kind_of_folder(path)
    try:
        with path.open("rb") as stream:
            head = stream.read(4096)
    except OSError:
        return "file"
    if head.startswith(b"\x76\x2f\x31\x01"):
        return "representation" if b"btfref\0string\0" in _first_header(path) else "picture"
    if head.startswith(b"\x89PNG"):
        return "picture"
    if head.lstrip()[:9].lower().startswith((b"<!doctype", b"<html")):
        return "page"
    return "file" if head else ""


def _kind_of_folder(path: Path) -> str:
    try:
        head = (path / "zarr.json").read_bytes()
    except OSError:
        return "folder"
    return "queries" if b'"btf-queries"' in head else "store"


def _first_header(path: Path) -> bytes:
    """As much of an OpenEXR file as its first header takes, whatever its manifest's length."""
    with path.open("rb") as stream:
        return stream.read(1 << 20)
