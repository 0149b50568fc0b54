"""Writing beside making: parts of a store go to its files in a thread of their own while the next ones are traced."""

from __future__ import annotations

import queue
import threading
from types import TracebackType
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from btfref.sampling.store.store import BTFStore


class Writer:
    """Writes parts of a store one after the other, in the order in which they come; use it as a context.

    The order is that of a single thread, so that a killed run has a beginning of what was made and nothing else. After
    an error nothing more is written; whoever comes next with a part, or the end of the context, raises it.

    Parameters
    ----------
    store : BTFStore
        Nobody else writes the same views meanwhile.
    most : int
        Bytes of parts that wait, at most; one part may be larger.
    """

    def __init__(self, store: BTFStore, most: int) -> None:
        self.store, self.most = store, most
        self._parts: dict[int, tuple[Callable[[], None], int]] = {}
        self._count = 0
        self._todo: queue.SimpleQueue[int | None] = queue.SimpleQueue()
        self._done: queue.SimpleQueue[int] = queue.SimpleQueue()
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._work, name="btfref-writer", daemon=True)

    def __enter__(self) -> Writer:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._todo.put(None)
        self._thread.join()
        self._parts.clear()
        if error is None:
            self._raise()

    def write_part(
        self,
        view: int,
        lights: np.ndarray,
        tiles: tuple[np.ndarray, np.ndarray],
        values: np.ndarray,
        variance: np.ndarray | None = None,
        *,
        origin: tuple[int, int] = (0, 0),
    ) -> None:
        """Have a part written, as `BTFStore.write_part` does; its arrays must not change any more.

        Raises
        ------
        InputError, OSError
            What an earlier part met.
        """
        size = values.nbytes + (0 if variance is None else variance.nbytes)
        while self._parts and sum(held for _, held in self._parts.values()) + size > self.most:
            self._forget(self._done.get())
        while not self._done.empty():
            self._forget(self._done.get())
        self._raise()

        def write() -> None:
            self.store.write_part(view, lights, tiles, values, variance, origin=origin)

        self._parts[self._count] = write, size
        self._todo.put(self._count)
        self._count += 1

    def _forget(self, number: int) -> None:
        """Let go of a part: here, since arrays of Dr.Jit are freed best by the thread that made them."""
        del self._parts[number]

    def _raise(self) -> None:
        if self._error is not None:
            raise self._error

    def _work(self) -> None:
        while (number := self._todo.get()) is not None:
            if self._error is None:
                try:
                    self._parts[number][0]()
                except BaseException as error:  # raised where the next part comes from
                    self._error = error
            self._done.put(number)
