"""What a process tells another of the code that it runs, so that both run the same or one of them refuses."""

from __future__ import annotations

import time
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from btfref.errors import InputError
from btfref.provenance import code, versions

if TYPE_CHECKING:
    from btfref.types import Facts


def told(roots: Iterable[str], methods: Iterable[str], places: tuple[str, ...] = ()) -> Facts:
    """Versions, and a hash of every file, behind what modules and methods make.

    Parameters
    ----------
    roots : iterable of str
        Modules, such as ``"btfref.validate.cell"``.
    methods : iterable of str
        Keys of the registry.
    places : tuple of str
        Further ``"module:object"``; see `btfref.provenance.code.closure`.

    Returns
    -------
    dict
        JSON-able: ``versions``, name → version; ``files``, name within its package → SHA-256.
    """
    roots, methods = sorted(set(roots)), sorted(set(methods))
    found = [code.closure(root, tuple(methods), places) for root in roots]
    named = frozenset(name for one in found for name in one.external)
    return {
        "versions": {**versions(), **code.external_versions(named)},
        "files": {place: value for one in found for place, value in code.files_of(one).items()},
    }


def refuse_other_code(asked: Facts, own: Facts, *, since: int, name: str = "a worker") -> None:
    """Refuse to work for who runs other code, or with code that may have changed since it was loaded.

    Parameters
    ----------
    asked, own : dict
        What `told` gives there and here.
    since : int
        When this process began, in nanoseconds since 1970: files that changed later may not be what it runs.
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
    refuse_changed_code(since, name=name)


def refuse_changed_code(since: int, *, name: str = "a worker") -> None:
    """Refuse to go on where code that was read for a digest may not be what this process has loaded.

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


def _newest(path: Path) -> int:
    """When a file last changed or came to its name, which a copy that keeps times cannot hide."""
    facts = path.stat()
    return max(facts.st_mtime_ns, facts.st_ctime_ns)


def _short(value: object) -> str:
    """A version, or the start of a hash."""
    return "nothing" if value is None else str(value)[:40] if not _is_hash(value) else str(value)[:12]


def _is_hash(value: object) -> bool:
    return isinstance(value, str) and len(value) == 64
