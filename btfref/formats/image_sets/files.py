"""Folders and archives of images: what is in them, read one file at a time and never unpacked."""

from __future__ import annotations

import hashlib
import os
import zipfile
import zlib
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path, PurePosixPath

from btfref.errors import InputError
from btfref.types import PathLike

#: More files than any BTF has (151² pairs, a few views each).
LARGEST_NUMBER = 1 << 20

#: Bytes of one unpacked image (an 8192² half-float RGB picture is below it).
LARGEST_FILE = 512 << 20

#: Pictures hardly compress; an archive that grows more than this is a bomb.
LARGEST_RATIO = 200

IMAGES = (".jpg", ".jpeg", ".png", ".exr", ".hdr")


def _hidden(parts: Sequence[str]) -> bool:
    """Whether a name is what file managers leave behind: dot files, and what macOS packs beside them."""
    return any(part.startswith(".") or part == "__MACOSX" for part in parts)


class Candidate:
    """A file or folder that may be of one of the formats: what these recognise themselves by.

    Attributes
    ----------
    path : Path
    head : bytes
        The first 64 bytes of a file, empty for a folder.
    size : int
        Bytes of a file, 0 for a folder.
    files : Folder or Archive, or None
        Of a folder or a zip archive.
    """

    def __init__(self, path: PathLike) -> None:
        self.path = Path(path)
        if not self.path.exists():
            raise InputError("no such file", file=path)
        self.head, self.size = b"", 0
        if not self.path.is_dir():
            self.size = self.path.stat().st_size
            with self.path.open("rb") as stream:
                self.head = stream.read(64)
            if not self.head:
                raise InputError("the file is empty", file=path)

    @cached_property
    def files(self) -> Folder | Archive | None:
        """Folder or Archive, or None."""
        if self.path.is_dir() or self.head.startswith((b"PK\x03\x04", b"PK\x05\x06")):
            return files_of(self.path)
        return None


def files_of(path: PathLike) -> Folder | Archive:
    """Folder or Archive at a path.

    Raises
    ------
    InputError
        Neither, or an archive that is damaged or dangerous.
    """
    path = Path(path)
    if path.is_dir():
        return Folder(path)
    if not path.is_file():
        raise InputError("no such file or folder", file=path)
    return Archive(path)


class _Files:
    """Files by their names relative to the top.

    Attributes
    ----------
    sizes : dict of str to int
        Bytes of each.
    """

    sizes: dict[str, int]

    def fingerprint(self) -> str:
        """Digest of names, sizes and contents."""
        state = hashlib.sha256()
        for name, size in sorted(self.sizes.items()):
            state.update(f"{name}\0{size}\0{self.content(name)}\n".encode("utf-8", "surrogateescape"))
        return state.hexdigest()[:32]

    def content(self, name: str) -> str:
        """Digest of the bytes of a file."""
        raise NotImplementedError

    def images(self) -> list[str]:
        """Names that end as pictures do."""
        return [name for name in sorted(self.sizes) if name.lower().endswith(IMAGES)]


class Folder(_Files):
    """Files of a folder and the folders in it, but for hidden ones; links to folders are not followed."""

    def __init__(self, path: PathLike) -> None:
        self.path = Path(path)
        self.sizes = {}
        for top, _, names in os.walk(self.path):
            for name in names:
                entry = Path(top) / name
                if not _hidden(entry.relative_to(self.path).parts) and entry.is_file():
                    self.sizes[entry.relative_to(self.path).as_posix()] = entry.stat().st_size
            if len(self.sizes) > LARGEST_NUMBER:
                raise InputError("too many files", file=path, expected=f"at most {LARGEST_NUMBER}")

    def where(self, name: str) -> Path:
        """Path of a file, for errors."""
        return self.path / name

    def content(self, name: str) -> str:
        """Digest of the bytes of a file."""
        try:
            with self.where(name).open("rb") as stream:
                return hashlib.file_digest(stream, "sha256").hexdigest()
        except FileNotFoundError:
            raise InputError("the file has gone", file=self.where(name)) from None

    def read(self, name: str) -> bytes:
        """Bytes of a file."""
        if self.sizes[name] > LARGEST_FILE:
            raise InputError(
                "image too large", file=self.where(name), got=self.sizes[name], expected=f"≤ {LARGEST_FILE}"
            )
        try:
            return self.where(name).read_bytes()
        except FileNotFoundError:
            raise InputError("the file has gone", file=self.where(name)) from None


class Archive(_Files):
    """Files of a zip archive but for hidden ones; every name and size is checked before anything is unpacked."""

    def __init__(self, path: PathLike) -> None:
        self.path = Path(path)
        try:
            self._zip = zipfile.ZipFile(self.path)
            entries = self._zip.infolist()
        except Exception as error:  # whatever zipfile makes of damaged directories
            raise InputError("damaged archive", file=path, got=error, expected="a zip archive") from error
        if len(entries) > LARGEST_NUMBER:
            raise InputError(
                "too many files", file=path, got=len(entries), expected=f"at most {LARGEST_NUMBER}"
            )
        self.sizes, self._entries, packed = {}, {}, 0
        for entry in entries:
            name = entry.filename
            parts = PurePosixPath(name.replace("\\", "/")).parts
            if (
                not parts
                or parts[0] == "/"
                or ":" in parts[0]
                or ".." in parts
                or "\0" in entry.orig_filename
            ):
                raise InputError(
                    "name that leaves the archive", file=path, field="name", got=repr(name)[:200]
                )
            if entry.is_dir() or _hidden(parts):
                continue
            if entry.flag_bits & 1:
                raise InputError("encrypted archive", file=path, field=name)
            if name in self.sizes:
                raise InputError("two files of one name", file=path, field="name", got=repr(name)[:200])
            if entry.file_size > LARGEST_FILE or (
                entry.file_size > 1 << 20 and entry.file_size > LARGEST_RATIO * max(entry.compress_size, 1)
            ):
                raise InputError(
                    "file that unpacks to too much",
                    file=path,
                    field=name,
                    got=f"{entry.compress_size} bytes that give {entry.file_size}",
                    expected=f"at most {LARGEST_FILE} bytes and {LARGEST_RATIO} times the packed size",
                )
            packed += entry.compress_size
            self.sizes[name], self._entries[name] = entry.file_size, entry
        size = self.path.stat().st_size
        if packed > size:  # entries that share their bytes
            raise InputError("entries overlap", file=path, got=f"{packed} bytes packed", expected=f"≤ {size}")

    def where(self, name: str) -> str:
        """Path of a file, for errors."""
        return f"{self.path}/{name}"

    def content(self, name: str) -> str:
        """The checksum that the archive has of a file."""
        return f"{self._entries[name].CRC:08x}"

    def read(self, name: str) -> bytes:
        """Bytes of a file; never more than the directory promised."""
        entry = self._entries[name]
        try:
            with self._zip.open(entry) as stream:
                data = stream.read(entry.file_size + 1)
        except (
            zipfile.BadZipFile,
            zlib.error,
            EOFError,
            OSError,
            RuntimeError,
            ValueError,
            KeyError,
            NotImplementedError,
            AttributeError,
        ) as error:
            raise InputError(
                "damaged archive", file=self.path, field=f"{name} at byte {entry.header_offset}", got=error
            ) from error
        if len(data) != entry.file_size:
            raise InputError(
                "damaged archive", file=self.path, field=name, got=len(data), expected=entry.file_size
            )
        return data
