"""A package of a data set, opened: its grids, queries, maps and geometry."""

from __future__ import annotations

import tarfile
import tempfile
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from btfref.datasets import sets
from btfref.datasets.manifest import MANIFEST, read_manifest
from btfref.datasets.sets import FOLDER
from btfref.errors import InputError

if TYPE_CHECKING:
    from btfref.mesostructure.base import Mesostructure
    from btfref.querying.files.zarr_file import QueryFile
    from btfref.sampling import SampledBTF
    from btfref.types import Facts, PathLike, Progress


@dataclass(frozen=True)
class Package:
    """A material of a data set in one tier.

    Attributes
    ----------
    path : Path
        Its folder.
    manifest : dict
        What it was made from; see ``manifest.json``.
    """

    path: Path
    manifest: Facts = field(repr=False)

    @property
    def name(self) -> str:
        """As "btf-1/knit"."""
        return f"{self.manifest['set']}/{self.manifest['material']}"

    @property
    def grids(self) -> tuple[str, ...]:
        """Names of its sets of directions."""
        return tuple(self.manifest["settings"]["grids"])

    def grid_path(self, name: str | None = None) -> Path:
        """The store of a set of directions; by default the last, which has the most.

        Raises
        ------
        InputError
        """
        name = self.grids[-1] if name is None else name
        if name not in self.grids:
            raise InputError(
                "no such grid", file=self.path, field="grid", got=name, expected=", ".join(self.grids)
            )
        return self.path / "grids" / f"{name}.btf.zarr"

    def grid(self, name: str | None = None, *, variance: bool = True) -> SampledBTF:
        """A sampled BTF, read whole; see `grid_path`."""
        from btfref.sampling import SampledBTF

        return SampledBTF.load(self.grid_path(name), variance=variance)

    def test(self, footprint: str = "point") -> dict[str, np.ndarray]:
        """Rows that nobody fits to, with their true values.

        Parameters
        ----------
        footprint : {"point", "texel", "wide"}

        Returns
        -------
        dict of str to ndarray
            Columns of `btfref.querying.files.zarr_file`; ``first`` and ``second`` (n, 3): independent means, whose mean
            ``B`` is.

        Raises
        ------
        InputError
        """
        return test_rows(self.path, footprint)

    def training(self) -> QueryFile:
        """Rows to fit to."""
        from btfref.querying.files.zarr_file import open_queries

        return open_queries(self.path / "queries" / "training.queries.zarr")

    def map(self, name: str) -> np.ndarray:
        """A truth map by its name in `btfref.datasets.truth.MAPS`.

        Raises
        ------
        InputError
        """
        path = self.path / "maps" / f"{name}.npy"
        if not path.is_file():
            known = ", ".join(sorted(one.stem for one in path.parent.glob("*.npy")))
            raise InputError("no such map", file=self.path, field="map", got=name[:40], expected=known)
        return np.load(path)

    def mesostructure(self) -> Mesostructure:
        """The geometry, built anew from its parameters."""
        from btfref.mesostructure import build

        return build(self.manifest["mesostructure"], **self.manifest["parameters"])


def test_rows(path: Path, footprint: str) -> dict[str, np.ndarray]:
    """See `Package.test`; `path` is the package's folder."""
    from btfref.datasets.making import TEST
    from btfref.querying.files.zarr_file import open_queries

    if footprint not in sets.FOOTPRINTS:
        raise InputError(
            "no such footprint", field="footprint", got=footprint[:40], expected=", ".join(sets.FOOTPRINTS)
        )
    first, second = (open_queries(path / "queries" / name.format(footprint)).read() for name in TEST)
    return first | {
        "first": first["B"],
        "second": second["B"],
        "B": 0.5 * (first["B"] + second["B"]),
        "variance": 0.25 * (first["variance"] + second["variance"]),
        "samples": first["samples"] + second["samples"],
    }


def open_package(path: PathLike) -> Package:
    """A package by its folder.

    Raises
    ------
    InputError
        Not there, or not finished.
    """
    return Package(Path(path), read_manifest(Path(path)))


def dataset(
    name: str,
    *,
    tier: str = "toy",
    folder: PathLike = FOLDER,
    archive: PathLike | None = None,
    make: bool = True,
    memory: int | None = None,
    progress: Progress | None = None,
) -> Package:
    """A material of a standard data set: from a folder, from an archive, or made on first use.

    Parameters
    ----------
    name : str
        Such as "btf-1/knit".
    tier : {"toy", "standard", "large"}
        16², 64² or 128² texels; toy takes seconds to minutes, standard many minutes, large hours.
    folder : path-like
        Where packages lie, as ``SET/TIER/MATERIAL``.
    archive : path-like, optional
        A ``.zip`` or ``.tar`` (also ``.tar.gz``) of such a folder: what it holds of this material is unpacked into
        `folder` and checked.
    make : bool
        Make what is not there; else that is an error.
    memory : int, optional
        Budget in bytes.
    progress : callable, optional
        Called as ``progress(done, total, label)``.

    Returns
    -------
    Package

    Raises
    ------
    InputError
        An unknown name, a package of another version, or one that an archive holds damaged.
    """
    from btfref.datasets.making import make as make_packages
    from btfref.datasets.making import place

    chosen, materials = sets.find(name)
    chosen.tier(tier)
    if len(materials) != 1:
        raise InputError(
            "one material is opened at a time", field="NAME", got=name, expected=f"{chosen.name}/NAME"
        )
    where = place(folder, chosen, tier, materials[0])
    if not (where / MANIFEST).is_file() and archive is not None:
        _unpack(Path(archive), where, place("", chosen, tier, materials[0]))
    if not (where / MANIFEST).is_file():
        if not make:
            raise InputError("no such package", file=where, expected="btfref dataset make, or make=True")
        make_packages(
            f"{chosen.name}/{materials[0].name}", folder, tier=tier, progress=progress, memory=memory
        )
    return open_package(where)


def _unpack(archive: Path, where: Path, inside: Path) -> None:
    """Take a package out of an archive, whole and checked."""
    from btfref.datasets.verifying import problems_of
    from btfref.outputs import new_folder

    if not archive.is_file():
        raise InputError("no such file", file=archive, field="archive")
    where.parent.mkdir(parents=True, exist_ok=True)
    with new_folder(where) as draft, tempfile.TemporaryDirectory(dir=where.parent) as scratch:
        start = f"{inside.as_posix()}/"
        try:
            if zipfile.is_zipfile(archive):
                with zipfile.ZipFile(archive) as packed:
                    packed.extractall(scratch, [n for n in packed.namelist() if start in f"/{n}"])
            else:
                with tarfile.open(archive) as packed_tar:
                    members = [one for one in packed_tar if start in f"/{one.name}"]
                    packed_tar.extractall(scratch, members, filter="data")
        except (OSError, ValueError, tarfile.TarError, zipfile.BadZipFile) as error:
            raise InputError("archive cannot be read", file=archive, got=error) from None
        found = next((one.parent for one in Path(scratch).rglob(MANIFEST)), None)
        if found is None:
            raise InputError("archive without this package", file=archive, expected=start)
        for one in list(found.iterdir()):
            one.rename(draft / one.name)
        wrong = problems_of(draft)
        if wrong:
            raise InputError("archive holds a damaged package", file=archive, got=wrong[0])
