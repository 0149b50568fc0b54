"""Points that stand for the area lights of a scene, so that their light is without noise.

A Fibonacci lattice on the unit square, taken to the shape by Mitsuba's own uniform map: each point has the same share
of the area. Their number follows from an estimated error, as for the directional lights that stand for an environment
(:mod:`btfref.rendering.environment_light.light_set`), at receivers that the camera sees.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from btfref.conventions import LUMINANCE
from btfref.scene.emitters.lights import Light, is_area
from btfref.types import Facts, JitArray

if TYPE_CHECKING:
    from types import ModuleType

#: Estimated relative error at which the search for a number of points ends.
TARGET = 0.01

#: Fewest and most points of a light that the search tries, and those that the truth of its estimate has.
FEWEST, MOST, TRUTH = 16, 1024, 8192

#: Camera rays on each side of the picture that find receivers.
RAYS = 12

#: Exponent of the receivers' lobe: cos³² is about as wide as measured lights are apart.
EXPONENT = 32

#: Inverse of the golden ratio.
_GOLDEN = 0.5 * (5**0.5 - 1)


@dataclass(frozen=True)
class AreaLights:
    """Points that stand for all area lights of a scene.

    Parameters
    ----------
    position, normal : ndarray of float64, shape (n, 3)
    power : ndarray of float64, shape (n, 3)
        Radiance times area: radiant intensity along the normal in W/sr, linear Rec. 709.
    error : float
        Estimated relative error: root mean square over receivers, of luminance; see :func:`estimated_error`.
    """

    position: np.ndarray
    normal: np.ndarray
    power: np.ndarray
    error: float

    def __len__(self) -> int:
        return len(self.position)

    def lights(self) -> list[Light]:
        """The points as lights."""
        rows = zip(self.position, self.power, self.normal, strict=True)
        return [Light("area", position, power, normal) for position, power, normal in rows]

    def on_device(self) -> list[JitArray]:
        """Position, normal and power in the current JIT variant of Mitsuba."""
        import mitsuba as mi

        from btfref.numerics.device_arrays import to_device

        kinds = (mi.Point3f, self.position), (mi.Normal3f, self.normal), (mi.Color3f, self.power)
        return [to_device(kind, values.T) for kind, values in kinds]

    @property
    def facts(self) -> Facts:
        """JSON-able, for a picture's ``meta``; nothing without area lights."""
        return {"area_light_points": len(self), "area_light_error": self.error} if len(self) else {}


def area_lights(scene: JitArray, types: ModuleType, *, target: float = TARGET) -> AreaLights:
    """Points for the area lights of a scene.

    Parameters
    ----------
    scene : mitsuba.Scene
        With its sensor.
    types : module
        Mitsuba's types of the scene's variant.
    target : float
        Relative error of each light. Its number of points is the smallest power of two, 16 to 1024, that is estimated
        to keep it.

    Returns
    -------
    AreaLights
    """
    shapes = [shape for shape in scene.shapes() if shape.is_emitter() and is_area(shape.emitter())]
    found, errors, total = [], 0.0, 0.0
    receivers = _receivers(scene, types) if shapes else ()
    for shape in shapes:
        truth = points_of(shape, TRUTH, types)
        n = FEWEST
        while True:
            points = points_of(shape, n, types)
            error, mean = estimated_error(points, truth, *receivers)
            if error <= target * mean or n >= MOST:
                break
            n *= 2
        found.append(points)
        errors, total = errors + error, total + mean
    if not found:
        nothing = np.zeros((0, 3))
        return AreaLights(nothing, nothing, nothing, 0.0)
    position, normal, power = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return AreaLights(position, normal, power, errors / max(total, 1e-300))


def points_of(shape: JitArray, n: int, types: ModuleType) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of one area light: position, normal and power, each of shape (n, 3).

    Parameters
    ----------
    shape : mitsuba.Shape
    n : int
    types : module
        Mitsuba's types of the shape's variant.
    """
    index = np.arange(n)
    # Half a step from the borders, along both axes.
    x, y = (index * _GOLDEN + 0.5 / n) % 1.0, (index + 0.5) / n
    emitter = shape.emitter()

    def sampled(x: Any, y: Any) -> tuple[JitArray, JitArray, JitArray, JitArray]:
        place = shape.sample_position(0.0, types.Point2f(x, y), True)
        si = types.SurfaceInteraction3f(place, types.Color0f())
        si.wi = types.Vector3f(0, 0, 1)
        return place.p, place.n, emitter.eval(si, True), place.pdf

    rows = [_array(values, n) for values in _each(sampled, types, x, y)]
    position, normal, radiance = rows[:3]
    if shape.class_name() == "Sphere":
        # Mitsuba 3.9 leaves the rotation of a sphere out of these normals.
        normal = position - np.array(shape.bbox().center(), float).reshape(3)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True) * (-1 if shape.has_flipped_normals() else 1)
    return position, normal, radiance / (n * rows[3][:, :1])


def estimated_error(
    points: tuple[np.ndarray, ...], truth: tuple[np.ndarray, ...], place: np.ndarray, facing: np.ndarray
) -> tuple[float, float]:
    """How differently receivers see few points and many.

    Parameters
    ----------
    points, truth : tuple of ndarray, shape (n, 3) and (m, 3)
        Position, normal, power.
    place, facing : ndarray, shape (r, 3)
        Receivers, and their normals on the side that is seen.

    Returns
    -------
    error, mean : float
        Root mean square difference and mean of luminance: half a Lambertian surface and half a lobe cos³² about a
        random axis above the horizon.
    """
    if not len(place):
        return 0.0, 0.0
    axis = np.random.default_rng(0).normal(size=place.shape)
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    axis *= np.where((axis * facing).sum(1) < 0, -1, 1)[:, None]

    def seen(position: np.ndarray, normal: np.ndarray, power: np.ndarray) -> np.ndarray:
        luminance, found = power @ LUMINANCE, np.zeros(len(place))
        for k in range(len(place)):
            offset = position - place[k]
            square = np.maximum((offset**2).sum(1), 1e-30)
            towards = offset / np.sqrt(square)[:, None]
            weight = luminance * np.maximum(-(towards * normal).sum(1), 0) / square
            cosine, lobe = np.maximum(towards @ facing[k], 0), np.maximum(towards @ axis[k], 0)
            for _ in range(EXPONENT.bit_length() - 1):
                np.multiply(lobe, lobe, out=lobe)
            found[k] = weight @ (cosine + lobe * ((EXPONENT + 1) / 2 * np.minimum(1, 8 * cosine)))
        return found

    with np.errstate(under="ignore"):
        exact, found = seen(*truth), seen(*points)
    return float(np.sqrt(np.mean((found - exact) ** 2))), float(exact.mean())


def _receivers(scene: JitArray, types: ModuleType) -> tuple[np.ndarray, np.ndarray]:
    """Places that the camera sees, area lights apart, and their normals towards it."""
    at = (np.arange(RAYS) + 0.5) / RAYS
    y, x = (grid.ravel() for grid in np.meshgrid(at, at, indexing="ij"))
    sensor = scene.sensors()[0]

    def seen(x: Any, y: Any) -> tuple[JitArray, ...]:
        ray, _ = sensor.sample_ray(0.0, 0.5, types.Point2f(x, y), types.Point2f(0.5, 0.5), True)
        si = scene.ray_intersect(ray)
        lights = si.emitter(scene, True)
        hit = si.is_valid() & (lights == None)  # noqa: E711 - an array of pointers
        return si.p, si.sh_frame.n, si.wi, hit

    place, normal, wi, hit = (_array(values, len(x)) for values in _each(seen, types, x, y))
    hits = hit[:, 0] > 0
    side = np.where(wi[:, 2] < 0, -1.0, 1.0)
    return place[hits], (side[:, None] * normal)[hits]


def _each(function: Any, types: ModuleType, x: np.ndarray, y: np.ndarray) -> list[Any]:
    """Results of a function of two numbers: at once for a JIT variant, one by one for a scalar one."""
    import drjit as dr

    if dr.is_jit_v(types.Float):
        from btfref.numerics.device_arrays import to_device

        return list(function(*(to_device(types.Float, a.astype(np.float32)) for a in (x, y))))
    rows = [function(float(a), float(b)) for a, b in zip(x, y, strict=True)]
    return [np.array([np.array(value, float) for value in column]) for column in zip(*rows, strict=True)]


def _array(values: Any, n: int) -> np.ndarray:
    """Results as float64, shape (n, k)."""
    if isinstance(values, np.ndarray):
        return values.reshape(n, -1)
    array = np.array(values, float)
    array = array.T if array.ndim == 2 else array[:, None]
    return np.broadcast_to(array, (n, array.shape[1]))
