"""What a suite is asked for: the same of all of them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from btfref.errors import InputError

if TYPE_CHECKING:
    from btfref.sampling import SampledBTF
    from btfref.types import PathLike, Progress


@dataclass(frozen=True)
class Options:
    """What a suite is asked for; each says in its ``run`` what it makes of it.

    Attributes
    ----------
    quick : bool
        Less data or fewer rounds.
    progress : callable, optional
        Called as ``progress(done, total, label)``.
    btf : SampledBTF, optional
        In place of the suite's own data.
    only : sequence of str, optional
        Some of what the suite goes through.
    report : path-like, optional
        Page to write, of suites that make pictures.
    """

    quick: bool = False
    progress: Progress | None = None
    btf: SampledBTF | None = None
    only: Sequence[str] | None = None
    report: PathLike | None = None

    def tell(self, done: int, total: int, label: str) -> None:
        """Report progress, where anybody listens."""
        if self.progress is not None:
            self.progress(done, total, label)

    def wants(self, name: str) -> bool:
        """Whether a part of the suite is asked for."""
        return self.only is None or name in self.only

    def demand(self, names: Iterable[str]) -> None:
        """Say what the suite goes through.

        Raises
        ------
        InputError
            For a name in ``only`` that is not among them.
        """
        known = list(names)
        if unknown := [name for name in self.only or () if name not in known]:
            raise InputError(
                "nothing of that name", field="--only", got=", ".join(unknown), expected=", ".join(known)
            )
