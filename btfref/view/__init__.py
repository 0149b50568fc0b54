"""A page to look at BTFs with: one file for a browser, in which the real-time shaders run in WebGL 2."""

from btfref.view.material import Material
from btfref.view.page import build_page, write_page
from btfref.view.shapes import Shape, mesh_shape, shipped_shapes

__all__ = ["Material", "Shape", "build_page", "mesh_shape", "shipped_shapes", "write_page"]
