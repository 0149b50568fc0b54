"""Measured BTFs in the files of others: what can be read and written, found by what the files hold.

A format is a module with an object ``FORMAT`` (see `btfref.formats.source.Format`) and a row below; third parties
add rows through the entry-point group ``btfref.formats``. Every importer hands over colours in linear Rec. 709 in
the quantity of its files; `btfref.formats.convert` alone turns that quantity into B.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from btfref.errors import BtfrefError, InputError
from btfref.registry.points import Catalogue
from btfref.types import Facts, PathLike

if TYPE_CHECKING:
    from btfref.formats.source import Format, Source
    from btfref.sampling.sampled_btf import SampledBTF
    from btfref.sampling.store.store import BTFStore

__all__ = [
    "ENTRY_POINT_GROUP",
    "FORMATS",
    "export_btf",
    "exporters",
    "format_named",
    "identify",
    "import_btf",
    "names",
    "open_source",
]

#: name -> "module:object", imported when asked for; the order in which files are tried.
FORMATS = {
    "bonn": "btfref.formats.bonn.reader:FORMAT",
    "mif": "btfref.formats.mif:FORMAT",
    "merl": "btfref.formats.merl:FORMAT",
    "spectral": "btfref.formats.image_sets.spectral:FORMAT",
    "utia": "btfref.formats.image_sets.utia:FORMAT",
    "ubo": "btfref.formats.image_sets.ubo:FORMAT",
}

ENTRY_POINT_GROUP = "btfref.formats"

_CATALOGUE = Catalogue("format", FORMATS, ENTRY_POINT_GROUP)


def names() -> list[str]:
    """Names of all formats, built in and from entry points."""
    return _CATALOGUE.names()


def exporters() -> list[str]:
    """Names of the formats that can be written, those of installed packages too."""
    return [name for name in names() if format_named(name).export is not None]


def format_named(name: str) -> Format:
    """The format of that name.

    Raises
    ------
    InputError
        When there is none.
    """
    return _CATALOGUE.load(name)


def identify(path: PathLike) -> str | None:
    """Name of the format of a file, folder or archive, from its first bytes and the names in it.

    Parameters
    ----------
    path : path-like

    Returns
    -------
    str or None
        None when no format takes it.

    Raises
    ------
    InputError
        Missing or empty file, or an archive that is damaged or dangerous.
    """
    from btfref.formats.image_sets.files import Candidate

    candidate = Candidate(path)
    for name in names():
        try:
            if format_named(name).recognises(candidate):
                return name
        except BtfrefError:
            raise
        except Exception:
            # A format of another package that fails at a file costs itself alone.
            if name in FORMATS:
                raise
    return None


def open_source(path: PathLike, *, format: str | None = None, **options: object) -> Source:
    """Open a measured BTF; headers only are read.

    Parameters
    ----------
    path : path-like
    format : str, optional
        Name of the format; found from the file when left out.
    **options
        Of the format, such as ``allow_missing`` or ``gamma``.

    Returns
    -------
    btfref.formats.source.Source

    Raises
    ------
    InputError
        Not a BTF of a known format, or a damaged one.
    """
    name = format or identify(path)
    if name is None and options.get("pattern") is not None:
        name = "ubo"  # photographs, whatever their names
    if name is None:
        from btfref.formats.foreign import foreign

        if (other := foreign(path)) is not None:
            raise InputError(f"not a BTF of a known format: {other.what}", file=path, expected=other.cure)
        raise InputError("not a BTF of a known format", file=path, expected=f"one of {', '.join(names())}")
    return format_named(name).open_checked(path, options)


def import_btf(path: PathLike, out: PathLike, **settings: Any) -> BTFStore:
    """Convert a measured BTF to a store: `btfref.formats.convert.import_btf`."""
    from btfref.formats.convert import import_btf as run

    return run(path, out, **settings)


def export_btf(
    btf: BTFStore | SampledBTF, path: PathLike, format: str, *, memory: int | None = None, **settings: object
) -> Facts:
    """Write a sampled BTF in a format of others.

    Parameters
    ----------
    btf : BTFStore or SampledBTF
    path : path-like
        Must not exist.
    format : str
        Name of a format that can be written.
    memory : int, optional
        Bytes to hold at most, beside the interpreter.
    **settings
        Of the writer.

    Returns
    -------
    dict
        What was written: facts with JSON types.

    Raises
    ------
    InputError
        A format that is only read, an existing path, too small a memory, or values or directions that the format cannot
        hold.
    """
    return format_named(format).export_checked(btf, path, settings, memory=memory)
