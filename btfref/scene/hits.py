"""Hits of a surface with a BTF, in the frame in which the BTF is looked up.

The frame is Mitsuba's shading frame ``s = normalize(∂p/∂u − n (n · ∂p/∂u))``, ``t = n × s``, its t mirrored where
det(∂p/∂u, ∂p/∂v, n) < 0, so that s and t follow the picture; then turned about the normal, or mirrored, as the texture
transform does it to the texture. Where u and v span nothing, Mitsuba's ∂p/∂u and ∂p/∂v stand, those of its frame
around the geometric normal. On a two-sided surface that is seen from behind both directions are mirrored at the surface
and the tangents stay, as in Mitsuba's ``twosided``. The same is said for the plugin in ``mitsuba_plugins/base.py`` and
for shaders in ``shaders/lib/surface/frame.glsl``, and nowhere else.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from btfref.errors import InputError
from btfref.numerics.footprint import TINY, cone_footprint
from btfref.numerics.sphere.frames import Turn, shading_frame
from btfref.scene.camera import film_rays, grid_offsets
from btfref.scene.emitters.lights import is_delta
from btfref.types import JitArray

if TYPE_CHECKING:
    from btfref.scene.reading.instances import Drawn
    from btfref.scene.shapes import MeshDescription, Shown

#: Shapes whose triangles are a tessellation of ours.
ANALYTIC = ("sphere", "disk", "cylinder")


class Surface:
    """What one sub-pixel position of every pixel sees: Mitsuba's surface interaction, and NumPy arrays of its fields.

    Parameters
    ----------
    scene : mitsuba.Scene
    offset : (float, float)
        Place in each pixel, from its top left corner.
    """

    def __init__(self, scene: JitArray, offset: tuple[float, float]) -> None:
        ray, _ = film_rays(scene.sensors()[0], offset)
        self._scene, self.si = scene, scene.ray_intersect(ray)
        self._arrays: dict[str, np.ndarray] = {}

    def __getitem__(self, name: str) -> np.ndarray:
        """A field of the interaction by its name: float64, shape (pixels, 3) or (pixels, 2), for vectors."""
        if name not in self._arrays:
            value: Any = self.si
            for part in name.split("."):
                value = getattr(value, part)
            array = np.array(value)
            self._arrays[name] = array.astype(float).T if array.ndim == 2 else array
        return self._arrays[name]

    @cached_property
    def hit(self) -> np.ndarray:
        """Which pixels see anything, shape (pixels,) bool."""
        return np.array(self.si.is_valid())

    @cached_property
    def hand(self) -> np.ndarray:
        """Sign of det(∂p/∂u, ∂p/∂v, n), shape (pixels,): −1 where the texture is mirrored against the surface."""
        area = np.cross(self["dp_du"], self["dp_dv"])
        return np.where((area * self["sh_frame.n"]).sum(1) < 0, -1.0, 1.0)

    @cached_property
    def lights(self) -> list[np.ndarray]:
        """Directions towards every delta light in Mitsuba's frame, each of shape (pixels, 3)."""
        import mitsuba as mi

        lights = [light for light in self._scene.emitters() if is_delta(light)]
        found = [light.sample_direction(self.si, mi.Point2f(0.5))[0] for light in lights]
        return [np.array(self.si.to_local(sample.d), float).T for sample in found]

    def sees(self, drawn: Drawn) -> np.ndarray:
        """Which pixels see a shape, shape (pixels,) bool."""
        import mitsuba as mi

        seen = self.hit & np.array(self.si.shape == mi.ShapePtr(drawn.shape))
        if drawn.instance is not None:
            seen &= np.array(self.si.instance == mi.ShapePtr(drawn.instance))
        return seen


def surfaces(scene: JitArray, grid: int) -> Iterator[Surface]:
    """What every position of a regular n × n sub-pixel grid sees, one after the other."""
    for offset in grid_offsets(grid):
        yield Surface(scene, offset)


class Hits:
    """Hits of one material's surface.

    Directions and coordinates are Dr.Jit's where the arguments are, as a renderer needs them, and NumPy's float64
    otherwise. Fields of the surface (from ``position`` on) are there for hits of a `Surface` only.

    Parameters
    ----------
    material : BtfMaterial or PlainMaterial
    uv : ndarray, shape (N, 2), or mitsuba.Point2f
        Of the shape.
    wi : ndarray, shape (N, 3), or mitsuba.Vector3f
        Towards the viewer, in Mitsuba's shading frame.
    hand : ndarray, shape (N,), or mitsuba.Float
        Sign of det(∂p/∂u, ∂p/∂v, n).
    surface : Surface, optional
    at : ndarray of int, shape (N,), optional
        Pixels of the surface that the hits belong to.
    """

    def __init__(
        self,
        material: Shown,
        uv: JitArray,
        wi: JitArray,
        hand: JitArray,
        *,
        surface: Surface | None = None,
        at: np.ndarray | None = None,
    ) -> None:
        self.material, self._uv, self._wi, self._hand = material, uv, wi, hand
        self._surface, self._at = surface, at

    @classmethod
    def of(cls, surface: Surface, material: Shown, at: np.ndarray) -> Hits:
        """Those of the pixels ``at`` of a surface, shape (N,) int."""
        return cls(material, surface["uv"][at], surface["wi"][at], surface.hand[at], surface=surface, at=at)

    @classmethod
    def at_interaction(cls, material: Shown, si: JitArray) -> Hits:
        """Those of Mitsuba's surface interactions, as Dr.Jit arrays."""
        from mitsuba_plugins.lib.frame import hand_of

        return cls(material, si.uv, si.wi, hand_of(si))

    @property
    def at(self) -> np.ndarray:
        """Flat index of each hit's pixel, row by row, shape (N,) int."""
        assert self._at is not None, "hits of no surface"
        return self._at

    def moved(self, step: np.ndarray) -> Hits:
        """The same hits, the shape's texture coordinates off by ``step`` (N, 2); directions and places stay."""
        surface, at = self._surface, self._at
        return Hits(self.material, self._uv + step, self._wi, self._hand, surface=surface, at=at)

    @cached_property
    def uv(self) -> JitArray:
        """Coordinates of the texture: the shape's, transformed."""
        u, v = _components(self._uv)
        (a, b, c), (d, e, f) = self.material.to_uv.tolist()
        return _joined(self._uv, _fma(u, a, _fma(v, b, c)), _fma(u, d, _fma(v, e, f)))

    @cached_property
    def side(self) -> JitArray:
        """−1 where a two-sided surface is seen from behind, else 1."""
        return _sign(_components(self._wi)[2] < 0, self.material.twosided)

    @cached_property
    def w_view(self) -> JitArray:
        """Towards the viewer, in the texture's frame; on two-sided surfaces above the horizon."""
        return self.local(self._wi)

    def local(self, w: JitArray) -> JitArray:
        """Directions of Mitsuba's shading frame, in the texture's frame."""
        x, y, z = _components(w)
        return _joined(w, *_turned(self.material.turn, x, y * self._hand), z * self.side)

    def _field(self, name: str) -> np.ndarray:
        assert self._surface is not None, "hits of no surface"
        return self._surface[name][self.at]

    @cached_property
    def position(self) -> np.ndarray:
        """World space, shape (N, 3)."""
        return self._field("p")

    @cached_property
    def to_world(self) -> np.ndarray:
        """Columns: axes of the texture's frame in world space, the third one to the side seen; shape (N, 3, 3)."""
        frame = np.stack([self._field(f"sh_frame.{axis}") for axis in "stn"], 1)
        frame[:, 1] *= self._hand[:, None]
        frame = turned_frame(frame, self.material)
        frame[:, 2] *= self.side[:, None]
        return frame.transpose(0, 2, 1)

    def footprint(
        self, origin: np.ndarray, angle: float, texels: tuple[int, int]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What a sample sees of the texture.

        Parameters
        ----------
        origin : ndarray, shape (3,)
            Of the camera, in world space.
        angle : float
            That a sample subtends, in radians.
        texels : (int, int)
            Rows and columns of the texture.

        Returns
        -------
        lod : ndarray of float64, shape (N,)
            Level of detail as the material chooses it.
        step : ndarray of float64, shape (N, 2)
            Between lookups along the footprint, in texture coordinates.
        ratio : ndarray of float64, shape (N,)
            See :func:`btfref.numerics.footprint.ellipse_footprint`.
        """
        material = self.material
        towards = origin - self.position
        distance = np.linalg.norm(towards, axis=1)
        if material.lod == "auto":
            dp_du, dp_dv = self._field("dp_du"), self._field("dp_dv")
            e, f, g = ((a * b).sum(1) for a, b in ((dp_du, dp_du), (dp_du, dp_dv), (dp_dv, dp_dv)))
            area = (e * g - f * f)[:, None]
            inverse = np.where(area > 0, 1 / np.where(area > 0, area, 1), 0)
            # Rows of the inverse of (∂p/∂u, ∂p/∂v) in the tangent plane are the gradients of u and v.
            of_u = (dp_du * g[:, None] - dp_dv * f[:, None]) * inverse
            of_v = (dp_dv * e[:, None] - dp_du * f[:, None]) * inverse
            size = np.array(texels[::-1], float)
            u, v = (k * (a[0] * of_u + a[1] * of_v) for k, a in zip(size, material.to_uv, strict=True))
            view = towards / distance[:, None]
            lod, step, ratio = cone_footprint(u, v, view, self._field("n"), angle * distance)
            return material.lod_bias + lod, step / size, ratio
        n = len(distance)
        lod = np.full(n, float(material.lod_bias))
        if material.lod == "distance":
            lod += np.log2(np.clip(distance / material.lod_unit, TINY, 1e30))
        return lod, np.zeros((n, 2)), np.ones(n)

    def place(self, mesh: MeshDescription) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Side, triangle and barycentric coordinates of every hit.

        Parameters
        ----------
        mesh : MeshDescription
            The hits' own.

        Returns
        -------
        behind : ndarray of bool, shape (N,)
            The back of a two-sided surface is seen.
        triangle : ndarray of int, shape (N,)
        barycentric : ndarray of float64, shape (N, 3)

        Raises
        ------
        InputError
            For a curved shape that is no mesh: its triangles are not those that the camera sees.
        """
        corners = np.asarray(mesh.positions, float)[mesh.faces]
        if mesh.plugin == "rectangle":
            every = [_barycentric(corners[k], self.position) for k in range(len(corners))]
            triangle = np.argmax([b.min(1) for b in every], axis=0)
        elif mesh.plugin in ANALYTIC:
            raise InputError("a mesh is needed", field=mesh.name, got=mesh.plugin, expected="such as ply")
        else:
            triangle = self._field("prim_index").astype(np.int64)
        return self.side < 0, triangle, _barycentric(corners[triangle], self.position)


def corner_frames(mesh: MeshDescription) -> np.ndarray:
    """Axes of the texture's frame at the corners of a mesh with a BTF, columns in world space.

    Returns
    -------
    ndarray of float64, shape (triangles, 3, 3, 3)
    """
    _, normals, _, dp_du = mesh.corners()
    normals = normals / np.linalg.norm(normals, axis=-1, keepdims=True)
    frame = shading_frame(normals, dp_du[:, None], mesh.hands())
    return np.swapaxes(turned_frame(frame, mesh.btf), -1, -2)


def turned_frame(frame: np.ndarray, material: Shown) -> np.ndarray:
    """Frames, rows s, t, n in shape (..., 3, 3), taken to that of the transformed texture."""
    s, t, n = np.moveaxis(frame, -2, 0)
    return np.stack([*_turned(material.turn, s, t), n], -2)


def _turned(turn: Turn, x: JitArray, y: JitArray) -> tuple[JitArray, JitArray]:
    """First and second component after a turn."""
    c, s, y = turn.cosine, turn.sine, turn.hand * y
    return (x, y) if (c, s) == (1.0, 0.0) else (c * x - s * y, s * x + c * y)


def _components(vectors: JitArray) -> tuple[JitArray, ...]:
    return tuple(np.moveaxis(vectors, -1, 0) if isinstance(vectors, np.ndarray) else vectors)


def _joined(like: JitArray, *components: JitArray) -> JitArray:
    return np.stack(components, -1) if isinstance(like, np.ndarray) else type(like)(*components)


def _fma(a: JitArray, b: float, c: JitArray | float) -> JitArray:
    if isinstance(a, np.ndarray):
        return a * b + c
    import drjit as dr

    return dr.fma(a, b, c)


def _sign(behind: JitArray, twosided: bool) -> JitArray:
    if isinstance(behind, np.ndarray):
        return np.where(behind & twosided, -1.0, 1.0)
    import drjit as dr
    import mitsuba as mi

    return dr.select(behind & twosided, mi.Float(-1), mi.Float(1))


def _barycentric(corners: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Coordinates of points in the planes of triangles; (3, 3) or (N, 3, 3), (N, 3) -> (N, 3)."""
    a, b, c = np.moveaxis(corners, -2, 0)
    e1, e2, d = b - a, c - a, position - a
    normal = np.cross(e1, e2)
    square = (normal * normal).sum(-1)
    v = (np.cross(d, e2) * normal).sum(-1) / square
    w = (np.cross(e1, d) * normal).sum(-1) / square
    return np.stack([1 - v - w, v, w], -1)
