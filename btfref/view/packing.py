"""Tables as short text that the page turns back into what they were (``btfref/view/assets/unpack.js``)."""

from __future__ import annotations

import base64
import zlib

import numpy as np

from btfref.errors import InputError
from btfref.types import Facts

#: Letters of all tables of a page, packed. Chromium's strings end at 512 MiB, and a browser holds a table several times
#: while it is unpacked.
LARGEST = 256 << 20

#: Above this many bytes compression has to be quick.
_LARGE = 32 << 20


class Packed:
    """Tables of a page: each is an element of its own, so that a page can let go of what it has uploaded."""

    def __init__(self) -> None:
        self.blobs: dict[str, str] = {}
        self.letters = 0

    def add(self, values: np.ndarray) -> Facts:
        """Keep a table.

        Parameters
        ----------
        values : ndarray of float16, float32, uint32 or uint8

        Returns
        -------
        dict
            ``blob``, the element's name, and ``type``.

        Raises
        ------
        InputError
            When all tables together are larger than a page can hold.
        """
        little = np.ascontiguousarray(values, values.dtype.newbyteorder("<"))
        # First bytes, then second ones, and so on: those with the exponents repeat.
        planes = little.view(np.uint8).reshape(-1, values.dtype.itemsize).T.tobytes()
        name = f"table-{len(self.blobs)}"
        packed = zlib.compress(planes, 1 if values.nbytes > _LARGE else 6)
        self.letters += 4 * (-(-len(packed) // 3))
        if self.letters > LARGEST:
            raise InputError(
                "too much for a page",
                field="tables",
                got=f"{self.letters >> 20} MiB, packed",
                expected=f"at most {LARGEST >> 20} MiB: a compressed method, or fewer files",
            )
        self.blobs[name] = base64.b64encode(packed).decode("ascii")
        return {"blob": name, "type": values.dtype.name}
