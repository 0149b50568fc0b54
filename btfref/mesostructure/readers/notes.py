"""What of a user's input is ignored, one line of each kind."""

from __future__ import annotations


class Notes:
    """Kinds of things that are ignored, each with the names that have it."""

    def __init__(self) -> None:
        self._kinds: dict[str, list[str]] = {}

    def add(self, what: str, name: str | None = None) -> None:
        """Note one thing.

        Parameters
        ----------
        what : str
            Its kind, for people.
        name : str, optional
            Who has it: a material, a file.
        """
        names = self._kinds.setdefault(what, [])
        if name is not None and name not in names:
            names.append(name)

    def lines(self) -> tuple[str, ...]:
        """One line of each kind, in the order in which they were met."""
        return tuple(
            what + (f" ({', '.join(names)})" if names else "") for what, names in self._kinds.items()
        )
