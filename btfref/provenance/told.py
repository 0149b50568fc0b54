"""What a process tells another of the code that it runs, so that both run the same or one of them refuses."""

from __future__ import annotations

import json
import time
import uuid
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from btfref.errors import InputError
from btfref.provenance import code, versions

if TYPE_CHECKING:
    from btfref.types import Facts, PathLike

#: Ending of the file that tells workers what to be like.
SUFFIX = ".job.partial"

#: Runs that this process has compared itself with.
_ACCEPTED: dict[str, Facts] = {}


@contextmanager
def order(
    folder: PathLike, roots: Sequence[str], methods: Iterable[str], places: Sequence[str] = (), **more: object
) -> Iterator[Path]:
    """A file for workers of a run, in the folder that they share.

    Parameters
    ----------
    folder : path-like
    roots, methods, places
        See `told`.
    **more
        JSON-able, for the workers.

    Yields
    ------
    pathlib.Path
    """
    asked = {"roots": sorted(set(roots)), "methods": sorted(set(methods)), "places": sorted(set(places))}
    path = Path(folder).resolve() / f"{uuid.uuid4().hex}{SUFFIX}"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({**more, **asked, "told": told(**asked)}), "utf-8")
    try:
        yield path
    finally:
        path.unlink(missing_ok=True)


def accepted(path: PathLike) -> Facts:
    """The facts of an `order`, if this process runs the code that it tells of.

    Returns
    -------
    dict
        What was given as ``more``, and ``roots``, ``methods``, ``places``, ``told``.

    Raises
    ------
    InputError
        The file is not seen here; or a version or a file is another, or changed since this process began.
    """
    path = Path(path)
    if path.name not in _ACCEPTED:
        try:
            facts = json.loads(path.read_text("utf-8"))
        except OSError:
            raise InputError(
                "a worker does not see the folder", file=path.parent, expected="the same path everywhere"
            ) from None
        try:
            own = told(facts["roots"], facts["methods"], facts["places"])
        except (InputError, ModuleNotFoundError) as error:
            raise InputError("a worker lacks code", file=path.parent, got=error) from None
        refuse_other_code(facts["told"], own)
        _ACCEPTED[path.name] = facts
    refuse_changed_code(_began())
    return _ACCEPTED[path.name]


def told(roots: Iterable[str], methods: Iterable[str], places: Iterable[str] = ()) -> Facts:
    """Versions, and a hash of every file, behind what modules and methods make.

    Parameters
    ----------
    roots : iterable of str
        Modules, such as ``"btfref.validate.cell"``.
    methods : iterable of str
        Keys of the registry.
    places : iterable of str
        Further ``"module:object"``; see `btfref.provenance.code.closure`.

    Returns
    -------
    dict
        JSON-able: ``versions``, name → version; ``files``, name within its package → SHA-256.
    """
    found = [code.closure(root, tuple(sorted(methods)), tuple(sorted(places))) for root in sorted(roots)]
    named = frozenset(name for one in found for name in one.external)
    return {
        "versions": {**versions(), **code.external_versions(named)},
        "files": {place: value for one in found for place, value in code.files_of(one).items()},
    }


def refuse_other_code(asked: Facts, own: Facts, *, name: str = "a worker") -> None:
    """Refuse to work for who runs other code.

    Parameters
    ----------
    asked, own : dict
        What `told` gives there and here.
    name : str
        Of this process, for messages.

    Raises
    ------
    InputError
        Names the first version or file that differs.
    """
    for kind, what in (("versions", "a version"), ("files", "code")):
        for key in sorted(asked[kind].keys() | own[kind].keys()):
            there, here = asked[kind].get(key), own[kind].get(key)
            if here != there:
                raise InputError(
                    f"{name} has {what} of its own", field=key, got=_short(here), expected=_short(there)
                )


def refuse_changed_code(since: int, *, name: str = "a worker") -> None:
    """Refuse to go on where code that was read for a digest may not be what this process has loaded.

    Parameters
    ----------
    since : int
        When this process began, in nanoseconds since 1970.
    name : str
        Of this process, for messages.

    Raises
    ------
    InputError
    """
    now = time.time_ns()
    late = code.changed() or [path for path in code.remembered() if since < _newest(path) <= now]
    if late:
        raise InputError(
            f"{name} began before its code changed", file=sorted(late)[0], expected="to be started again"
        )


def _began() -> int:
    import importlib

    psutil = importlib.import_module("psutil")  # comes with Dask, as workers do; without types
    return int(psutil.Process().create_time() * 1e9)


def _newest(path: Path) -> int:
    """When a file last changed or came to its name, which a copy that keeps times cannot hide."""
    facts = path.stat()
    return max(facts.st_mtime_ns, facts.st_ctime_ns)


def _short(value: object) -> str:
    """A version, or the start of a hash."""
    text = "nothing" if value is None else str(value)
    return text[:12] if len(text) == 64 else text[:80]
