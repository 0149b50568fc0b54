"""From a measured BTF to a store: the one place where a file's quantity becomes B, view by view."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np

from btfref.errors import InputError
from btfref.formats import open_source
from btfref.formats.source import MEMORY, Source
from btfref.outputs import require_folder_of
from btfref.provenance import versions
from btfref.sampling.store.layout import TILE, remove_leftovers, remove_store
from btfref.sampling.store.lock import writing
from btfref.sampling.store.resume import resumable
from btfref.sampling.store.store import BTFStore, create_store
from btfref.types import Facts, PathLike, Progress


def import_btf(
    path: PathLike,
    out: PathLike,
    *,
    format: str | None = None,
    overwrite: bool = False,
    dtype: str = "float16",
    cosine: str | None = None,
    scale: float | None = None,
    rows: str = "up",
    memory: int = MEMORY,
    progress: Progress | None = None,
    **options: object,
) -> BTFStore:
    """Convert a measured BTF to a store.

    Parameters
    ----------
    path : path-like
        File, folder or archive.
    out : path-like
        ``NAME.btf.zarr``. An interrupted conversion is continued, a finished one of the same settings is
        returned as it is.
    format : str, optional
        Found from the file when left out.
    overwrite : bool
        Replace a store of other settings.
    dtype : {"float16", "float32"}
        Type of the stored values.
    cosine : {"included", "excluded"}, optional
        Whether the file's values hold cos θ_light; by default what the format says.
    scale : float, optional
        Factor from the file's values to 1/sr; by default what the format says.
    rows : {"up", "down"}
        "up": the top of a picture is v = 1, as in OBJ files and Mitsuba's bitmaps, so that x, y and the normal
        are right-handed as one looks at the picture. "down": the top is v = 0.
    memory : int
        Bytes to hold at a time, beside the file's own pages.
    progress : callable, optional
        Called as ``progress(done, total, label)`` after each view.
    **options
        Of the format.

    Returns
    -------
    BTFStore
        Complete, but for images that are missing (``allow_missing``).

    Raises
    ------
    InputError
        A file or setting that cannot be used; a store that this call began is removed.

    Notes
    -----
    B = scale · value, times cos θ_light where the value does not hold it. Where the light was moved out of the
    camera's way the value is taken for the nominal light: B = scale · value · cos θ_nominal / cos θ_moved.
    """
    out = Path(out)
    _one_of("dtype", dtype, ("float16", "float32"))
    _one_of("cosine", cosine, (None, "included", "excluded"))
    _one_of("rows", rows, ("up", "down"))
    if scale is not None and not (isinstance(scale, int | float) and 1e-12 < scale < 1e12):
        raise InputError("scale", field="scale", got=scale, expected="a positive number")
    if isinstance(memory, bool) or not isinstance(memory, int) or memory < 1 << 20:
        raise InputError("memory", field="memory", got=memory, expected="at least 1 MiB")
    source = open_source(path, format=format, **options)
    source.memory = memory
    included = source.cosine_included if cosine is None else cosine == "included"
    scale = float(source.scale if scale is None else scale)
    block = _lights_at_a_time(source, dtype, memory)
    attributes: Facts = {
        "seed": None,
        "parameters": {
            "cosine_included": included,
            "scale": scale,
            "rows": rows,
            "dtype": dtype,
            "tile": TILE,
            **{key: value for key, value in options.items() if isinstance(value, str | int | float)},
        },
        "parent": {
            "kind": "measured-btf",
            "name": source.path.name,
            "format": source.format,
            "fingerprint": source.digest(),
            "images_missing": int((~source.present).sum()),
            "lights_moved": [
                {"view": int(v), "light": int(light), "stood_at_degrees": [float(a) for a in angles]}
                for (v, light), angles in sorted(source.moved.items())
            ],
        },
        "versions": versions(("numpy",)),
    }
    with writing(out):
        return _converted(source, out, attributes, overwrite, block, progress)


def _converted(
    source: Source, out: Path, attributes: Facts, overwrite: bool, block: int, progress: Progress | None
) -> BTFStore:
    """:func:`import_btf`, while no other process writes there."""
    settings = attributes["parameters"]
    included, scale, rows, dtype = (settings[k] for k in ("cosine_included", "scale", "rows", "dtype"))
    remove_leftovers(out)
    store = None
    if out.exists() or out.is_symlink():
        store = resumable(out, source.views, source.lights, attributes, overwrite)
    begun = store is None
    if store is None:
        _room_for(source, out, dtype)
        store = create_store(
            out,
            views=source.views,
            lights=source.lights,
            texels=source.texels,
            dtype=dtype,
            variance=False,
            attributes=attributes,
        )
    try:
        _fill(store, source, _factors(source, included, scale), rows == "up", block, progress)
    except InputError:
        if begun:
            remove_store(out)
        raise
    return store


def _fill(
    store: BTFStore, source: Source, factors: np.ndarray, flip: bool, block: int, progress: Progress | None
) -> None:
    """Write the views that are not there yet."""
    n_lights, tiles = len(source.lights), store.coverage.shape[2:]
    covered = np.all(store.coverage.all(axis=(2, 3)) | ~source.present, axis=1)
    views = np.flatnonzero(source.present.any(axis=1))
    done = int(covered[views].sum())
    rows, columns = np.indices(tiles)
    every = rows.ravel(), columns.ravel()
    for view in views[~covered[views]]:
        view = int(view)
        values = np.zeros((n_lights, *source.texels, 3), store.dtype)
        for first in range(0, n_lights, block):
            last = min(first + block, n_lights)
            here = source.present[view, first:last]
            if not here.any():
                continue
            with np.errstate(over="ignore", invalid="ignore"):
                part = source.colours(view, first, last)
                part = part * factors[view, first:last, None, None, None]
                values[first:last] = part[:, ::-1] if flip else part
            _check(values[first:last], here, source, view, first)
        present = source.present[view]
        if present.all():
            store.write_view(view, values)
        else:
            store.write_part(view, np.flatnonzero(present), every, values[present])
        if source.release is not None:
            source.release()
        done += 1
        if progress is not None:
            progress(done, len(views), "import")


def _check(values: np.ndarray, present: np.ndarray, source: Source, view: int, first: int) -> None:
    """InputError with the pair of the first value that is not finite."""
    bad = ~np.isfinite(values).all(axis=(1, 2, 3)) & present
    if bad.any():
        raise InputError(
            f"value that is not finite (or beyond {values.dtype})",
            file=source.path,
            field=f"view {view}, light {first + int(np.flatnonzero(bad)[0])}",
            expected="finite values; float32 holds larger ones",
        )


def _factors(source: Source, included: bool, scale: float) -> np.ndarray:
    """Factor from the file's quantity to B, float32 of shape (views, lights)."""
    cosine = np.maximum(source.lights.vectors[:, 2], 0)
    factors = np.repeat(scale * (np.ones_like(cosine) if included else cosine)[None], len(source.views), 0)
    if included:
        for (view, light), (theta, _) in source.moved.items():
            factors[view, light] *= cosine[light] / max(np.cos(np.radians(theta)), 1e-3)
    return factors.astype(np.float32)


def _lights_at_a_time(source: Source, dtype: str, memory: int) -> int:
    """How many lights are decoded together so that all stays within ``memory``."""
    picture = source.texels[0] * source.texels[1] * 3
    view = picture * len(source.lights) * np.dtype(dtype).itemsize
    # Half for the view, its shard as Zarr assembles it and the shard's bytes; a quarter for colours with three
    # temporaries in float32; a quarter for what the format keeps.
    need = max(2 * 3 * view, 4 * 16 * picture)
    if need > memory:
        raise InputError(
            "one view needs more memory than allowed",
            file=source.path,
            field="memory",
            got=f"{memory} bytes",
            expected=f"at least {need} bytes",
        )
    return int(min(len(source.lights), memory // 4 // (16 * picture)))


def _room_for(source: Source, out: Path, dtype: str) -> None:
    """InputError when the disk cannot hold the store."""
    require_folder_of(out)
    need = int(source.present.sum()) * source.texels[0] * source.texels[1] * 3 * np.dtype(dtype).itemsize
    free = shutil.disk_usage(out.absolute().parent).free
    if need > free:
        raise InputError(
            "not enough room on the disk", file=out, got=f"{free} bytes", expected=f"{need} bytes"
        )


def _one_of(field: str, value: object, known: tuple[object, ...]) -> None:
    if value not in known:
        expected = " or ".join(str(one) for one in known if one is not None)
        raise InputError("setting of the import", field=field, got=repr(value), expected=expected)
