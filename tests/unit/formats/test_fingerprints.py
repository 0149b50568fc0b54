"""A re-import sees pixels that changed under the same names and sizes, in every kind of source."""

import os
import zipfile

import formats_material as material
import numpy as np
import pytest

from btfref.errors import InputError
from btfref.formats import import_btf
from btfref.numerics.colour import RGB_TO_XYZ


def folder(path, values):
    """A UBO folder of PNG pictures, all of one size in bytes whatever they show."""
    path.mkdir(exist_ok=True)
    for view, row in zip(material.ANGLES, values, strict=True):
        for light, image in zip(material.ANGLES, row, strict=True):
            name = "tl{:03d} pl{:03d} tv{:03d} pv{:03d}.png".format(*light, *view)
            (path / name).write_bytes(material.picture(image))


def archive(path, values):
    """The same in an archive."""
    inner = path.with_suffix(".d")
    folder(inner, values)
    with zipfile.ZipFile(path, "w") as target:
        for picture in sorted(inner.iterdir()):
            target.writestr(picture.name, picture.read_bytes())


def merl(path, values):
    table = np.ones((3, 4, 5))
    table[-1, -1, -1] = values[0, 0, 0, 0, 0] + 1
    path.write_bytes(material.merl(lambda h, d, p: np.repeat(table[..., None], 3, -1), (3, 4, 5)))


def mif(path, values):
    pairs = [(light, view) for view in material.ANGLES for light in material.ANGLES]
    images = [image.astype(np.float16) for image in (values @ RGB_TO_XYZ.T * 100).reshape(25, 2, 3, 3)]
    path.write_bytes(material.mif(images, pairs))


def bonn(path, values):
    path.write_bytes(material.bdi(values))


@pytest.mark.parametrize(
    ("name", "make"),
    [("ubo", folder), ("x.zip", archive), ("x.binary", merl), ("x.mif", mif), ("x.btf", bonn)],
)
def test_changed_pixels_are_seen(tmp_path, name, make):
    options = {"views": "2x4", "lights": "2x4"} if name == "x.binary" else {}
    values = material.pictures(2, 3)
    make(tmp_path / name, values)
    out = tmp_path / "out.btf.zarr"
    import_btf(tmp_path / name, out, **options)
    # The same bytes at another time are the same.
    for path in [tmp_path / name, *(tmp_path / name).rglob("*")]:
        os.utime(path, (1, 1))
    import_btf(tmp_path / name, out, **options)
    changed = values.copy()
    changed[:, :, -1, -1] = changed[:, :, 0, 0]
    changed[0, 0, 0, 0, 0] += 1
    make(tmp_path / name, changed)
    with pytest.raises(InputError, match="fingerprint"):
        import_btf(tmp_path / name, out, **options)
