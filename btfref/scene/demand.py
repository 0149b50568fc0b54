"""What scenes need of their BTFs: the views, lights and texels that cameras and lights touch, and maps with them.

One pass over the first hits of the cameras' rays, with the delta lights that shine on them: what direct light asks of a
BTF. Neighbours of the interpolation are counted, at directions and coordinates moved by a margin as well, since samples
lie between those of the pass and renderers round. Views, lights and their pairs have the same margin. An environment
needs all lights; light that was reflected before may need all views as well, and is only counted where ``indirect``
asks for it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from btfref.errors import InputError
from btfref.scene.first_hits import MARGIN as MARGIN
from btfref.scene.first_hits import Touched
from btfref.types import Progress, SceneLike

if TYPE_CHECKING:
    from btfref.representations.protocol import Representation
    from btfref.sampling.store.selection import Selection
    from btfref.scene.description import SceneDescription
    from btfref.scene.first_hits import Shape
    from btfref.scene.loading import Kept


#: Which maps of a file renderers load.
KEEP = ("all", "needed")

#: Levels of detail by which a footprint may be off.
LEVEL_MARGIN = 0.01


@dataclass(frozen=True, eq=False)
class Demand:
    """What is needed of one BTF.

    Attributes
    ----------
    file : str
        As the scene names it.
    views, lights : ndarray of bool, shape (n,)
    pairs : ndarray of bool, shape (n_views, n_lights)
        Needed together: what is traced. Maps are kept by views and by lights.
    texels : ndarray of bool, shape (rows, columns)
    least_lod : float
        Finest level of detail that a lookup has; levels below its floor are not needed.
    lookups : int
        That were looked at.
    """

    file: str
    views: np.ndarray
    lights: np.ndarray
    pairs: np.ndarray
    texels: np.ndarray
    least_lod: float = 0.0
    lookups: int = 0
    maps: dict = field(default_factory=dict)

    def __or__(self, other: Demand) -> Demand:
        """What either needs: several cameras, or frames of an animation."""
        if [a.shape for a in (self.pairs, self.texels)] != [a.shape for a in (other.pairs, other.texels)]:
            raise InputError("BTFs of different shapes", file=self.file, field="demand", got=other.file)
        return replace(
            self,
            **{name: getattr(self, name) | getattr(other, name) for name in _MASKS},
            least_lod=min(self.least_lod, other.least_lod),
            lookups=self.lookups + other.lookups,
            maps={},
        )

    def tiles(self, most: int) -> np.ndarray:
        """Tiles that hold a needed texel, shape (tile rows, tile columns) bool.

        They are those of a store, with at most ``most`` texels a side: `btfref.sampling.store.layout.side_of`.
        """
        from btfref.sampling.store.layout import side_of

        high, wide = (side_of(n, most) for n in self.texels.shape)
        rows, columns = -(-self.texels.shape[0] // high), -(-self.texels.shape[1] // wide)
        padded = np.zeros((rows * high, columns * wide), bool)
        padded[: self.texels.shape[0], : self.texels.shape[1]] = self.texels
        return np.any(padded.reshape(rows, high, columns, wide), axis=(1, 3))

    def part(self, most: int | None = None) -> Selection:
        """What to synthesize: a `btfref.sampling.store.selection.Selection` of pairs, and of tiles as stores have them.

        Raises
        ------
        InputError
            When nothing is needed.
        """
        from btfref.sampling.store.layout import TILE
        from btfref.sampling.store.selection import Selection

        tiles = np.flatnonzero(self.tiles(most or TILE))
        if not self.pairs.any() or not len(tiles):
            raise InputError("the scene needs nothing of this BTF", file=self.file, field="demand")
        return Selection.of_pairs(self.pairs, tiles.tolist())

    def first_level(self, total: int) -> int:
        """Finest of ``total`` levels of detail that is needed; a little finer than found, since renderers round."""
        return int(np.clip(np.floor(self.least_lod - LEVEL_MARGIN), 0, total - 1))

    def shares(self) -> dict[str, tuple[int, int]]:
        """Needed and whole numbers by what they count: views, lights, pairs, texels, samples, and further maps.

        Samples are texels of pairs.

        Returns
        -------
        dict of str to (int, int)
        """
        found = {name: (int(getattr(self, name).sum()), getattr(self, name).size) for name in _MASKS}
        needed, whole = (int(np.prod([found[n][i] for n in ("pairs", "texels")])) for i in (0, 1))
        return {**found, "samples": (needed, whole), **self.maps}


_MASKS = ("views", "lights", "pairs", "texels")


def demand(
    scene: SceneLike,
    *,
    parameters: Mapping[str, object] | None = None,
    description: SceneDescription | None = None,
    grid: int = 4,
    size: tuple[int, int] | None = None,
    margin: float | None = None,
    shape: Shape | None = None,
    indirect: bool = False,
    progress: Progress | None = None,
) -> dict[str, Demand]:
    """What the direct light of a scene needs of its BTFs.

    Parameters
    ----------
    scene : path-like or dict
        Mitsuba scene.
    parameters : dict of str to str, optional
        Values for ``$name`` in the file.
    description : SceneDescription, optional
        Of the same scene, where it was read before.
    grid : int
        n of the n × n sub-pixel samples.
    size : (int, int), optional
        Width and height in place of the scene's.
    margin : float, optional
        Radians by which directions may be off; default: by what they change from a sample of the pass to the second
        next, at least the angle of a pixel and ``MARGIN``. Coordinates may be off by a texel.
    shape : (DirectionSet, DirectionSet, (int, int)), optional
        Views, lights and texels of a BTF that is not there yet; default: read from the files.
    indirect : bool
        Count all views and lights: what light that was reflected more than once may need.
    progress : callable, optional

    Returns
    -------
    dict of str to Demand
        By the file's name.

    Raises
    ------
    InputError
        For a scene that cannot be read.
    """
    from btfref.scene.description import read_scene
    from btfref.scene.hits import surfaces
    from btfref.scene.loading import loaded
    from btfref.scene.reading.instances import drawn_shapes

    if description is None:
        description = read_scene(scene, parameters, size=size, missing_btf=shape is not None)
    least = max(MARGIN, description.camera.pixel_angle) if margin is None else margin
    wanted = {}
    for mesh in description.meshes:
        if mesh.material is not None and mesh.material.filename not in wanted:
            wanted[mesh.material.filename] = Touched(mesh.material.filename, shape, least)
    # Of area lights too: which directions they have is not followed.
    areas = any(light.kind == "area" for light in description.lights)
    from_everywhere = description.environment is not None or areas
    with loaded(scene, parameters, size=size, plain=True) as made:
        # Samples of the next pixel are ``grid`` samples away.
        beside = None
        if margin is None:
            beside = int(made.sensors()[0].film().crop_size()[0]), min(1.0, 2 / grid)
        camera, angle = description.camera, description.camera.pixel_angle / grid
        shapes = drawn_shapes(made, [mesh.where for mesh in description.meshes])
        for number, surface in enumerate(surfaces(made, grid)):
            for mesh, one in zip(description.meshes, shapes, strict=True):
                if mesh.material is not None:
                    wanted[mesh.material.filename].add(surface, one, mesh.material, camera, angle, beside)
            if progress is not None:
                progress(number + 1, grid**2, "first hits")
    return {name: Demand(name, *found.result(from_everywhere, indirect)) for name, found in wanted.items()}


def kept_maps(
    keep: str,
    scene: SceneLike,
    parameters: Mapping[str, object] | None = None,
    *,
    lights: bool = True,
    **settings: Any,
) -> Kept:
    """The maps of a scene's files that a renderer loads, as :func:`btfref.representations.load` takes them.

    Parameters
    ----------
    keep : {"all", "needed"}
    scene, parameters, **settings
        As for :func:`demand`.
    lights : bool
        Choose among lights too; False keeps all of them.

    Returns
    -------
    dict of str to dict
        By file: "views", "lights", "entries", "levels": arrays of int, or None where the method keeps no maps by them.
        Empty where all are kept.

    Raises
    ------
    InputError
        For another word, or a scene that cannot be read.
    """
    if keep not in KEEP:
        raise InputError("unknown choice of maps", field="keep", got=keep, expected=" or ".join(KEEP))
    if keep == "all":
        return {}
    return {
        file: choice(one, lights=lights)
        for file, one in demand(scene, parameters=parameters, **settings).items()
    }


def number_kept(kept: Kept) -> dict[str, dict[str, int]]:
    """How many maps are kept, by file and by what was chosen."""
    return {
        file: {kind: len(chosen) for kind, chosen in choices.items() if chosen is not None}
        for file, choices in kept.items()
    }


def choice(one: Demand, *, lights: bool = True) -> dict[str, np.ndarray | None]:
    """What to keep of the file of a :class:`Demand`; see :func:`kept_maps`."""
    from btfref.registry import method
    from btfref.representations.file.container import read_info, read_maps
    from btfref.representations.file.resident import KINDS
    from btfref.representations.protocol import HasEntries, HasLevels, direction_axes

    file = one.file
    made = method(read_info(file)["method"], file=file).representation
    chosen: dict[str, np.ndarray | None] = dict.fromkeys(("views", "lights", "entries", "levels"))
    for kind in KINDS:
        mask = one.views if kind == "view" else one.lights
        if (lights or kind == "view") and mask.any() and direction_axes(made, kind):
            chosen[f"{kind}s"] = np.flatnonzero(mask)
    if isinstance(made, HasEntries) and one.texels.any():
        names = made.ENTRIES
        arrays, meta = read_maps(file, lambda name: name == names.index)
        if "resident_entries" not in meta:
            chosen["entries"] = np.unique(arrays[names.index][one.texels])
    if isinstance(made, HasLevels):
        _, meta = read_maps(file, lambda name: False)
        total = len(meta["levels"])
        chosen["levels"] = np.arange(one.first_level(total), total)
    return chosen


def maps_needed(demanded: Demand, representation: Representation) -> Demand:
    """The same demand with what it needs of a representation's levels and of the entries of its index maps.

    Parameters
    ----------
    demanded : Demand
    representation : Representation

    Returns
    -------
    Demand
        ``maps``: name to (needed, whole): "levels" of methods that have them, and for each map of indices (clusters,
        materials) how many of its entries occur in needed texels.
    """
    from btfref.representations.protocol import HasLevels

    maps = {}
    if isinstance(representation, HasLevels):
        total = int(representation.max_lod) + 1
        maps["levels"] = total - demanded.first_level(total), total
    for name, array in representation.arrays().items():
        if array.dtype == np.uint32 and array.shape[:2] == demanded.texels.shape and array.ndim == 3:
            used = np.unique(array[demanded.texels])
            maps[f"entries of {name}"] = len(used), int(array.max()) + 1
    return replace(demanded, maps=maps)
