"""A sampled BTF as a representation for the page: as it is while it is small, compressed quickly otherwise."""

from __future__ import annotations

from btfref.registry import method
from btfref.representations.fit_memory import read_within
from btfref.representations.protocol import Representation
from btfref.sampling import open_store
from btfref.types import PathLike, Progress

#: Bytes of the table of `raw`: 16-bit floats, four channels. Up to here a sampled BTF is shown as it is.
AS_IT_IS = 24 << 20

#: What a larger one is compressed with: enough to look at, and quick.
QUICK = {"clusters": 8, "components": 4}


def quick_representation(
    path: PathLike, *, memory: int | None = None, progress: Progress | None = None
) -> tuple[Representation, str]:
    """What is shown of a sampled BTF, and a note that says so.

    Parameters
    ----------
    path : path-like
        ``….btf.zarr``.
    memory : int, optional
        Budget of a fit in bytes; default: half of the machine's.
    progress : callable, optional
        ``progress(done, total, label)``.

    Returns
    -------
    representation : Representation
    note : str

    Raises
    ------
    InputError
        For a store that is missing, broken or incomplete, or a fit beyond the budget.
    """
    store = open_store(path)
    views, lights, rows, columns = len(store.views), len(store.lights), *store.texels
    table = views * lights * rows * columns * 4 * 2
    key, settings = ("raw", {}) if table <= AS_IT_IS else ("lpca", dict(QUICK))
    row = method(key)
    btf = read_within(row, store, memory, settings)
    fitted = row.fitting.fit(btf, **({"progress": progress} if progress else {}), **settings)
    if key == "raw":
        return fitted, "A sampled BTF, shown as it is (method raw)."
    error = float(fitted.meta["fit"]["error"]) ** 0.5
    chosen = ", ".join(f"{value} {name}" for name, value in settings.items())
    return fitted, (
        f"A sampled BTF of {table >> 20} MiB, shown through a quick compression (method lpca, {chosen}; relative RMS"
        f" error {100 * error:.2g} %), not as it is. For more, fit it and view the file."
    )
