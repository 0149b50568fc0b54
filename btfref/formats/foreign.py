"""Files that people take for BTFs, or that hold something near: what they are, and what to do with them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import PurePosixPath

from btfref.formats.image_sets.files import Candidate
from btfref.types import PathLike

#: Bytes of a file of UTIA's BRDFs: 3 planes of 288 × 288 pairs as doubles.
_UTIA_BYTES = 3 * 288 * 288 * 8


@dataclass(frozen=True)
class Foreign:
    """A file of another kind.

    Attributes
    ----------
    name : str
        Short, "rgl".
    what : str
        One clause for people.
    cure : str
        What to do with it.
    """

    name: str
    what: str
    cure: str


def _starts(*heads: bytes) -> Callable[[Candidate], bool]:
    return lambda candidate: candidate.head.startswith(heads)


def _utia(candidate: Candidate) -> bool:
    return candidate.path.suffix.lower() == ".bin" and candidate.size == _UTIA_BYTES


_UNPACK = "a folder or a .zip: unpack it and name the folder"

_IN_PYTHON = "its values as a btfref.SampledBTF, made in Python (documentation: your own arrays)"

#: In the order in which they are tried.
_KNOWN: tuple[tuple[Callable[[Candidate], bool], Foreign], ...] = (
    (
        _starts(b"tensor_file"),
        Foreign(
            "rgl",
            "a measured BRDF of RGL's database (tensor file), without texels",
            'a surface to put it on: btfref synth MESH --bsdf B.xml with <bsdf type="measured"> that names it',
        ),
    ),
    (
        _utia,
        Foreign(
            "utia-brdf",
            "a measured BRDF of UTIA's database (288 × 288 pairs as doubles), without texels",
            _IN_PYTHON,
        ),
    ),
    (
        _starts(b"PTM_"),
        Foreign(
            "ptm",
            "a polynomial texture map: one camera, and a polynomial of the light in each pixel",
            "pictures from several cameras: one view is no BTF",
        ),
    ),
    (
        _starts(b"#HSH", b"#Hemi"),
        Foreign(
            "rti",
            "a reflectance transformation image (hemispherical harmonics): one camera",
            "pictures from several cameras: one view is no BTF",
        ),
    ),
    (
        _starts(b"\x9f\xeb\x01", b"\xeb\x9f\x01"),
        Foreign(
            "bpf-type-format",
            "types of a Linux kernel or BPF program (BPF Type Format), which are called .btf as well",
            "a bidirectional texture function; Bonn's .btf starts with !",
        ),
    ),
    (_starts(b"\x89HDF\r\n"), Foreign("hdf5", "an HDF5 file", _IN_PYTHON)),
    (_starts(b"\x93NUMPY"), Foreign("npy", "an array of NumPy", _IN_PYTHON)),
    (_starts(b"MATLAB 5.0"), Foreign("mat", "a file of MATLAB", _IN_PYTHON)),
    (
        _starts(b"7z\xbc\xaf\x27\x1c", b"Rar!", b"\x1f\x8b", b"BZh", b"\xfd7zXZ"),
        Foreign("archive", "an archive of another kind than zip", _UNPACK),
    ),
)


def foreign(path: PathLike) -> Foreign | None:
    """What a file or folder is that no format of BTFs takes; None when that is not known either.

    Parameters
    ----------
    path : path-like

    Returns
    -------
    Foreign or None

    Raises
    ------
    InputError
        Missing or empty file, or an archive that is damaged or dangerous.
    """
    candidate = Candidate(path)
    for recognises, found in _KNOWN:
        if recognises(candidate):
            return found
    return _pictures(candidate)


def _pictures(candidate: Candidate) -> Foreign | None:
    """What a folder or an archive holds."""
    from btfref.formats import names
    from btfref.mesostructure.map_folder import kind_of

    files = candidate.files
    if files is None:
        return None
    kind = "a folder" if candidate.path.is_dir() else "a zip archive"
    images = files.images()
    if maps := sorted({found for name in images if (found := kind_of(name)) is not None}):
        return Foreign(
            "maps",
            f"{kind} of maps of one material ({', '.join(maps)})",
            "its surface: btfref synth FOLDER -o OUT",
        )
    if images:
        return Foreign(
            "pictures",
            f"{kind} of {len(images)} pictures whose names do not say tl, pl, tv and pv, such as {images[0]}",
            '--pattern with the places of the angles, such as "cam_{tv}_{pv}_light_{tl}_{pl}.jpg"',
        )
    if not files.sizes:
        return Foreign("empty", f"{kind} without files", "pictures, or a file of a measured BTF")
    endings = {".btf", ".mif", ".binary"}
    if inside := [name for name in sorted(files.sizes) if PurePosixPath(name).suffix.lower() in endings]:
        return Foreign("packed", f"{kind} with {inside[0]}", f"that file itself: {_UNPACK.split(': ')[1]}")
    return Foreign(
        "files",
        f"{kind} of {len(files.sizes)} files without a picture, such as {min(files.sizes)}",
        f"a BTF: {', '.join(names())}",
    )
