"""What installed packages add: entry points, of which a broken one costs itself alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from btfref.errors import InputError

#: Third parties add rows with entry points of this group; each names an object of type :class:`Method`.
ENTRY_POINT_GROUP = "btfref.representations"

#: All groups: methods, formats of files, mesostructures.
GROUPS = (ENTRY_POINT_GROUP, "btfref.formats", "btfref.mesostructures")


def imported(place: str) -> Any:
    """What ``module:object`` names."""
    module, _, name = place.partition(":")
    return getattr(import_module(module), name)


@dataclass(frozen=True)
class BrokenPoint:
    """An entry point of a package that cannot be used.

    Attributes
    ----------
    group, name : str
    package : str
        Name and version of the package that has it.
    reason : str
        One line.
    """

    group: str
    name: str
    package: str
    reason: str

    def __str__(self) -> str:
        return f"'{self.name}' of the package {self.package} cannot be used: {self.reason}"


def _package(point: EntryPoint) -> str:
    dist = point.dist
    return f"{dist.name} {dist.version}" if dist is not None else "unknown"


def packages_of(group: str) -> dict[str, str]:
    """Name and version of the package of each entry point of a group."""
    return {point.name: _package(point) for point in entry_points(group=group)}


def one_line(error: BaseException) -> str:
    """An error of a foreign module, short enough for a message."""
    return " ".join(f"{type(error).__name__}: {error}".split())[:300]


@cache
def usable_points(group: str, kind: type | None = None) -> tuple[dict[str, Any], dict[str, BrokenPoint]]:
    """Objects of the entry points of a group by name, and those that cannot be had.

    Parameters
    ----------
    group : str
    kind : type, optional
        What an object must be.

    Returns
    -------
    usable : dict of str to object
    broken : dict of str to BrokenPoint
    """
    usable: dict[str, Any] = {}
    broken: dict[str, BrokenPoint] = {}
    for point in sorted(entry_points(group=group), key=lambda p: (p.name, p.value)):
        try:
            found = point.load()
            if kind is not None and not isinstance(found, kind):
                raise TypeError(f"{point.value} is a {type(found).__name__}, not a {kind.__name__}")
            if point.name in usable:
                raise ValueError("another package has that name already")
        except (Exception, SystemExit) as error:  # whatever a foreign module raises costs that package alone
            broken[point.name] = BrokenPoint(group, point.name, _package(point), one_line(error))
        else:
            usable[point.name] = found
    return usable, broken


@dataclass(frozen=True)
class Catalogue:
    """btfref's own rows, and those of an entry-point group.

    Parameters
    ----------
    kind : str
        What a row is, for messages: "format".
    rows : dict of str to str
        Name → ``"module:object"``. No package can take the place of one of these.
    group : str
        Entry points whose names and objects come after them.
    """

    kind: str
    rows: Mapping[str, str]
    group: str

    def names(self) -> list[str]:
        """Names of all: btfref's own in their order, then those of packages that can be loaded, by the alphabet."""
        found, _ = usable_points(self.group)
        return [*self.rows, *sorted(found.keys() - self.rows.keys())]

    def load(self, name: str) -> Any:
        """The object of that name.

        Raises
        ------
        InputError
            When there is none, or its package cannot be loaded.
        """
        if name in self.rows:
            return imported(self.rows[name])
        return self._of_apackage_of(name)[1]

    def place(self, name: str) -> str:
        """``"module:object"`` of that name.

        Raises
        ------
        InputError
            As `load`.
        """
        return self.rows[name] if name in self.rows else self._of_apackage_of(name)[0]

    def _of_apackage_of(self, name: str) -> tuple[str, Any]:
        """``"module:object"`` of another package's entry point, and the object."""
        found, broken = usable_points(self.group)
        if name in found:
            place = next(point.value for point in entry_points(group=self.group) if point.name == name)
            return place, found[name]
        if name in broken:
            raise InputError(f"a {self.kind} of another package: {broken[name]}", field=self.kind)
        raise InputError(
            f"unknown {self.kind}",
            field=self.kind,
            got=repr(name),
            expected=f"one of {', '.join(self.names())}",
        )
