"""Reading a sampled BTF view by view or by rows, whether it stands on disk or in memory."""

from __future__ import annotations

import numpy as np

from btfref.errors import InputError


class _Stored:
    def __init__(self, store):
        self._store = store
        self.views, self.lights, self.texels = store.views, store.lights, store.texels

    def view(self, view):
        return self._store.read(views=view, variance=False)[0][0]

    def rows(self, first, last):
        return self._store.read(rows=slice(first, last), variance=False)[0]


class _InMemory:
    def __init__(self, btf):
        self._values = btf.values
        self.views, self.lights, self.texels = btf.views, btf.lights, btf.texels

    def view(self, view):
        return self._values[view]

    def rows(self, first, last):
        return self._values[:, :, first:last]


def open_parts(btf):
    """Parts of a `BTFStore` (which must be complete) or a `SampledBTF`.

    Returns
    -------
    object
        ``views``, ``lights``, ``texels``; ``view(i)`` of shape (lights, rows, columns, 3) and
        ``rows(first, last)`` of shape (views, lights, last − first, columns, 3).
    """
    if isinstance(getattr(btf, "values", None), np.ndarray):
        return _InMemory(btf)
    if not btf.complete:
        raise InputError("incomplete", file=btf.path, field="coverage", got=f"{btf.coverage.mean():.1%}")
    return _Stored(btf)
