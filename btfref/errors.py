"""Errors that a user can mend; the command line turns them into one line and exit status 2."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from btfref.types import PathLike


class BtfrefError(Exception):
    """Base class of the errors that btfref raises on purpose."""


class InputError(BtfrefError, ValueError):
    """A file or an argument that cannot be used.

    Parameters
    ----------
    message : str
        What is wrong, in one line.
    file : path-like, optional
        The file that holds the offending value.
    field : str, optional
        The attribute, option, header field or plugin parameter.
    got, expected : object, optional
        The value found and the value (or set of values) wanted.
    """

    def __init__(
        self,
        message: str,
        *,
        file: PathLike | None = None,
        field: str | None = None,
        got: object = None,
        expected: object = None,
    ) -> None:
        self.message, self.file, self.field, self.got, self.expected = message, file, field, got, expected
        parts = [f"{file}: {message}" if file is not None else message]
        if field is not None:
            parts.append(f"field '{field}'")
        if got is not None:
            parts.append(f"got {got}")
        if expected is not None:
            parts.append(f"expected {expected}")
        super().__init__("; ".join(" ".join(str(part).split()) for part in parts))


class MissingDependencyError(BtfrefError):
    """Something that the machine lacks, with the command that brings it.

    Parameters
    ----------
    what : str
        The library or program that is missing and what needs it.
    mend : str
        What to install or set.
    """

    def __init__(self, what: str, mend: str) -> None:
        self.what, self.mend = what, mend
        super().__init__(f"{what}; {mend}")
