"""A texture for Mitsuba that looks at numbers of the vertices: other texture coordinates, factors, a cutoff.

Mitsuba's ``bitmap`` knows one set of texture coordinates, and nothing multiplies an image by a mesh's colours.
"""

from __future__ import annotations

from types import ModuleType
from typing import TYPE_CHECKING

from btfref.types import Facts

if TYPE_CHECKING:
    from btfref.types import JitArray

#: Name of the plugin in a BSDF's dict.
PLUGIN = "btfref_vertices"

#: Mitsuba wants this before the name of an attribute of vertices.
ATTRIBUTES = "vertex_"

_REGISTERED: set[str] = set()


def vertex_texture(
    image: Facts | None = None,
    *,
    uv: str | None = None,
    values: str | None = None,
    cutoff: float | None = None,
) -> Facts:
    """An image at other texture coordinates, times numbers of the vertices, and 0 or 1 where there is a cutoff.

    Parameters
    ----------
    image : dict, optional
        A texture; 1 when not given.
    uv, values : str, optional
        Attributes of the part's vertices, of 2 numbers, and of as many as the texture has.
    cutoff : float, optional
        1 where the product is at least as large, else 0.

    Returns
    -------
    dict
        For a BSDF's dict.
    """
    given = {"image": image, "uv": uv, "values": values, "cutoff": cutoff}
    return {"type": PLUGIN, **{key: value for key, value in given.items() if value is not None}}


def register(mi: ModuleType) -> None:
    """Make the plugin known to the current variant."""
    if mi.variant() in _REGISTERED:
        return
    _REGISTERED.add(mi.variant())
    import drjit as dr

    class VertexTexture(mi.Texture):  # type: ignore[name-defined]  # of the current variant
        def __init__(self, props: JitArray) -> None:
            mi.Texture.__init__(self, props)
            self.image = props.get("image", None)
            self.uv, self.values = props.get("uv", ""), props.get("values", "")
            self.cutoff = props.get("cutoff", None)

        def _place(self, si: JitArray, active: JitArray) -> JitArray:
            if not self.uv:
                return si
            place = type(si)(si)
            # Mitsuba hands attributes out in ones and threes; those of two are kept as three.
            found = si.shape.eval_attribute_3(ATTRIBUTES + self.uv, si, active)
            place.uv = mi.Point2f(found.x, found.y)
            return place

        def _kept(self, value: JitArray) -> JitArray:
            return (
                value
                if self.cutoff is None
                else dr.select(value >= self.cutoff, type(value)(1), type(value)(0))
            )

        def eval(self, si: JitArray, active: JitArray = True) -> JitArray:
            """Colours."""
            value = mi.Color3f(1)
            if self.image is not None:
                value *= mi.Color3f(self.image.eval(self._place(si, active), active))
            if self.values:
                value *= mi.Color3f(si.shape.eval_attribute_3(ATTRIBUTES + self.values, si, active))
            return self._kept(value)

        def eval_3(self, si: JitArray, active: JitArray = True) -> JitArray:
            """As :meth:`eval`."""
            return self.eval(si, active)

        def eval_1(self, si: JitArray, active: JitArray = True) -> JitArray:
            """Numbers."""
            value = mi.Float(1)
            if self.image is not None:
                value *= self.image.eval_1(self._place(si, active), active)
            if self.values:
                value *= si.shape.eval_attribute_1(ATTRIBUTES + self.values, si, active)
            return self._kept(value)

        def mean(self) -> JitArray:
            """Of the image alone: a weight for sampling."""
            return mi.Float(0.5) if self.image is None else self.image.mean()

        def is_spatially_varying(self) -> bool:
            """Always."""
            return True

        def to_string(self) -> str:
            """For messages."""
            return f"{PLUGIN}[uv = {self.uv!r}, values = {self.values!r}]"

    mi.register_texture(PLUGIN, VertexTexture)
