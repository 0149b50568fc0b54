"""Environments that ship by construction, by name: what ``-D environment=NAME`` knows beside files.

Pictures have Mitsuba's conventions (:mod:`btfref.scene.environment`); the scenes turn their upper edge towards z, and
so does :data:`Z_UP`: directions here are the world's.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import cache

import numpy as np

from btfref.errors import InputError
from btfref.numerics.sphere import harmonics
from btfref.scene.environment import Environment, bright_texel, constant, sunsky
from btfref.scene.shipped import ENVIRONMENTS

#: From the picture's frame, with y up, to the scenes' world with z up.
Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])

#: Elevation of the sun, in degrees, of "sky".
ELEVATION = 30

#: Azimuth of the sun: in front of the camera of the shipped scenes, to the left.
AZIMUTH = -120

#: Bands of the random environment of low order.
ORDER = 4

#: Area lights of the studio: centre, half edges, radiance. Key from the left, fill from the right, a strip behind, a
#: ceiling.
SOFTBOXES = (
    ((-2.4, -1.6, 2.2), (0.5, -0.75, 0.0), (0.35, 0.25, 0.55), (14.0, 13.0, 11.5)),
    ((2.8, -1.2, 1.2), (0.4, 0.95, 0.0), (0.0, 0.0, 0.8), (3.0, 3.4, 4.0)),
    ((0.3, 3.0, 1.6), (1.6, 0.0, 0.0), (0.0, 0.0, 0.15), (12.0, 12.0, 12.0)),
    ((0.0, 0.0, 3.5), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (2.0, 2.0, 2.0)),
)

#: Radiance of the studio's walls above and below the horizon.
WALLS, FLOOR = 0.06, 0.03


@cache
def shipped(name: str) -> Environment:
    """The environment of a name.

    Parameters
    ----------
    name : str
        "constant"; "sky", or "sky" and an elevation of the sun in degrees, such as "sky60"; "studio", four area
        lights; "harmonics", random and of low order; "bright-texel", a small light on a dark sky.

    Returns
    -------
    Environment
        World with z up.

    Raises
    ------
    InputError
        For another name.
    MissingDependencyError
        For a sky without a usable LLVM.
    """
    sky = re.fullmatch(r"sky(\d{1,2})?", name)
    if sky and (sky[1] is None or 1 <= int(sky[1]) <= 90):
        return sky_at(int(sky[1] or ELEVATION))
    makers: dict[str, Callable[[], Environment]] = {
        "constant": constant,
        "studio": studio,
        "harmonics": lambda: harmonic_environment()[0],
        "bright-texel": lambda: Environment(
            bright_texel(Z_UP.T @ [-0.5, -0.6, 0.65], irradiance=np.pi).radiance, Z_UP, "bright-texel"
        ),
    }
    if name not in makers:
        raise InputError(
            "no such environment", got=repr(name), expected=f"a file, or {', '.join(ENVIRONMENTS)}"
        )
    return makers[name]()


def is_shipped(name: str) -> bool:
    """Whether :func:`shipped` knows the name."""
    return name in ENVIRONMENTS or re.fullmatch(r"sky([1-9]|[1-8]\d|90)", name) is not None


def sky_at(elevation: float, *, shape: tuple[int, int] = (256, 512), turbidity: float = 3.0) -> Environment:
    """Sun and sky with the sun at an elevation.

    Parameters
    ----------
    elevation : float
        In degrees.
    shape : (int, int)
    turbidity : float
    """
    e, a = np.radians(elevation), np.radians(AZIMUTH)
    sun = (np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e))
    made = sunsky(shape=shape, turbidity=turbidity, sun_direction=sun)
    return Environment(made.radiance, made.to_world, f"sky{elevation:g}")


def picture_directions(rows: int, columns: int, fine: int = 1) -> np.ndarray:
    """Directions of the texels of a picture, world space, shape (rows · fine, columns · fine, 3).

    With ``fine`` above 1: of samples spread evenly over each texel's extent.
    """
    inside = (np.arange(fine) + 0.5) / fine - 0.5
    row = np.clip((np.arange(rows)[:, None] + inside).ravel(), 0, rows - 1)
    column = (np.arange(columns)[:, None] + 0.5 + inside).ravel()
    v, u = np.meshgrid(np.pi * row / (rows - 1), 2 * np.pi * column / columns, indexing="ij")
    return np.stack([np.sin(v) * np.sin(u), np.cos(v), -np.sin(v) * np.cos(u)], -1) @ Z_UP.T


def studio(*, shape: tuple[int, int] = (128, 256), fine: int = 4) -> Environment:
    """Soft boxes around the scene, seen from its origin.

    Parameters
    ----------
    shape : (int, int)
    fine : int
        Samples a texel and axis.
    """
    rows, columns = shape
    d = picture_directions(rows, columns, fine)
    radiance = np.where(d[..., 2:] > 0, WALLS, FLOOR) * np.ones(3)
    for *extent, power in SOFTBOXES:
        centre, half_u, half_v = np.array(extent)
        normal = np.cross(half_u, half_v)
        slope = d @ normal
        ahead = slope * (centre @ normal) > 0
        point = d * ((centre @ normal) / np.where(ahead, slope, 1))[..., None] - centre
        inside = np.abs(point @ half_u) <= half_u @ half_u
        inside &= np.abs(point @ half_v) <= half_v @ half_v
        radiance[ahead & inside] = power
    radiance = radiance.reshape(rows, fine, columns, fine, 3).mean((1, 3))
    return Environment(radiance.astype(np.float32), Z_UP, "studio")


def harmonic_environment(
    *, order: int = ORDER, seed: int = 0, shape: tuple[int, int] = (256, 512)
) -> tuple[Environment, np.ndarray]:
    """A random environment of a few bands, whose coefficients are known.

    Parameters
    ----------
    order : int
        Bands of spherical harmonics.
    seed : int
    shape : (int, int)

    Returns
    -------
    environment : Environment
    coefficients : ndarray of float64, shape (order², 3)
        World space; the picture interpolates their sum, to some 1e-4.
    """
    rng = np.random.default_rng(seed)
    coefficients = rng.normal(size=(order * order, 3)) / (1 + harmonics.bands(order))[:, None] ** 1.5
    coefficients[0] = 0
    rows, columns = shape
    y = harmonics.values(picture_directions(rows, columns), order)
    picture = y @ coefficients
    # The mean is what keeps the darkest direction at a tenth of it.
    mean = -picture.min((0, 1)) / 0.9
    coefficients[0] = mean / y[0, 0, 0]
    return Environment((picture + mean).astype(np.float32), Z_UP, "harmonics"), coefficients
