"""Environments: radiance from infinitely far away, as Mitsuba's ``envmap`` reads it from an equirectangular picture.

Conventions (Mitsuba 3.9, ``src/emitters/envmap.cpp``), in the emitter's own frame: ``u = atan2(x, −z) / 2π`` and
``v = acos(y) / π``; row 0 is the +y pole. Interpolation is bilinear: columns are texel-centred and wrap around
(column = u W − ½), rows reach from pole to pole (row = v (H − 1)).
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from types import ModuleType
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from btfref.conventions import LUMINANCE
from btfref.errors import InputError
from btfref.types import JitArray, PathLike

#: Rows of the samples of a sun and sky: 0.18 degrees, a third of the sun's diameter.
SUN_ROWS = 1000

#: Rows and columns of the picture of a scene's own sun and sky, and samples along each side of a texel with the sun.
SKY, SUN_SAMPLES = (256, 512), 24

#: Angle that the sun subtends in Mitsuba's ``sunsky``, in degrees.
SUN_APERTURE = 0.5358

#: Rows of the cells that stand for a picture of any size when it is filtered: 1.4 degrees a cell.
CELL_ROWS = 128

#: Environments whose cells are kept, by content: each way to light asks for the same ones. At most 25 MB.
KEPT = 4
_CELLS: dict[tuple[object, ...], tuple[np.ndarray, np.ndarray]] = {}


@dataclass(frozen=True)
class Environment:
    """Radiance by direction.

    Parameters
    ----------
    radiance : ndarray of float, shape (H, W, 3)
        In W/(m² sr), linear Rec. 709; H ≥ 2. Finite and non-negative.
    to_world : ndarray, shape (3, 3)
        Rotation from the emitter's frame to the world's.
    name : str
        For reports.

    Raises
    ------
    InputError
        For another shape, values that are negative or not finite, or a matrix that is no rotation.
    """

    radiance: np.ndarray
    to_world: np.ndarray = field(default_factory=lambda: np.eye(3))
    name: str = "environment"

    def __post_init__(self) -> None:
        shape = np.shape(self.radiance)
        if len(shape) != 3 or shape[2] != 3 or shape[0] < 2 or shape[1] < 1:
            raise InputError(
                "not an environment", field="radiance", got=f"shape {shape}", expected="(H ≥ 2, W ≥ 1, 3)"
            )
        # Also false for NaN.
        if not ((self.radiance >= 0).all() and np.isfinite(self.radiance).all()):
            raise InputError(
                "an environment holds a value that is negative or not finite", field="radiance", got=self.name
            )
        # A mirrored environment is fine, a stretched one is not; the picture's matrices are float32.
        if not np.allclose(self.to_world @ self.to_world.T, np.eye(3), atol=1e-5):
            raise InputError("the environment's transform is no rotation", field="to_world", got=self.name)

    def evaluate(self, w: ArrayLike) -> np.ndarray:
        """Radiance from the directions ``w``.

        Parameters
        ----------
        w : array_like, shape (..., 3)
            Unit vectors towards the environment, world space.

        Returns
        -------
        ndarray of float64, shape (..., 3)
        """
        d = np.asarray(w, float) @ self.to_world
        u = np.arctan2(d[..., 0], -d[..., 2]) / (2 * np.pi)
        v = np.arccos(np.clip(d[..., 1], -1, 1)) / np.pi
        return self.at(u, v)

    def at(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Radiance at coordinates of the picture, ``v`` in [0, 1]; shape (...) -> (..., 3)."""
        rows, columns = self.radiance.shape[:2]
        x, y = u * columns - 0.5, v * (rows - 1)
        c0, r0 = np.floor(x), np.clip(np.floor(y), 0, rows - 2)
        fx, fy = (x - c0)[..., None], (y - r0)[..., None]
        c0, r0 = c0.astype(np.int64), r0.astype(np.int64)
        c1 = (c0 + 1) % columns
        c0 = c0 % columns
        texel = lambda row, column: self.radiance[row, column].astype(float)  # noqa: E731
        upper = (1 - fx) * texel(r0, c0) + fx * texel(r0, c1)
        lower = (1 - fx) * texel(r0 + 1, c0) + fx * texel(r0 + 1, c1)
        return (1 - fy) * upper + fy * lower

    def cells(self, rows: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """The environment as a few thousand small lights.

        The interpolated radiance is integrated over cells of equal angles; each light stands at the luminance's
        centroid of its cell, so that a single bright texel stays where it is.

        Parameters
        ----------
        rows : int, optional
            Of cells; there are twice as many columns. By default `CELL_ROWS`.

        Returns
        -------
        w : ndarray of float64, shape (2 rows², 3)
            Unit vectors towards the lights, world space.
        power : ndarray of float64, shape (2 rows², 3)
            Radiance times solid angle: irradiance perpendicular to ``w``. Sums over the sphere are exact for
            a constant environment. Both are shared, and not to be changed.
        """
        rows = rows or CELL_ROWS
        digest = hashlib.blake2b(np.ascontiguousarray(self.radiance).data, digest_size=16)
        digest.update(np.ascontiguousarray(self.to_world, float).data)
        key = (digest.digest(), self.radiance.dtype.str, self.radiance.shape, rows)
        if key not in _CELLS:
            made = self._integrated(rows)
            for array in made:
                array.flags.writeable = False  # remembered
            while len(_CELLS) >= KEPT:
                _CELLS.pop(next(iter(_CELLS)))
            _CELLS[key] = made
        return _CELLS[key]

    def _integrated(self, rows: int) -> tuple[np.ndarray, np.ndarray]:
        height, width = self.radiance.shape[:2]
        # Breakpoints of the bilinear interpolant fall on borders of the fine grid, where the rule is of second order.
        n_v = (height - 1) * max(2, -(-2 * rows // (height - 1)))
        n_u = width * 2 * max(1, -(-2 * rows // width))
        border = np.cos(np.arange(n_v + 1) * (np.pi / n_v))
        v, u = (np.arange(n_v) + 0.5) / n_v, (np.arange(n_u) + 0.5) / n_u
        theta, phi = np.pi * v, 2 * np.pi * u
        # Solid angles of the fine cells: exact, and with them the sphere's.
        angle = (border[:-1] - border[1:]) * (2 * np.pi / n_u)
        n = 2 * rows * rows
        power, centre = np.zeros((n, 3)), np.zeros((n, 3))
        column = np.minimum((u * 2 * rows).astype(np.int64), 2 * rows - 1)
        for row in range(rows):
            some = np.flatnonzero((v * rows).astype(np.int64) == row)
            value = self.at(*np.meshgrid(u, v[some])) * angle[some, None, None]
            sin = np.sin(theta[some])[:, None]
            w = np.stack(
                np.broadcast_arrays(sin * np.sin(phi), np.cos(theta[some])[:, None], -sin * np.cos(phi)), -1
            )
            # Where all is black the cell's centre stands for it.
            weight = value @ LUMINANCE
            weight = weight + 1e-12 * weight.max(initial=0) + 1e-30
            first = row * 2 * rows
            for k in range(3):
                power[first : first + 2 * rows, k] = np.bincount(
                    column, value[..., k].sum(0), minlength=2 * rows
                )
                centre[first : first + 2 * rows, k] = np.bincount(
                    column, (weight * w[..., k]).sum(0), minlength=2 * rows
                )
        centre /= np.linalg.norm(centre, axis=1, keepdims=True)
        return centre @ self.to_world.T, power


def cell_angles(rows: int | None = None) -> np.ndarray:
    """Solid angles of the cells of :meth:`Environment.cells`, shape (2 rows²,)."""
    rows = rows or CELL_ROWS
    border = np.cos(np.arange(rows + 1) * (np.pi / rows))
    return np.repeat((border[:-1] - border[1:]) * (np.pi / rows), 2 * rows)


def constant(radiance: ArrayLike = (1.0, 1.0, 1.0)) -> Environment:
    """The same radiance from everywhere.

    Parameters
    ----------
    radiance : array_like, shape (3,)
    """
    return Environment(np.broadcast_to(np.asarray(radiance, np.float32), (3, 2, 3)), name="constant")


def bright_texel(
    direction: ArrayLike,
    *,
    shape: tuple[int, int] = (64, 128),
    irradiance: float = 1.0,
    background: float = 0.0,
) -> Environment:
    """One bright texel on a dark sky: the response of a method to a small light.

    Parameters
    ----------
    direction : array_like, shape (3,)
        Towards the light; the texel that holds it is lit.
    shape : (int, int)
        Rows and columns of the picture.
    irradiance : float
        Perpendicular to the light in W/m², grey.
    background : float
        Radiance of the rest.
    """
    rows, columns = shape
    d = np.asarray(direction, float) / np.linalg.norm(direction)
    column = int(np.round(np.arctan2(d[0], -d[2]) / (2 * np.pi) * columns - 0.5)) % columns
    row = int(np.clip(np.round(np.arccos(d[1]) / np.pi * (rows - 1)), 1, rows - 2))
    picture = np.zeros((rows, columns, 3), np.float32)
    picture[row, column] = 1
    total = Environment(picture).cells()[1].sum(0)
    return Environment((background + picture * (irradiance / total)).astype(np.float32), name="bright texel")


def sunsky(
    *,
    shape: tuple[int, int] = (256, 512),
    turbidity: float = 3.0,
    sun_direction: ArrayLike = (0.4, 0.3, 0.86),
    up: Literal["y", "z"] = "z",
) -> Environment:
    """Mitsuba's sun and sky as a picture.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns.
    turbidity : float
        Haze, 1 to 10.
    sun_direction : array_like, shape (3,)
        World space.
    up : {"y", "z"}
        The world's axis towards the zenith. The part below the horizon is black.

    Raises
    ------
    MissingDependencyError
        Without a usable LLVM.
    """
    from btfref.platform import prepare_llvm
    from btfref.sampling.variant import mitsuba_variant

    prepare_llvm()
    import mitsuba as mi

    # The picture's own frame has y up; z up turns (x, y, z) into (x, −z, y).
    to_world = np.eye(3) if up == "y" else np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    rows, columns = shape
    # Means over the texels' areas: the sun, half a degree wide, must not fall between samples.
    fine = -(-SUN_ROWS // rows)
    inside = (np.arange(fine) + 0.5) / fine - 0.5
    row = np.clip((np.arange(rows)[:, None] + inside).ravel(), 0, rows - 1)
    column = (np.arange(columns)[:, None] + 0.5 + inside).ravel()
    v, u = np.meshgrid(row / (rows - 1), column / columns, indexing="ij")
    sin = np.sin(np.pi * v)
    d = np.stack([sin * np.sin(2 * np.pi * u), np.cos(np.pi * v), -sin * np.cos(2 * np.pi * u)], -1)
    # Mitsuba's emitter has z up.
    local = np.stack([d[..., 0], -d[..., 2], d[..., 1]], -1).reshape(-1, 3)
    sun = np.asarray(sun_direction, float) @ to_world
    with mitsuba_variant("llvm_ad_rgb"):
        emitter = mi.load_dict(
            {
                "type": "sunsky",
                "turbidity": float(turbidity),
                "sun_direction": [sun[0], -sun[2], sun[1]],
            }
        )
        import drjit as dr

        si = dr.zeros(mi.SurfaceInteraction3f, len(local))
        si.wi = -mi.Vector3f(local.T)
        sky = np.maximum(np.array(emitter.eval(si)).T, 0)
    sky = sky.reshape(rows, fine, columns, fine, 3).mean((1, 3))
    return Environment(sky.astype(np.float32), to_world, "sunsky")


def _sky_picture(emitter: JitArray, types: ModuleType, values: JitArray, aperture: float) -> Environment:
    """A sun and sky of a scalar variant as a picture with the zenith at its upper edge."""
    rows, columns = SKY
    to_world = np.array(values["to_world"].matrix, float).reshape(4, 4)[:3, :3]
    # The picture has y up, the emitter's own frame z.
    frame = to_world / np.linalg.norm(to_world, axis=0) @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    sun = np.array(values["sun_direction"], float).reshape(3)
    sun = frame.T @ sun / np.linalg.norm(sun)  # given in world space

    def directions(row: np.ndarray, column: np.ndarray) -> np.ndarray:
        v, u = np.pi * row / (rows - 1), 2 * np.pi * (column + 0.5) / columns
        return np.stack([np.sin(v) * np.sin(u), np.cos(v), -np.sin(v) * np.cos(u)], -1)

    def seen(d: np.ndarray) -> np.ndarray:
        si, found = types.SurfaceInteraction3f(), np.zeros(d.shape)
        for k, w in enumerate((-d @ frame.T).tolist()):
            si.wi = w
            found[k] = emitter.eval(si, True)
        return np.maximum(found, 0)

    row, column = (a.ravel() for a in np.mgrid[:rows, :columns].astype(float))
    d = directions(row, column)
    picture = seen(d)
    inside = (np.arange(SUN_SAMPLES) + 0.5) / SUN_SAMPLES - 0.5
    reach = np.cos(np.radians(0.5 * aperture) + 1.5 * np.pi / (rows - 1))
    for k in np.flatnonzero(d @ sun > reach):
        y, x = np.meshgrid(np.clip(row[k] + inside, 0, rows - 1), column[k] + inside, indexing="ij")
        picture[k] = seen(directions(y.ravel(), x.ravel())).mean(0)
    return Environment(picture.reshape(rows, columns, 3).astype(np.float32), frame, "sunsky")


def from_emitter(
    kind: str,
    emitter: JitArray,
    types: ModuleType,
    *,
    file: PathLike | None = None,
    aperture: float = SUN_APERTURE,
) -> Environment:
    """The environment of a Mitsuba emitter, asked of the emitter itself.

    Parameters
    ----------
    kind : {"envmap", "constant", "sunsky"}
    emitter : mitsuba.Emitter
    types : module
        Mitsuba's types of the emitter's variant.
    file : str, optional
        For messages.
    aperture : float
        Angle that the sun of a "sunsky" subtends, in degrees.

    Returns
    -------
    Environment
        Of a "sunsky" a picture, `SKY` texels, each the mean over its extent where the sun is: its energy and its middle
        are kept, its edge is that of a texel.
    """
    import mitsuba as mi

    values = mi.traverse(emitter)
    if kind == "sunsky":
        return _sky_picture(emitter, types, values, aperture)
    if kind == "constant":
        si = types.SurfaceInteraction3f()
        return constant(np.array(emitter.eval(si), float).ravel()[:3])
    # One column of the wrap-around stands on each side of the picture.
    data = np.array(values["data"], np.float32)[:, 1:-1, :3] * np.float32(np.array(values["scale"]).item())
    # JIT variants give matrices and scalars another axis of length 1.
    to_world = np.array(values["to_world"].matrix, float).reshape(4, 4)[:3, :3]
    try:
        return Environment(data, to_world, "envmap")
    except InputError as error:
        raise InputError(error.message, file=file, field=error.field) from error
