"""The witness's scene, in numbers and as Mitsuba's dictionary: four patches of one material, each with its own trap."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from btfref.types import Facts, PathLike

#: Edge of the picture in pixels, and sub-pixels per axis.
SIZE, GRID = 40, 2

#: Quads along a side of a patch.
QUADS = 3


def _scaled(x: float, y: float, z: float) -> np.ndarray:
    return np.diag([x, y, z, 1.0])


def _moved(x: float, y: float, z: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def _turned(axis: int, degrees: float) -> np.ndarray:
    """About x (0), y (1) or z (2)."""
    matrix, angle = np.eye(4), np.radians(degrees)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix[[i, i, j, j], [i, j, i, j]] = np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)
    return matrix


@dataclass(frozen=True)
class Patch:
    """A bumpy square over [−1, 1]² with its own place.

    Parameters
    ----------
    to_world : ndarray, shape (4, 4)
    mirrored : bool
        u runs from right to left.
    turn_over : bool
        Leave v to the OBJ reader's default, which turns it over.
    """

    to_world: np.ndarray
    mirrored: bool = False
    turn_over: bool = False


@dataclass(frozen=True)
class WitnessScene:
    """What is seen, from where, in which light; lengths in the scene's unit, angles in degrees.

    Attributes
    ----------
    patches : dict of str to Patch
    origin, target, up : tuple of float
        Of the camera.
    fov : float
        From left to right.
    to_uv : ndarray, shape (2, 2)
        Linear map of texture coordinates: it stretches, turns and mirrors.
    sun, irradiance : tuple of float
        Direction of travel, and W/m² perpendicular to it.
    lamps : tuple of (position, intensity)
        Points near the surface, W/sr.
    """

    patches: dict[str, Patch] = field(
        default_factory=lambda: {
            "stretched, v turned over": Patch(
                _moved(-0.75, -0.7, 0) @ _turned(2, 20) @ _scaled(0.7, 0.45, 0.9), turn_over=True
            ),
            "stretched, u mirrored": Patch(
                _moved(0.75, -0.7, 0) @ _turned(0, 15) @ _scaled(0.5, 0.7, 0.6), mirrored=True
            ),
            "mirrored in space": Patch(_moved(-0.75, 0.75, 0) @ _turned(1, -15) @ _scaled(-0.65, 0.6, 0.8)),
            "seen from behind": Patch(
                _moved(0.75, 0.75, 0) @ _turned(1, 170) @ _turned(2, 35) @ _scaled(0.5, 0.65, 0.7)
            ),
        }
    )
    origin: tuple[float, float, float] = (0.4, -2.6, 3.2)
    target: tuple[float, float, float] = (0.0, 0.05, 0.0)
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    fov: float = 40.0
    to_uv: np.ndarray = field(
        default_factory=lambda: _turned(2, 30)[:2, :2] @ np.array([[-1.6, 0.0], [0.0, 1.3]])
    )
    sun: tuple[float, float, float] = (-0.5, 0.35, -1.0)
    irradiance: tuple[float, float, float] = (2.0, 1.5, 1.0)
    lamps: tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...] = (
        ((-1.1, 0.1, 0.9), (0.4, 0.9, 1.2)),
        ((0.9, 0.4, 0.7), (0.8, 0.5, 0.3)),
    )

    def write(self, folder: Path) -> dict[str, Facts]:
        """Write the patches as OBJ files.

        Returns
        -------
        dict of str to dict
            Mitsuba's shapes, without a material.
        """
        from mitsuba import ScalarTransform4f

        shapes: dict[str, Facts] = {}
        for number, patch in enumerate(self.patches.values()):
            path = folder / f"patch{number}.obj"
            path.write_text(_obj(patch.mirrored), "utf-8")
            shapes[f"patch{number}"] = {
                "type": "obj",
                "filename": str(path),
                "to_world": ScalarTransform4f(patch.to_world),
                **({} if patch.turn_over else {"flip_tex_coords": False}),
            }
        return shapes

    def dictionary(self, folder: Path, btf: PathLike) -> Facts:
        """The scene for both renderers, with a BTF; writes the patches."""
        from mitsuba import ScalarTransform4f

        to_uv = np.eye(4)
        to_uv[:2, :2] = self.to_uv
        # No level of detail: the witness does not filter.
        material = {"type": "btf", "filename": str(btf), "lod": "none", "to_uv": ScalarTransform4f(to_uv)}
        bsdf = {"type": "twosided", "inner": material}
        lamps = {
            f"lamp{i}": {"type": "point", "position": list(place), "intensity": _rgb(power)}
            for i, (place, power) in enumerate(self.lamps)
        }
        view = ScalarTransform4f().look_at(list(self.origin), list(self.target), list(self.up))
        return {
            "type": "scene",
            "integrator": {"type": "direct"},
            "camera": {
                "type": "perspective",
                "fov": self.fov,
                "fov_axis": "x",
                "to_world": view,
                "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}},
            },
            **{name: {**shape, "bsdf": bsdf} for name, shape in self.write(folder).items()},
            "sun": {
                "type": "directional",
                "direction": list(self.sun),
                "irradiance": _rgb(self.irradiance),
            },
            **lamps,
        }


def _rgb(value: tuple[float, float, float]) -> Facts:
    return {"type": "rgb", "value": list(value)}


def _obj(mirrored: bool) -> str:
    """A patch with smooth normals and texture coordinates that are not at right angles."""
    steps = np.linspace(-1, 1, QUADS + 1)
    y, x = (a.ravel() for a in np.meshgrid(steps, steps, indexing="ij"))
    z = 0.15 * np.sin(2 * x + 0.5) * np.cos(1.5 * y)
    slope_x, slope_y = (
        0.3 * np.cos(2 * x + 0.5) * np.cos(1.5 * y),
        -0.225 * np.sin(2 * x + 0.5) * np.sin(1.5 * y),
    )
    u, v = (x + 1) / 2 + 0.15 * (y + 1) / 2, (y + 1) / 2
    u = 1 - u if mirrored else u
    lines = [f"v {a} {b} {c}" for a, b, c in zip(x, y, z, strict=True)]
    lines += [f"vt {a} {b}" for a, b in zip(u, v, strict=True)]
    lines += [f"vn {-a} {-b} 1" for a, b in zip(slope_x, slope_y, strict=True)]
    for j in range(QUADS):
        for i in range(QUADS):
            a = j * (QUADS + 1) + i + 1
            for corners in ((a, a + 1, a + QUADS + 2), (a, a + QUADS + 2, a + QUADS + 1)):
                lines.append("f " + " ".join(f"{k}/{k}/{k}" for k in corners))
    return "\n".join(lines) + "\n"
