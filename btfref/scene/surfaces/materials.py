"""Materials beside BTFs: ``diffuse`` as it is, every other one as its mean albedo.

What real-time rendering shows of a ``diffuse`` of one colour or with a ``bitmap``, one-sided or inside a ``twosided``,
is Mitsuba's own. All other BSDFs are shown as a Lambertian surface of their albedo: the mean of what Mitsuba's
``sample`` reflects, over the shape's area and over views of cosine distribution (the bihemispherical reflectance).
Pixels that see one are of class *other*.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from types import ModuleType
from typing import TYPE_CHECKING, Any, ClassVar, cast

import numpy as np
from numpy.typing import ArrayLike

from btfref.conventions import valid_directions
from btfref.errors import InputError
from btfref.numerics.colour import decode_srgb
from btfref.numerics.sphere.frames import Turn
from btfref.types import Facts, JitArray

if TYPE_CHECKING:
    from btfref.representations.protocol import Representation
    from btfref.scene.parsing import ParsedScene

#: How a bitmap continues beyond its borders, by the number that shaders know.
WRAP_MODES = ("repeat", "mirror", "clamp")

#: Samples of an albedo: their lattice leaves some tenths of a per cent.
SAMPLES = 1024

#: Increments of an additive recurrence in seven dimensions, powers of the inverse of the root of x^8 = x + 1
#: (M. Roberts, "The unreasonable effectiveness of quasirandom sequences", 2018).
_STEPS = 1.0969815577985598 ** -np.arange(1.0, 8.0)


@dataclass(frozen=True, eq=False)
class PlainMaterial:
    """A Lambertian surface that looks alike from all sides; a representation as well.

    Parameters
    ----------
    texels : ndarray of float32, shape (rows, columns, 3)
        Reflectance, linear Rec. 709; one texel for a colour.
    filter_type : {"nearest", "bilinear"}
    wrap_mode : {"repeat", "mirror", "clamp"}
    to_uv : ndarray, shape (2, 3)
        Coordinates of the lookup are ``to_uv @ (u, v, 1)``.
    twosided : bool
        Seen from behind as from the front, and not black.
    exact : bool
        It is the scene's own material; False: its albedo stands for it.
    """

    texels: np.ndarray
    filter_type: str = "bilinear"
    wrap_mode: str = "repeat"
    to_uv: np.ndarray = field(default_factory=lambda: np.eye(2, 3))
    twosided: bool = False
    exact: bool = True

    #: Its port in GLSL.
    SHADER: ClassVar[str] = "materials/diffuse.glsl"

    #: As of a BTF's material: nothing is scaled, turned or filtered.
    scale: ClassVar[float] = 1.0
    lod: ClassVar[str] = "none"
    lod_bias: ClassVar[float] = 0.0
    lod_unit: ClassVar[float] = 1.0
    interpolation: ClassVar[str] = "blended"
    turn: ClassVar[Turn] = Turn()

    @property
    def representation(self) -> Representation:
        """Itself, for hosts, which neither sample it nor read it from a file."""
        return cast("Representation", self)

    @property
    def albedo(self) -> np.ndarray:
        """Mean reflectance, shape (3,)."""
        return self.texels.reshape(-1, 3).mean(0, dtype=float)

    @property
    def meta(self) -> Facts:
        """What ports read of a representation."""
        wrap = {"wrap_mode": WRAP_MODES.index(self.wrap_mode)}
        texels = list(self.texels.shape[:2])
        return {"method": "diffuse", "filter_type": self.filter_type, "texels": texels, "constants": wrap}

    def arrays(self) -> dict[str, np.ndarray]:
        """Maps by name."""
        return {"reflectance": self.texels}

    def port_arrays(self) -> dict[str, np.ndarray]:
        """For ``shaders/materials/diffuse.glsl``."""
        return {"reflectance": np.pad(self.texels, [(0, 0), (0, 0), (0, 1)])}

    def evaluate(
        self, uv: ArrayLike, w_light: ArrayLike, w_view: ArrayLike, *, lod: ArrayLike = 0.0
    ) -> np.ndarray:
        """Reflectance / π times the light's cosine in float64, as Mitsuba's ``diffuse``; arguments as of a BTF."""
        w_light, w_view = np.asarray(w_light, float), np.asarray(w_view, float)
        lit = valid_directions(w_light) & valid_directions(w_view)
        cosine = np.where(lit, w_light[..., 2], 0.0)
        return self.reflectance(np.asarray(uv, float)) / np.pi * cosine[..., None]

    def reflectance(self, uv: np.ndarray) -> np.ndarray:
        """Filtered texels at transformed coordinates, shape (..., 2) -> (..., 3): Dr.Jit's textures."""
        size = np.array(self.texels.shape[1::-1])
        position = np.where(np.isfinite(uv), uv, 0.0) * size
        if self.filter_type == "nearest":
            return self._texel(np.floor(position).astype(np.int64)).astype(float)
        position = position - 0.5
        low = np.floor(position)
        x, y = np.moveaxis((position - low)[..., None], -2, 0)
        at = low.astype(np.int64)
        rows = []
        for k in (0, 1):
            left, right = (self._texel(at + np.array([j, k])).astype(float) for j in (0, 1))
            rows.append((1 - x) * left + x * right)
        return (1 - y) * rows[0] + y * rows[1]

    def _texel(self, at: np.ndarray) -> np.ndarray:
        """Texels by column and row, of any size."""
        size = np.array(self.texels.shape[1::-1])
        if self.wrap_mode == "clamp":
            at = np.clip(at, 0, size - 1)
        else:
            turn, at = np.divmod(at, size)
            if self.wrap_mode == "mirror":
                at = np.where(turn % 2 == 1, size - 1 - at, at)
        return self.texels[at[..., 1], at[..., 0]]


@dataclass(frozen=True)
class Bitmap:
    """Settings of the bitmap of a ``diffuse`` that Mitsuba's object does not tell."""

    filter_type: str
    wrap_mode: str
    raw: bool


def bitmap_of(parsed: ParsedScene, shape: JitArray) -> Bitmap | None:
    """Settings of the bitmap that a shape's ``diffuse`` has as its reflectance, or None."""
    from btfref.scene.parsing import is_kind

    node = next((child for _, child in parsed.children(shape) if is_kind(child, "BSDF")), None)
    if node is not None and node.props.plugin_name() == "twosided":
        node = next((child for _, child in parsed.children(node)), None)
    if node is None or node.props.plugin_name() != "diffuse":
        return None
    index = parsed.references(node).get("reflectance")
    if index is None or parsed.nodes[index].props.plugin_name() != "bitmap":
        return None
    props = parsed.nodes[index].props
    filter_type, wrap_mode, raw = (
        props[name] if name in props else default
        for name, default in (("filter_type", "bilinear"), ("wrap_mode", "repeat"), ("raw", False))
    )
    return Bitmap(str(filter_type), str(wrap_mode), bool(raw))


def held(thing: JitArray) -> dict[str, JitArray]:
    """Objects of Mitsuba that one holds, by name."""
    import mitsuba as mi

    found: dict[str, JitArray] = {}

    class Inner(mi.TraversalCallback):
        def put_object(self, name: str, value: Any, flags: int) -> None:
            self.put(name, value)

        def put_value(self, name: str, value: Any, *flags: object) -> None:
            pass

        def put(self, name: str, value: Any, *flags: object) -> None:
            if hasattr(value, "class_name"):
                found[name] = value

    thing.traverse(Inner())
    return found


def one_inside(bsdf: JitArray) -> JitArray:
    """The BSDF inside of a ``twosided`` that has the same one on both sides, or the BSDF itself."""
    if bsdf.class_name() != "TwoSidedBRDF":
        return bsdf
    sides = held(bsdf)
    front, back = sides.get("brdf_0"), sides.get("brdf_1")
    return front if front is not None and (back is None or back is front) else bsdf


def is_exact(bsdf: JitArray) -> bool:
    """Whether real-time rendering shows a BSDF of Mitsuba as it is: a BTF, or a ``diffuse`` of a colour or a bitmap."""
    from mitsuba_plugins.protocol import ShowsMethod

    inner = one_inside(bsdf)
    if isinstance(inner, ShowsMethod):
        return True
    if inner.class_name() != "SmoothDiffuse":
        return False
    texture = held(inner)["reflectance"]
    return not texture.is_spatially_varying() or texture.class_name().startswith("BitmapTextureImpl")


def plain_material(shape: JitArray, bitmap: Bitmap | None, types: ModuleType) -> PlainMaterial:
    """What is shown of a shape without a BTF.

    Parameters
    ----------
    shape : mitsuba.Shape
        Of a scalar variant, with its BSDF.
    bitmap : Bitmap or None
        See :func:`bitmap_of`.
    types : module
        Mitsuba's types of the shape's variant.
    """
    import mitsuba as mi

    bsdf = shape.bsdf()
    twosided = bool(int(bsdf.flags()) & int(mi.BSDFFlags.BackSide))
    if not is_exact(bsdf):
        return PlainMaterial(_texel(albedo(shape, types)), twosided=twosided, exact=False)
    if bitmap is None:
        si = types.SurfaceInteraction3f()
        si.wi = [0.0, 0.0, 1.0]
        return PlainMaterial(_texel(bsdf.eval_diffuse_reflectance(si, True)), twosided=twosided)
    values = mi.traverse(held(one_inside(bsdf))["reflectance"])
    texels = np.array(values["data"])
    if texels.dtype == np.uint8:
        coded = texels / 255.0
        texels = coded if bitmap.raw else decode_srgb(coded)
    texels = np.broadcast_to(texels.astype(np.float32), (*texels.shape[:2], 3))
    to_uv = np.array(values["to_uv"].matrix, float)[:2]
    return PlainMaterial(np.ascontiguousarray(texels), bitmap.filter_type, bitmap.wrap_mode, to_uv, twosided)


class PlainMaterials:
    """Those of a scene, each made once.

    Parameters
    ----------
    types : module
        Mitsuba's types of the scene's scalar variant.
    """

    def __init__(self, types: ModuleType) -> None:
        self._types = types
        self._made: list[tuple[JitArray, PlainMaterial]] = []

    def of(self, shape: JitArray, bitmap: Bitmap | None, *, file: str, name: str) -> PlainMaterial:
        """As :func:`plain_material`; an albedo is that on the first shape that has the material.

        Raises
        ------
        InputError
            For a material that Mitsuba itself cannot evaluate.
        """
        bsdf = shape.bsdf()
        for known, material in self._made:
            if known is bsdf:
                return material
        try:
            material = plain_material(shape, bitmap, self._types)
        except (RuntimeError, ValueError) as error:
            raise InputError(" ".join(str(error).split()), file=file, field=name) from error
        self._made.append((bsdf, material))
        return material

    @staticmethod
    def note(material: PlainMaterial, name: str, bsdf: str) -> list[str]:
        """What is said of a shape with a material: a line, or nothing where it is shown as it is."""
        if material.exact:
            return []
        colour = ", ".join(f"{value:.2g}" for value in material.albedo)
        return [f"{name}: {bsdf} is drawn as its mean albedo ({colour}), in pixels of class other"]


def _texel(colour: ArrayLike) -> np.ndarray:
    return np.array(colour, np.float32).reshape(1, 1, -1)[..., :3]


def albedo(shape: JitArray, types: ModuleType) -> np.ndarray:
    """Share of light that a shape's material reflects, shape (3,): over its area, views, and directions it samples.

    Parameters
    ----------
    shape : mitsuba.Shape
        Of a scalar variant.
    types : module
        Mitsuba's types of the shape's variant.
    """
    import mitsuba as mi

    bsdf, context, total = shape.bsdf(), mi.BSDFContext(), np.zeros(3)
    numbers = (np.arange(SAMPLES)[:, None] * _STEPS + 0.5) % 1.0
    for si, (lobe, u, v, x, y) in zip(_places(shape, numbers[:, :2], types), numbers[:, 2:], strict=True):
        # Views of cosine distribution: each counts as one.
        radius, angle = np.sqrt(x), 2 * np.pi * y
        si.wi = [radius * np.cos(angle), radius * np.sin(angle), np.sqrt(max(1 - x, 1e-12))]
        sample, weight = bsdf.sample(context, si, lobe, [u, v], True)
        if sample.wo.z > 0:
            total += np.nan_to_num(np.array(weight, float).ravel()[:3], posinf=0.0)
    return np.clip(total / SAMPLES, 0, 1)


def _places(shape: JitArray, numbers: np.ndarray, types: ModuleType) -> Iterator[JitArray]:
    """Points of a shape, evenly over its area, in a frame of their own."""
    import mitsuba as mi

    rows: list[tuple[Any, Any, int]]
    arrays = mi.traverse(shape)
    if "faces" in arrays:
        corners = np.array(arrays["faces"]).reshape(-1, 3)
        p = np.array(arrays["vertex_positions"], float).reshape(-1, 3)[corners]
        has_uv = shape.has_vertex_texcoords()
        uv = np.array(arrays["vertex_texcoords"], float).reshape(-1, 2)[corners] if has_uv else None
        area = np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1)
        face = np.searchsorted(np.cumsum(area) / max(area.sum(), 1e-300), numbers[:, 0]).clip(0, len(p) - 1)
        # Which face and where on it are independent.
        a, b = np.sqrt(numbers[:, 1]), (numbers[:, 0] * 7919.0) % 1.0
        weights = np.stack([1 - a, a * (1 - b), a * b], 1)[..., None]
        place = (p[face] * weights).sum(1)
        found = (uv[face] * weights).sum(1) if uv is not None else weights[:, 1:, 0]
        rows = list(zip(place.tolist(), found.tolist(), face.tolist(), strict=True))
    else:
        samples = (shape.sample_position(0.0, pair, True) for pair in numbers.tolist())
        rows = [(sample.p, sample.uv, 0) for sample in samples]
    for place_, uv_, number in rows:
        si = types.SurfaceInteraction3f()
        si.t, si.p, si.uv, si.prim_index, si.shape = 1.0, place_, uv_, number, shape
        si.n, si.dp_du, si.dp_dv = [0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]
        si.sh_frame = types.Frame3f([0.0, 0.0, 1.0])
        yield si
