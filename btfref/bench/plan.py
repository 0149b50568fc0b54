"""Plans of benchmarks: TOML files that say what is measured of which methods; build and query parameters apart.

Source of the division: ann-benchmarks (Aumüller, Bernhardsson, Faithfull 2018). What a representation is built with
costs a fit; what a lookup is made with does not, and is varied on the same build.
"""

from __future__ import annotations

import itertools
import tomllib
from collections.abc import Collection, Iterable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from btfref.errors import InputError
from btfref.querying import split

if TYPE_CHECKING:
    from btfref.types import Facts, PathLike


#: Shipped plans, and folders of users alike, hold files of this kind.
SUFFIX = ".toml"

#: What can be measured, in the order in which it is.
MEASURES = ("build", "off_grid", "error", "eval", "render", "sampling", "realtime")

#: Those that "interpolation" among query parameters says something to, or nothing does.
PICTURES = ("build", "error", "render", "realtime")

#: Tables and keys of a plan with their defaults.
DATA = {
    "mesostructures": ["checker"],
    "texels": 64,
    "directions": "ubo81",
    "spp": 8,
    "estimator": "surface",
}
ROUNDS = {"build": 1, "eval": 5, "render": 5, "sampling": 5, "realtime": 5}
SETTINGS: Facts = {
    "off_grid_rows": split.ROWS,
    "off_grid_spp": split.SPP,
    "error_samples": 50_000,
    "points": {"numpy": 1 << 14, "drjit": 1 << 20, "glsl": 1 << 18},
    "scenes": ["sphere, suns", "cloth, sky"],
    "render_spp": 16,
    "render_size": 512,
    "sampling_size": 64,
    "sampling_spp": 64,
    "sampling_repeats": 8,
    "frames": [[800, 800], [1920, 1080]],
}
_TOP = (
    "title",
    "measures",
    "seed",
    "data",
    "rounds",
    "settings",
    "baseline",
    "query",
    "method",
    "peer",
    "quick",
)


@dataclass(frozen=True)
class Entry:
    """One row of a benchmark: a method with one set of build parameters, or a peer.

    Parameters
    ----------
    name : str
        In tables.
    method : str
        Key in the registry; "" for a peer.
    peer : str
        Key in :data:`btfref.bench.subjects.PEERS`; "" for a method.
    build : dict
        Parameters of the fit; ``preset`` names one of the method's.
    query : tuple of dict
        Parameters of lookups, each measured on the same build.
    bytes_of : str
        Name of an earlier entry whose bytes this one's rank is chosen to match.
    """

    name: str
    method: str = ""
    peer: str = ""
    build: Facts = field(default_factory=dict)
    query: tuple[Facts, ...] = ({},)
    bytes_of: str = ""


@dataclass(frozen=True)
class Plan:
    """What is measured, on what, how often.

    ``baseline`` names the entry to whose times builds are compared; "": the first.
    """

    name: str
    title: str
    baseline: str
    measures: tuple[str, ...]
    seed: int
    data: Facts
    rounds: dict[str, int]
    settings: Facts
    entries: tuple[Entry, ...]

    def to_dict(self) -> Facts:
        """JSON-able copy."""
        return asdict(self)


def shipped() -> dict[str, Path]:
    """Plans of the package: name -> path."""
    folder = Path(__file__).parent / "suites"
    return {path.stem: path for path in sorted(folder.glob(f"*{SUFFIX}"))}


def read_plan(path: PathLike, *, quick: bool = False, only: Iterable[str] | None = None) -> Plan:
    """Read a plan.

    Parameters
    ----------
    path : path-like
    quick : bool
        Let the file's table ``quick`` override the rest.
    only : iterable of str, optional
        Keys of methods and peers, or names of entries; default all.

    Returns
    -------
    Plan

    Raises
    ------
    InputError
        For a file that is no plan: unknown keys, methods, peers or measures.
    """
    try:
        found = tomllib.loads(Path(path).read_text())
    except OSError as error:
        raise InputError("cannot read the plan", file=path, got=error.strerror) from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError("not a TOML file", file=path, got=str(error)) from None
    _known(found, _TOP, path, "plan")
    overrides = found.pop("quick", {})
    if quick:
        _known(overrides, _TOP, path, "quick")
        found |= {
            key: {**found.get(key, {}), **value} if isinstance(value, dict) else value
            for key, value in overrides.items()
        }
    measures = found.get("measures", list(MEASURES))
    _known(measures, MEASURES, path, "measures")
    if any("interpolation" in query for query in _queries(found)):
        # The others ask for one value, not for a picture.
        _known(measures, PICTURES, path, "measures with query.interpolation")
    tables = {}
    for name, defaults in (("data", DATA), ("rounds", ROUNDS), ("settings", SETTINGS)):
        _known(found.get(name, {}), defaults, path, name)
        tables[name] = {**defaults, **found.get(name, {})}
    entries = _entries(found, path)
    baseline = found.get("baseline", "")
    _known([baseline] if baseline else [], {e.name for e in entries}, path, "baseline")
    if only is not None:
        _known(only, {word for e in entries for word in (e.name, e.method, e.peer) if word}, path, "--only")
        entries = [e for e in entries if {e.name, e.method, e.peer} & set(only)]
    return Plan(
        name=Path(path).stem,
        baseline=baseline,
        title=str(found.get("title", Path(path).stem)),
        measures=tuple(m for m in MEASURES if m in measures),
        seed=int(found.get("seed", 0)),
        entries=tuple(entries),
        **tables,
    )


def _entries(found: Facts, path: PathLike) -> list[Entry]:
    from btfref.bench.subjects import PEERS
    from btfref.registry import methods, usable_methods

    queries = _combinations(found.get("query", {}), path)
    rows = found.get("method", [{"key": key} for key in usable_methods()])
    entries: list[Entry] = []
    for row in rows:
        _known(row, ("key", "name", "build", "query", "bytes_of"), path, "method")
        _known([row.get("key")], methods(), path, "method.key")
        own = _combinations(row["query"], path) if "query" in row else queries
        for build in row.get("build", [{}]):
            described = ", ".join(f"{k} {v}" for k, v in build.items())
            name = row.get("name", row["key"]) + (f" ({described})" if described else "")
            bytes_of = row.get("bytes_of", "")
            _known([bytes_of] if bytes_of else [], {e.name for e in entries}, path, "method.bytes_of")
            entries.append(Entry(name, method=row["key"], build=build, query=own, bytes_of=bytes_of))
    for row in found.get("peer", []):
        _known(row, ("key", "name", "build"), path, "peer")
        _known([row.get("key")], PEERS, path, "peer.key")
        name = row.get("name", PEERS[row["key"]].title)
        entries.append(Entry(name, peer=row["key"], build=row.get("build", {})))
    return entries


def _queries(found: Facts) -> Iterator[Facts]:
    """Tables of query parameters: that of the plan and those of its methods."""
    yield found.get("query", {})
    yield from (row.get("query", {}) for row in found.get("method", []))


def _combinations(table: Facts, path: PathLike) -> tuple[Facts, ...]:
    """All combinations of lists of query parameters."""
    _known(table, ("filter_type", "interpolation"), path, "query")
    lists = [value if isinstance(value, list) else [value] for value in table.values()]
    return tuple(dict(zip(table, values, strict=True)) for values in itertools.product(*lists))


def _known(words: Iterable[Any], allowed: Collection[Any], path: PathLike, field_name: str) -> None:
    unknown = [str(word) for word in words if word not in allowed]
    if unknown:
        raise InputError(
            "unknown entry of a plan",
            file=path,
            field=field_name,
            got=", ".join(unknown),
            expected=", ".join(map(str, allowed)),
        )
