"""What scenes need of their BTFs: the views, lights and texels that cameras and lights touch, and maps with them.

One pass over the first hits of the cameras' rays, with the delta lights that shine on them: what direct light asks of a
BTF. Neighbours of the interpolation are counted, at directions and coordinates moved by a margin as well, since samples
lie between those of the pass and renderers round. An environment needs all lights; light that was reflected before may
need all views as well, and is only counted where ``indirect`` asks for it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from btfref.conventions import texel_stencil
from btfref.errors import InputError

#: Least margin of directions, radians: renderers round.
MARGIN = 1e-4

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
        Needed together, without a margin.
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

    def __or__(self, other):
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

    def tiles(self, side):
        """Tiles of ``side`` × ``side`` texels that hold a needed one, shape (tile rows, tile columns) bool."""
        rows, columns = (-(-n // side) for n in self.texels.shape)
        padded = np.zeros((rows * side, columns * side), bool)
        padded[: self.texels.shape[0], : self.texels.shape[1]] = self.texels
        return padded.reshape(rows, side, columns, side).any((1, 3))

    def part(self, side=None):
        """What to synthesize: a `btfref.sampling.part.Part` of tiles as stores have them.

        Raises
        ------
        InputError
            When nothing is needed.
        """
        from btfref.sampling.layout import TILE
        from btfref.sampling.part import Part

        masks = self.views, self.lights, self.tiles(side or TILE).ravel()
        if not all(mask.any() for mask in masks):
            raise InputError("the scene needs nothing of this BTF", file=self.file, field="demand")
        return Part(*(tuple(np.flatnonzero(mask).tolist()) for mask in masks))

    def first_level(self, total):
        """Finest of ``total`` levels of detail that is needed; a little finer than found, since renderers round."""
        return int(np.clip(np.floor(self.least_lod - LEVEL_MARGIN), 0, total - 1))

    def shares(self):
        """Needed and whole numbers by what they count: views, lights, pairs, texels, samples, and further maps.

        Returns
        -------
        dict of str to (int, int)
        """
        found = {name: (int(getattr(self, name).sum()), getattr(self, name).size) for name in _MASKS}
        needed, whole = (int(np.prod([found[n][i] for n in ("views", "lights", "texels")])) for i in (0, 1))
        return {**found, "samples": (needed, whole), **self.maps}


_MASKS = ("views", "lights", "pairs", "texels")


def demand(
    scene, *, parameters=None, grid=4, size=None, margin=None, shape=None, indirect=False, progress=None
):
    """What the direct light of a scene needs of its BTFs.

    Parameters
    ----------
    scene : path-like or dict
        Mitsuba scene.
    parameters : dict of str to str, optional
        Values for ``$name`` in the file.
    grid : int
        n of the n × n sub-pixel samples.
    size : (int, int), optional
        Width and height in place of the scene's.
    margin : float, optional
        Radians by which directions may be off; default: the angle of a pixel, at least ``MARGIN``. Coordinates may be
        off by a texel.
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
    from btfref.render.camera import film_rays, grid_offsets
    from btfref.render.loading import loaded
    from btfref.render.scene import read_scene

    description = read_scene(scene, parameters, size=size, missing_btf=shape is not None)
    margin = max(MARGIN, description.camera.pixel_angle) if margin is None else margin
    wanted = {}
    for mesh in description.meshes:
        if mesh.material is not None and mesh.material.filename not in wanted:
            wanted[mesh.material.filename] = _Collector(mesh.material.filename, shape, margin)
    from_everywhere = description.environment is not None
    offsets = grid_offsets(grid)
    with loaded(scene, parameters, size=size, plain=True) as made:
        for number, offset in enumerate(offsets):
            ray, _ = film_rays(made.sensors()[0], offset)
            si = made.ray_intersect(ray)
            lights = _light_directions(made, si)
            for mesh, one in zip(description.meshes, made.shapes(), strict=True):
                if mesh.material is not None:
                    footprint = description.camera.pixel_angle / grid
                    wanted[mesh.material.filename].add(si, one, lights, mesh.material, footprint)
            if progress is not None:
                progress(number + 1, len(offsets), "first hits")
    return {name: collector.demand(from_everywhere, indirect) for name, collector in wanted.items()}


def kept_maps(scene, parameters=None, *, lights=True, **settings):
    """The maps that a scene needs, as :func:`btfref.representations.load` takes them.

    Parameters
    ----------
    scene, parameters, **settings
        As for :func:`demand`.
    lights : bool
        Choose among lights too; False keeps all of them.

    Returns
    -------
    dict of str to dict
        By file: "views", "lights", "entries", "levels": arrays of int, or None where the method keeps no maps by them.
    """
    return {
        file: choice(one, lights=lights)
        for file, one in demand(scene, parameters=parameters, **settings).items()
    }


def choice(one, *, lights=True):
    """What to keep of the file of a :class:`Demand`; see :func:`kept_maps`."""
    from btfref.registry import method
    from btfref.representations.container import read_info, read_maps
    from btfref.representations.resident import KINDS

    file = one.file
    made = method(read_info(file)["method"], file=file).representation
    chosen = {"views": one.views, "lights": one.lights if lights else None}
    for kind, axes in KINDS.items():
        mask = chosen[f"{kind}s"]
        known = mask is not None and mask.any() and getattr(made, axes, {})
        chosen[f"{kind}s"] = np.flatnonzero(mask) if known else None
    names = getattr(made, "ENTRIES", None)
    chosen["entries"], chosen["levels"] = None, None
    if names is not None and one.texels.any():
        arrays, meta = read_maps(file, lambda name: name == names.index)
        if "resident_entries" not in meta:
            chosen["entries"] = np.unique(arrays[names.index][one.texels])
    if getattr(made, "LEVELS", None) is not None:
        _, meta = read_maps(file, lambda name: False)
        total = len(meta["levels"])
        chosen["levels"] = np.arange(one.first_level(total), total)
    return chosen


def maps_needed(demanded, representation):
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
    maps = {}
    if hasattr(representation, "max_lod"):
        total = int(representation.max_lod) + 1
        maps["levels"] = total - demanded.first_level(total), total
    for name, array in representation.arrays().items():
        if array.dtype == np.uint32 and array.shape[:2] == demanded.texels.shape and array.ndim == 3:
            used = np.unique(array[demanded.texels])
            maps[f"entries of {name}"] = len(used), int(array.max()) + 1
    return replace(demanded, maps=maps)


class _Collector:
    """Gathers what lookups of one BTF touch."""

    def __init__(self, file, shape, margin):
        #: Representation whose lookups read texels elsewhere than at their coordinates.
        self.surface = None
        if shape is None:
            from btfref.numerics import interpolation
            from btfref.registry import method
            from btfref.representations.container import load, read_maps

            arrays, meta = read_maps(file, lambda name: name.startswith(("view_", "light_")))
            self.size = tuple(meta["texels"])
            self.tables = [interpolation.from_arrays(arrays, kind) for kind in ("view", "light")]
            counts = [meta[f"{kind}s"]["count"] for kind in ("view", "light")]
            if hasattr(method(meta["method"], file=file).representation, "seen_texels"):
                self.surface = load(file)
        else:
            views, lights, self.size = shape
            self.tables, counts = [views.interpolation, lights.interpolation], [len(views), len(lights)]
        # Kept views are indices of their own: here, those of the whole count.
        self.tables = [getattr(table, "inner", table) for table in self.tables]
        self.file, self.margin = file, margin
        self.views, self.lights = (np.zeros(n, bool) for n in counts)
        self.pairs, self.texels = np.zeros(counts, bool), np.zeros(self.size, bool)
        self.least_lod, self.lookups = np.inf, 0

    def add(self, si, shape, lights, material, footprint):
        """Count the lookups of one shape's first hits."""
        import mitsuba as mi

        seen = np.array(si.is_valid() & (si.shape == mi.ShapePtr(shape)))
        if not seen.any():
            return
        w_view, side = _local(np.array(si.wi, float).T[seen], material)
        front = w_view[:, 2] > -self.margin
        if not front.any():
            return
        affine = material.to_uv
        uv = np.array(si.uv, float).T[seen][front] @ affine[:, :2].T + affine[:, 2]
        w_view = w_view[front]
        self.views[self._touched(self.tables[0], w_view)] = True
        self._touch_texels(uv, w_view)
        if material.lod == "auto" and material.lod_bias == 0:
            self._touch_levels(si, seen, front, material, footprint)
        else:
            self.least_lod = 0.0
        view_index, view_weight = self.tables[0].stencil(_upper(w_view))
        self.lookups += len(uv) * len(lights)
        for light in lights:
            w_light, _ = _local(light[seen], material, side)
            w_light = w_light[front]
            lit = np.isfinite(w_light).all(1) & (w_light[:, 2] > -self.margin)
            if not lit.any():
                continue
            w_light = w_light[lit]
            self.lights[self._touched(self.tables[1], w_light)] = True
            index, weight = self.tables[1].stencil(_upper(w_light), hold=False)
            both = (view_weight[lit][:, :, None] > 0) & (weight[:, None, :] > 0)
            flat = (view_index[lit][:, :, None] * len(self.lights) + index[:, None, :])[both]
            self.pairs.reshape(-1)[np.unique(flat)] = True

    def _touched(self, table, w):
        """Samples with weight at the directions or within the margin of them."""
        m = self.margin
        shifts = m * np.array(
            [[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]
        )
        found = []
        for shift in shifts:
            index, weight = table.stencil(_upper(w + shift))
            found.append(np.unique(index[weight > 0]))
        return np.unique(np.concatenate(found))

    def _touch_texels(self, uv, w_view):
        there = np.zeros(self.size, bool)
        if self.surface is None:
            index, _ = texel_stencil(uv, self.size, "bilinear")
            there.reshape(-1)[np.unique(index)] = True
        else:
            # A ray that is a little off may pass a silhouette and see another place.
            for shift in MARGIN * np.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]]):
                index = self.surface.seen_texels(uv, _upper(w_view + shift))
                there.reshape(-1)[np.unique(index)] = True
        for rows in (-1, 0, 1):
            for columns in (-1, 0, 1):
                self.texels |= np.roll(there, (rows, columns), (0, 1))

    def _touch_levels(self, si, seen, front, material, footprint):
        from btfref.numerics.footprint import cone_footprint

        du, dv, n = (np.array(a, float).T[seen][front] for a in (si.dp_du, si.dp_dv, si.n))
        distance = np.array(si.t, float)[seen][front]
        # Rows of the inverse of (dp_du, dp_dv) in the tangent plane are the gradients of u and v.
        gram = np.stack([(du * du).sum(-1), (du * dv).sum(-1), (dv * dv).sum(-1)], -1)
        determinant = gram[:, 0] * gram[:, 2] - gram[:, 1] ** 2
        scale = 1 / np.where(determinant > 0, determinant, 1)[:, None]
        gradients = [
            (gram[:, 2:3] * du - gram[:, 1:2] * dv) * scale,
            (gram[:, 0:1] * dv - gram[:, 1:2] * du) * scale,
        ]
        a = material.to_uv
        rows, columns = self.size
        u = columns * (a[0, 0] * gradients[0] + a[0, 1] * gradients[1])
        v = rows * (a[1, 0] * gradients[0] + a[1, 1] * gradients[1])
        towards = np.array(si.to_world(si.wi), float).T[seen][front]
        lod, _, _ = cone_footprint(u, v, towards, n, footprint * distance)
        self.least_lod = min(self.least_lod, float(lod.min()))

    def demand(self, from_everywhere, indirect):
        """What was found; all lights where they come from everywhere, and all views where light is reflected on."""
        if self.views.any() and (from_everywhere or indirect):
            self.views |= indirect
            self.lights[:] = True
            self.pairs |= self.views[:, None]
        least = 0.0 if indirect or not np.isfinite(self.least_lod) else self.least_lod
        return Demand(self.file, self.views, self.lights, self.pairs, self.texels, least, self.lookups)


def _light_directions(scene, si):
    """Local directions towards every delta light, each of shape (n, 3), float64."""
    import mitsuba as mi

    result = []
    for emitter in scene.emitters():
        sample, _ = emitter.sample_direction(si, mi.Point2f(0.5))
        result.append(np.array(si.to_local(sample.d), float).T)
    return result


def _local(w, material, side=None):
    """Directions in the texture's frame, and the side of the surface on which the first ones lie."""
    c, s = material.rotation
    w = np.stack([c * w[:, 0] - s * w[:, 1], s * w[:, 0] + c * w[:, 1], w[:, 2]], 1)
    if side is None:
        side = np.where(w[:, 2] < 0, -1.0, 1.0) if material.twosided else np.ones(len(w))
    w[:, 2] *= side
    return w, side


def _upper(w):
    """Unit vectors above the horizon nearest to ``w``."""
    w = np.array(w)
    w[:, 2] = np.maximum(w[:, 2], 1e-6)
    return w / np.linalg.norm(w, axis=1, keepdims=True)
