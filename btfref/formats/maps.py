"""The maps of a representation as images that any viewer opens."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from btfref.errors import InputError
from btfref.outputs import new_folder
from btfref.registry import method
from btfref.types import Facts, PathLike

if TYPE_CHECKING:
    from btfref.representations.protocol import Representation


def export_maps(path: PathLike, out: PathLike) -> Facts:
    """Write every map as one OpenEXR image or, beyond four channels, as one per channel.

    A method whose maps are made for editing has a way of its own: ``export_maps`` in its row's ``editing``.

    Parameters
    ----------
    path : path-like
        Representation.
    out : path-like
        Folder to make.

    Returns
    -------
    dict
        ``maps`` and ``images``: how many.

    Raises
    ------
    InputError
        No representation, or an existing path.

    Notes
    -----
    Axes before the last fold into rows and columns as in the representation's file: trailing ones into columns while
    they fit. Indices are written as floats.
    """
    from btfref.images.decoding import write_exr
    from btfref.representations.file.container import load
    from btfref.representations.file.map_images import image_size

    representation = load(path)
    row = method(representation.meta["method"])
    if row.editing:
        return row.editor.export_maps(representation, out)
    arrays = representation.arrays()
    count = 0
    with new_folder(out) as folder:
        for name, array in arrays.items():
            array = np.asarray(array)
            image = array.reshape(*image_size(array.shape), array.shape[-1]).astype(np.float32)
            groups = (
                {"": image}
                if image.shape[-1] <= 4
                else {f".{c:04d}": image[..., c : c + 1] for c in range(image.shape[-1])}
            )
            for suffix, planes in groups.items():
                names = {1: "Y", 2: "RG", 3: "RGB", 4: "RGBA"}[planes.shape[-1]]
                write_exr(
                    dict(zip(names, np.moveaxis(planes, -1, 0), strict=True)),
                    folder / f"{name}{suffix}.exr",
                    np.float32,
                )
                count += 1
    return {"format": "maps", "maps": len(arrays), "images": count}


def import_maps(folder: PathLike) -> Representation:
    """A representation from a folder of edited maps: that of the method which ``maps.toml`` names.

    Raises
    ------
    InputError
        No such file, or a method that does not take its maps back.
    """
    import tomllib

    path = Path(folder) / "maps.toml"
    try:
        key = str(tomllib.loads(path.read_text(encoding="utf-8")).get("method", ""))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InputError("cannot read the scalars", file=path, got=error) from error
    row = method(key, file=path)
    if not row.editing:
        raise InputError("the method does not take its maps back", file=path, field="method", got=key)
    return row.editor.import_maps(folder)
