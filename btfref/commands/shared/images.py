"""Images and pixel classes as the commands write and read them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from btfref.errors import InputError
from btfref.types import PathLike

if TYPE_CHECKING:
    import numpy as np

    from btfref.types import Facts


def write_images(
    image: np.ndarray,
    out: Path,
    facts: Facts,
    *,
    png: bool = False,
    classes: np.ndarray | None = None,
    classes_out: Path | None = None,
) -> None:
    """Write a linear image as float32 EXR, and what else was asked for.

    Parameters
    ----------
    image : ndarray, shape (H, W, 3)
    out : pathlib.Path
        The EXR file; `png` adds a tone-mapped PNG of the same name.
    facts : dict
        What the picture shows, see :mod:`btfref.rendering.picture`: the EXR file holds it.
    classes : ndarray of uint8, shape (H, W), optional
        Pixel classes, written to `classes_out`.
    """
    from btfref.images import save_image
    from btfref.rendering.picture import attributes

    save_image(out, image, attributes=attributes(facts))
    if png:
        save_image(out.with_suffix(".png"), image)
    if classes is not None and classes_out is not None:
        save_classes(classes_out, classes)


#: Grey levels of a class file in the order of `btfref.conventions.PixelClass`, so that a person sees the classes.
_CLASS_GREYS = (0, 100, 200, 250, 150, 50, 225)


def save_classes(path: Path, classes: np.ndarray) -> None:
    """Write pixel classes (see `btfref.scene.pixel_classes`) as a grey PNG."""
    import numpy as np

    from btfref.images.png import encode_png
    from btfref.outputs import new_file

    with new_file(path) as draft:
        draft.write_bytes(encode_png(np.array(_CLASS_GREYS, np.uint8)[classes]))


def load_classes(path: PathLike) -> np.ndarray:
    """Pixel classes as `save_classes` wrote them.

    Returns
    -------
    ndarray of uint8, shape (H, W)

    Raises
    ------
    InputError
        When the file is missing, not a PNG, or holds another grey level.
    """
    import numpy as np
    from PIL import Image

    try:
        with Image.open(path) as image:
            grey = np.asarray(image.convert("L"))
    except FileNotFoundError:
        raise InputError("no such file", file=path, field="--classes") from None
    except (OSError, SyntaxError, ValueError):
        raise InputError("cannot be read as PNG", file=path, field="--classes") from None
    known = list(_CLASS_GREYS)
    if not np.isin(grey, known).all():
        odd = int(grey[~np.isin(grey, known)][0])
        raise InputError("not pixel classes", file=path, got=f"grey level {odd}", expected=sorted(known))
    codes = np.zeros(256, np.uint8)
    codes[known] = range(len(known))
    return codes[grey]
