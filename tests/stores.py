"""Stores as tests look at them: imported from a file, or byte by byte."""

from pathlib import Path

from btfref.formats import import_btf
from btfref.sampling import SampledBTF


def imported(path, out=None, *, dtype="float32", **settings):
    """The BTF that an import makes of a file or folder, in a store beside it unless told where."""
    out = out or path.with_name(path.name + ".btf.zarr")
    return SampledBTF.load(import_btf(path, out, dtype=dtype, **settings).path)


def contents(root):
    """Path below the root → bytes, of all files there."""
    return {str(p.relative_to(root)): p.read_bytes() for p in Path(root).rglob("*") if p.is_file()}
