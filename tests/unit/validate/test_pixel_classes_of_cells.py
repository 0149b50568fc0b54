"""Which pixels a cell judges strictly: those of its own material, where that has a geometry of its own."""

from types import SimpleNamespace

import numpy as np
import pytest

from btfref.conventions import PixelClass
from btfref.scene.pixel_classes import pixel_classes
from btfref.scene.shipped import scene_file
from btfref.validate.cell import _classes
from btfref.validate.matrix import LIGHTS, Spec


@pytest.mark.parametrize("key", ["svd", "gbrdf"])
def test_edges_of_a_height_field_are_those_of_the_cell_s_method(key, fits, llvm):
    """What all methods share was found with a material without heights."""
    scene = scene_file("cloth")

    def shared(file, lights="directional1"):
        return {"parameters": {"btf": str(file), **LIGHTS[lights]}, "grid": 2, "size": (24, 24)}

    views = SimpleNamespace(classes=pixel_classes(scene, **shared(fits.path("lpca"))))
    assert not (views.classes == PixelClass.MESOSTRUCTURE).any()
    own = shared(fits.path(key))
    found = _classes(scene, Spec("checker", key, "cloth", "directional1"), views, own)
    edges = found == PixelClass.MESOSTRUCTURE
    assert edges.any() == (key == "gbrdf")
    np.testing.assert_array_equal(found[~edges], views.classes[~edges])
    # Under an environment no light has a border.
    under = Spec("checker", key, "cloth", "sky")
    assert _classes(scene, under, views, shared(fits.path(key), "sky")) is views.classes
