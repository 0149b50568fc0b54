"""The axes of the matrix, what a run computes of it, and how finely."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from btfref.errors import InputError
from btfref.registry import methods, usable_methods
from btfref.scene.shipped import scene_file

if TYPE_CHECKING:
    from btfref.types import Facts


#: Scenes that show a BTF on a shape of their own: flat, curved, folded and seen from both sides.
SCENES = ("plane", "sphere", "cloth")

#: From all sides alike, a sun and sky, four soft boxes, a small light on black.
ENVIRONMENTS = ("constant", "sky", "studio", "bright-texel")

#: Lights → parameters of the shipped scenes. Under an environment (those with that parameter) nothing is free of noise.
LIGHTS = {
    "directional1": {"lights": "directional1"},
    "directional3": {"lights": "directional3"},
    "points2": {"lights": "points2"},
    **{name: {"lights": "envmap", "environment": name} for name in ENVIRONMENTS},
}

MESOSTRUCTURES = ("checker", "rings", "tissue")

#: What the quick run shows of each method: every scene once, every kind of light.
QUICK_VIEWS = (("plane", "directional1"), ("sphere", "directional3"), ("cloth", "points2"))


@dataclass(frozen=True, order=True)
class Spec:
    """One cell of the matrix.

    Parameters
    ----------
    mesostructure, method, scene, lights : str
    """

    mesostructure: str
    method: str
    scene: str
    lights: str

    @property
    def name(self) -> str:
        """For people, and unique."""
        return f"{self.method} · {self.scene} · {self.lights} · {self.mesostructure}"

    @property
    def slug(self) -> str:
        """The same for files."""
        return "-".join((self.mesostructure, self.method, self.scene, self.lights))


@dataclass(frozen=True)
class Settings:
    """How finely the matrix is computed; all of it enters the keys of what is cached.

    Parameters
    ----------
    texels : int
        Along each side of the tile.
    directions : str
        Views and lights of the sampled BTF.
    estimator : str
    spp : int
        Of the synthesis.
    size : int
        Edge of the pictures in pixels under delta lights.
    environment_size : int
        The same under environments, where hundreds of lights stand for the thousands of samples of a reference.
    grid, environment_grid : int
        Sub-pixels per axis under delta lights and under environments, the same in all renderers. The limits of
        silhouettes are those of 4.
    truth_spp : int
        Paths per pixel and batch of the truth; there are four batches.
    environment_spp : int
        Samples per pixel of the path-traced sampled BTF under an environment, in four batches.
    browser_lights : tuple of str
        Delta lights under which the browser draws the pictures as well.
    browser_ways : tuple of str
        Ways to light by an environment in which the browser draws a small picture of each method that has them.
    port_pixels : int
        Pixels at which the approximation under an environment is evaluated in float64.
    off_grid_rows, off_grid_spp : int
        Rows of each footprint at directions that nobody fitted, and samples of each half of one: those of
        ``btfref bench offgrid``.
    chi2_samples, chi2_intervals : int
        Samples of each χ² test, and intervals a side in which the density is integrated over a cell of its table.
    seed : int
    """

    texels: int = 64
    directions: str = "ubo81"
    estimator: str = "surface"
    spp: int = 16
    size: int = 72
    environment_size: int = 48
    grid: int = 4
    environment_grid: int = 2
    truth_spp: int = 128
    environment_spp: int = 1024
    # SwiftShader takes as long as all else of a cell: one light far away, two near ones. Tests draw the other.
    browser_lights: tuple[str, ...] = ("directional1", "points2")
    browser_ways: tuple[str, ...] = ("prefiltered", "sh", "lights")
    port_pixels: int = 64
    off_grid_rows: int = 20_000
    off_grid_spp: int = 64
    chi2_samples: int = 1_000_000
    chi2_intervals: int | None = None
    seed: int = 0

    def edge(self, lights: str) -> int:
        """Edge of the pictures under some lights, in pixels."""
        return self.environment_size if lights in ENVIRONMENTS else self.size

    def cells(self, lights: str) -> int:
        """Sub-pixels per axis under some lights."""
        return self.environment_grid if lights in ENVIRONMENTS else self.grid

    def to_dict(self) -> Facts:
        """JSON-able form."""
        return asdict(self)


FULL = Settings()
QUICK = replace(
    FULL,
    texels=32,
    size=48,
    environment_size=40,
    truth_spp=192,
    # SwiftShader takes long: one light on the plane, and a curved surface under what only some methods have.
    browser_lights=("directional1",),
    browser_ways=("prefiltered", "sh"),
    off_grid_rows=500,
    off_grid_spp=32,
    chi2_samples=200_000,
)


def select(
    *,
    only: Sequence[str] | None = None,
    scenes: Sequence[str | Path] | None = None,
    lights: Sequence[str] | None = None,
    mesostructures: Sequence[str] | None = None,
    quick: bool = False,
) -> list[Spec]:
    """The cells of a run.

    Parameters
    ----------
    only : sequence of str, optional
        Methods; all registered ones by default, those of installed packages included.
    scenes, lights, mesostructures : sequence of str, optional
        Scenes may be files as well. Without any choice of scene or light the quick run shows three views a method.
    quick : bool

    Returns
    -------
    list of Spec
        Sorted by mesostructure and method.

    Raises
    ------
    InputError
        For a name that is on no axis.
    """
    from btfref.mesostructure import names

    _known("method", only, methods())
    _known("lights", lights, LIGHTS)
    _known("mesostructure", mesostructures, names())
    for scene in scenes or ():
        scene_file(scene)
    keys = only or list(usable_methods())
    materials = mesostructures or (MESOSTRUCTURES[:1] if quick else MESOSTRUCTURES)
    if quick and not scenes and not lights:
        views = list(QUICK_VIEWS)
    else:
        views = [(str(s), light) for s in scenes or SCENES for light in lights or LIGHTS]
    return sorted(Spec(m, key, scene, light) for m in materials for key in keys for scene, light in views)


def _known(what: str, given: Iterable[str] | None, known: Collection[str]) -> None:
    for name in given or ():
        if name not in known:
            raise InputError(f"unknown {what}", got=repr(name), expected=f"one of {', '.join(known)}")
