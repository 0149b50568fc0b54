"""Packages of data sets, made step by step: a run that was interrupted goes on where it stopped."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from btfref.datasets import sets
from btfref.datasets.manifest import (
    BEGUN,
    KIND,
    LICENCE,
    MANIFEST,
    SCHEMA,
    STATEMENT,
    read_manifest,
    write_croissant,
    write_manifest,
)
from btfref.datasets.sets import VARIANT
from btfref.errors import InputError
from btfref.outputs import new_file
from btfref.provenance import LLVM, __version__, versions

if TYPE_CHECKING:
    from btfref.datasets.sets import DataSet, Material, Tier
    from btfref.mesostructure.base import Mesostructure
    from btfref.sampling.scheduling import Scheduler
    from btfref.types import Facts, PathLike, Progress

#: What the bytes of a package depend on.
VERSIONS = ("numpy", "mitsuba", "drjit", "zarr", LLVM)

#: Facts of a manifest that tell one version of a set from another; what else differs is said and is no fault.
IDENTITY = (
    "set",
    "set_version",
    "tier",
    "material",
    "mesostructure",
    "parameters",
    "geometry",
    "settings",
    "seeds",
    "max_depth",
    "max_theta",
    "variant",
)

#: Name of the first half of a footprint's test queries, and of the second.
TEST = ("test-{}.queries.zarr", "test-{}-second.queries.zarr")

TRAINING = "training.queries.zarr"


def place(folder: PathLike, chosen: DataSet, tier: str, material: Material) -> Path:
    """Where a package lies below a folder."""
    return Path(folder) / chosen.name / tier / material.name


def make(
    name: str,
    folder: PathLike,
    *,
    tier: str = "toy",
    overwrite: bool = False,
    progress: Progress | None = None,
    memory: int | None = None,
    scheduler: Scheduler = None,
    workers: int | None = None,
) -> list[Path]:
    """Make packages, those that are there already left as they are.

    Parameters
    ----------
    name : str
        "MATERIAL", "SET/MATERIAL", or "all".
    folder : path-like
        Made where it is not there.
    tier : {"toy", "standard", "large"}
    overwrite : bool
        Replace packages of another version.
    progress : callable, optional
        Called as ``progress(done, total, label)``.
    memory, scheduler, workers
        See `btfref.sampling.scheduling.run`; without influence on any byte.

    Returns
    -------
    list of Path
        Their folders.

    Raises
    ------
    InputError
        An unknown name or tier; a package of another version.
    """
    chosen, materials = sets.find(name)
    chosen.tier(tier)
    made = []
    for material in materials:

        def tell(done: int, total: int, label: str, own: str = material.name) -> None:
            if progress is not None:
                progress(done, total, f"{own}: {label}")

        where = place(folder, chosen, tier, material)
        means: dict[str, Any] = {"scheduler": scheduler, "workers": workers, "progress": tell}
        _package(where, chosen, tier, material, overwrite, memory, means)
        made.append(where)
    return made


def expected(chosen: DataSet, tier: str, material: Material, built: Mesostructure) -> Facts:
    """What the manifest of a package says besides its files, as this version makes it."""
    from btfref.sampling.job import fingerprint

    facts = {
        "kind": KIND,
        "schema": SCHEMA,
        "set": chosen.name,
        "set_version": chosen.version,
        "tier": tier,
        "material": material.name,
        "family": material.kind,
        "difficulty_in_words": material.difficulty,
        "mesostructure": material.mesostructure,
        "parameters": built.parameters,
        "geometry": fingerprint(built),
        "settings": dataclasses.asdict(chosen.size(tier, material)),
        "seeds": {
            "grids": sets.GRID_SEED,
            "test": sets.TEST_SEED,
            "training": sets.TRAINING_SEED,
            "maps": sets.MAP_SEED,
        },
        "max_depth": sets.MAX_DEPTH,
        "max_theta": sets.MAX_THETA,
        "variant": VARIANT,
        "versions": versions(VERSIONS),
        "licence": LICENCE,
        "statement": STATEMENT,
        "suite": __version__,
    }
    return json.loads(json.dumps(facts))


def _package(
    where: Path,
    chosen: DataSet,
    tier: str,
    material: Material,
    overwrite: bool,
    memory: int | None,
    means: Facts,
) -> None:
    from btfref.datasets.geometry import write_geometry
    from btfref.mesostructure import build
    from btfref.sampling.store.lock import writing

    built = build(material.mesostructure, **material.parameters)
    facts = expected(chosen, tier, material, built)
    where.mkdir(parents=True, exist_ok=True)
    with writing(where / MANIFEST):
        if not _begin(where, facts, overwrite):
            return
        for name in ("grids", "queries", "maps", "geometry"):
            (where / name).mkdir(exist_ok=True)
        write_geometry(built, where / "geometry")
        size = chosen.size(tier, material)
        grids = _grids(where, size, built, memory, means)
        _queries(where, size, built, means)
        maps = _maps(where, size, built, means["progress"])
        found = _numbers(where, grids, maps)
        with new_file(where / "LICENCE.txt") as draft:
            draft.write_text(STATEMENT + "\n", "utf-8")
        write_croissant(where, chosen, tier, material)
        write_manifest(where, facts | found)
        (where / BEGUN).unlink()


def _begin(where: Path, facts: Facts, overwrite: bool) -> bool:
    """Whether there is anything to make; a package of other facts is refused or removed."""
    there = facts_of(where)
    if there is not None:
        finished = (where / MANIFEST).is_file()
        # A finished package stays what it is when a library is updated; a half-done one must not be mixed.
        differ = [key for key in differences(facts, there) if not finished or key in IDENTITY]
        if not differ:
            return not finished
        if not overwrite:
            raise InputError(
                "a package of another version",
                file=where,
                field=", ".join(differ),
                expected="another folder, or to overwrite it",
            )
        for path in where.iterdir():
            if path.is_dir():
                shutil.rmtree(path)
            elif not path.name.endswith(".partial") or path.name == BEGUN:
                path.unlink()
    elif files := [path for path in where.iterdir() if not path.name.endswith(".partial")]:
        raise InputError("no package, but other files", file=where, got=files[0].name, expected="no files")
    with new_file(where / BEGUN) as draft:
        draft.write_text(json.dumps(facts) + "\n", "utf-8")
    return True


def facts_of(where: Path) -> Facts | None:
    """What a package says that it was made from, finished or not; None where there is none."""
    if (where / MANIFEST).is_file():
        return read_manifest(where)
    try:
        return json.loads((where / BEGUN).read_text("utf-8"))
    except (OSError, ValueError):
        return None


def differences(wanted: Facts, found: Facts) -> list[str]:
    """Facts in which a package differs, by name."""
    return sorted(key for key, value in wanted.items() if found.get(key) != value)


def _grids(where: Path, size: Tier, built: Mesostructure, memory: int | None, means: Facts) -> list[Path]:
    from btfref.sampling.synthesis import make_job

    made = []
    for directions in size.grids:
        job = make_job(
            built,
            None,
            {
                "texels": size.texels,
                "views": directions,
                "lights": directions,
                "spp": size.spp,
                "seed": sets.GRID_SEED,
                "max_depth": sets.MAX_DEPTH,
                "variant": VARIANT,
            },
        )
        path = where / "grids" / f"{directions}.btf.zarr"
        job.to_store(path, memory=memory, **means)
        made.append(path)
    return made


def _queries(where: Path, size: Tier, built: Mesostructure, means: Facts) -> None:
    from btfref.querying.job import QueryJob, fill_file

    folder = where / "queries"
    common: Facts = {
        "max_theta": sets.MAX_THETA,
        "max_depth": sets.MAX_DEPTH,
        "footprint": "square",
        "variant": VARIANT,
    }
    for number, (footprint, texels) in enumerate(sets.FOOTPRINTS.items()):
        for stream, name in enumerate(TEST):
            settings: Facts = {
                "n": size.test_rows,
                "spp": size.test_spp,
                "seed": sets.TEST_SEED + number,
                "radius": texels / size.texels,
            }
            job = QueryJob.of(built, None, {**common, **settings}, stream=stream)
            fill_file(job, folder / name.format(footprint), **means)
    half = 0.5 / size.texels
    settings = {
        "n": size.training_rows,
        "spp": size.training_spp,
        "seed": sets.TRAINING_SEED,
        "radius": f"log:{half / 4:.8g}:{4 * half:.8g}",
    }
    fill_file(QueryJob.of(built, None, {**common, **settings}), folder / TRAINING, **means)


def _maps(
    where: Path, size: Tier, built: Mesostructure, tell: Callable[[int, int, str], object]
) -> dict[str, np.ndarray]:
    from btfref.datasets.picture import picture
    from btfref.datasets.truth import MAPS, truth_maps
    from btfref.images.png import encode_png

    folder, shown = where / "maps", where / "picture.png"
    if not all((folder / f"{name}.npy").is_file() for name in MAPS):
        tell(0, 2, "maps")
        for name, values in truth_maps(built, size.map_texels, size.map_lights, VARIANT).items():
            with new_file(folder / f"{name}.npy") as draft:
                np.save(draft, values)
    if not shown.is_file():
        tell(1, 2, "maps")
        with new_file(shown) as draft:
            draft.write_bytes(encode_png(picture(built, VARIANT)))
    tell(2, 2, "maps")
    return {name: np.load(folder / f"{name}.npy") for name in MAPS}


def _numbers(where: Path, grids: list[Path], maps: dict[str, np.ndarray]) -> Facts:
    """Difficulty, noise and means of a package."""
    from btfref.datasets.difficulty import difficulty, noise
    from btfref.datasets.package import test_rows
    from btfref.sampling.store.store import open_store

    rows = {footprint: test_rows(where, footprint) for footprint in sets.FOOTPRINTS}
    return {
        "difficulty": difficulty(maps, grids[-1], rows["point"]),
        "noise": {path.name.removesuffix(".btf.zarr"): noise(open_store(path)) for path in grids},
        # What another machine's rounding is judged by.
        "means": {
            footprint: found["B"].mean(0, dtype=np.float64).tolist() for footprint, found in rows.items()
        },
    }
