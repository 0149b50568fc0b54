"""The first hits of a camera's rays as lookups of a BTF: which samples, texels and levels of detail they read."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from btfref.conventions import texel_stencil
from btfref.numerics.sphere import interpolation
from btfref.scene.hits import Hits
from btfref.types import PathLike

if TYPE_CHECKING:
    from btfref.numerics.sphere.directions import DirectionSet
    from btfref.numerics.sphere.interpolation import Interpolation
    from btfref.representations.protocol import SeesTexels
    from btfref.scene.description import Camera
    from btfref.scene.hits import Surface
    from btfref.scene.reading.instances import Drawn
    from btfref.scene.shapes import BtfMaterial


#: Views, lights and texels (rows, columns) of a BTF.
Shape = tuple["DirectionSet", "DirectionSet", tuple[int, int]]

#: Least margin of directions, radians: renderers round.
MARGIN = 1e-4

#: Most that directions of neighbouring pixels say of the margin, radians: a step of more is an edge.
LARGEST_CHANGE = 0.25

#: Where a direction may be instead, in margins.
_SHIFTS = np.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)


class Touched:
    """Gathers what lookups of one BTF touch.

    Parameters
    ----------
    file : path-like
        Of the representation.
    shape : (DirectionSet, DirectionSet, (int, int)) or None
        Views, lights and texels of a BTF that is not there yet.
    margin : float
        Radians by which directions may be off at least.
    """

    def __init__(self, file: PathLike, shape: Shape | None, margin: float) -> None:
        #: Representation whose lookups read texels elsewhere than at their coordinates.
        self.surface: SeesTexels | None = None
        if shape is None:
            from btfref.registry import method
            from btfref.representations.file.container import load, read_maps
            from btfref.representations.protocol import SeesTexels

            arrays, meta = read_maps(file, lambda name: name.startswith(("view_", "light_")))
            self.size = tuple(meta["texels"])
            self.tables = [interpolation.from_arrays(arrays, kind) for kind in ("view", "light")]
            counts = [meta[f"{kind}s"]["count"] for kind in ("view", "light")]
            if isinstance(method(meta["method"], file=file).representation, SeesTexels):
                loaded = load(file)
                assert isinstance(loaded, SeesTexels)
                self.surface = loaded
        else:
            views, lights, self.size = shape
            self.tables, counts = [views.interpolation, lights.interpolation], [len(views), len(lights)]
        # Kept views are indices of their own: here, those of the whole count.
        self.tables = [interpolation.whole(table) for table in self.tables]
        self.file, self.margin = file, margin
        self.views, self.lights = (np.zeros(n, bool) for n in counts)
        self.pairs, self.texels = np.zeros(counts, bool), np.zeros(self.size, bool)
        self.least_lod, self.lookups = np.inf, 0

    def add(
        self,
        surface: Surface,
        drawn: Drawn,
        material: BtfMaterial,
        camera: Camera,
        angle: float,
        beside: tuple[int, float] | None = None,
    ) -> None:
        """Count the lookups of one shape's first hits.

        Parameters
        ----------
        surface : Surface
        drawn : btfref.scene.reading.instances.Drawn
        material : BtfMaterial
            The shape's.
        camera : Camera
        angle : float
            That a sample subtends, in radians.
        beside : (int, float), optional
            Width of the picture, and share of the changes from pixel to pixel that is margin.
        """
        seen = surface.sees(drawn)
        hits = Hits.of(surface, material, np.flatnonzero(seen))
        front = hits.w_view[:, 2] > -self.margin
        if not front.any():
            return
        hits = Hits.of(surface, material, hits.at[front])
        margin = self._margins(surface["wi"], seen, beside)[front]
        view_sets = self._touched(self.tables[0], hits.w_view, margin)
        self.views[view_sets.all_touched()] = True
        self._touch_texels(hits.uv, hits.w_view)
        if material.lod == "auto" and material.lod_bias == 0:
            lod, _, _ = hits.footprint(camera.origin, angle, self.size)
            self.least_lod = min(self.least_lod, float(lod.min()))
        else:
            self.least_lod = 0.0
        self.lookups += len(hits.at) * len(surface.lights)
        for light in surface.lights:
            w_light, margin = hits.local(light[hits.at]), self._margins(light, seen, beside)[front]
            lit = np.isfinite(w_light).all(1) & (w_light[:, 2] > -margin)
            if not lit.any():
                continue
            light_sets = self._touched(self.tables[1], w_light[lit], margin[lit])
            self.lights[light_sets.all_touched()] = True
            _mark_pairs(self.pairs, view_sets, light_sets, lit)

    def _margins(self, w: np.ndarray, seen: np.ndarray, beside: tuple[int, float] | None) -> np.ndarray:
        """By what directions of the seen lookups may be off: by what they change to those of neighbouring pixels."""
        if beside is None:
            return np.full(int(seen.sum()), self.margin)
        width, share = beside
        w, seen = w.reshape(-1, width, 3), seen.reshape(-1, width)
        change = np.full(seen.shape, self.margin)
        for axis in (0, 1):
            first, second = (np.moveaxis(change, axis, 0)[part] for part in (slice(-1), slice(1, None)))
            with np.errstate(invalid="ignore", over="ignore"):
                step = np.moveaxis(np.linalg.norm(np.diff(w, axis=axis), axis=-1), axis, 0)
            both = np.moveaxis(seen, axis, 0)
            # Behind a silhouette there is another surface, or none: neighbours inside tell how fast this one turns.
            inside = both[:-1] & both[1:] & np.isfinite(step)
            step = np.where(inside, share * np.minimum(step, LARGEST_CHANGE), 0)
            np.maximum(first, step, out=first)
            np.maximum(second, step, out=second)
        return change[seen]

    def _touched(self, table: Interpolation, w: np.ndarray, margin: np.ndarray) -> _Sets:
        """Sets of the samples with weight at each direction or within the margin of it."""
        index, weight = [], []
        for shift in _SHIFTS:
            some = table.stencil(_upper(w + margin[:, None] * shift))
            index.append(some[0])
            weight.append(some[1])
        return _Sets.of_rows(np.where(np.concatenate(weight, 1) > 0, np.concatenate(index, 1), -1))

    def _touch_texels(self, uv: np.ndarray, w_view: np.ndarray) -> None:
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

    def result(
        self, from_everywhere: bool, indirect: bool
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float, int]:
        """Views, lights, pairs, texels, finest level and number of lookups, as of :class:`btfref.scene.demand.Demand`.

        All lights where they come from everywhere, and all views where light is reflected on.
        """
        if self.views.any() and (from_everywhere or indirect):
            self.views |= indirect
            self.lights[:] = True
            self.pairs |= self.views[:, None]
        least = 0.0 if indirect or not np.isfinite(self.least_lod) else self.least_lod
        return self.views, self.lights, self.pairs, self.texels, least, self.lookups


class _Sets:
    """Sets of samples, one for each lookup; few of them differ.

    Attributes
    ----------
    rows : ndarray of int, shape (n_sets, k)
        Members of each set; −1 stands for nothing.
    which : ndarray of int, shape (n_lookups,)
        Set of each lookup.
    """

    def __init__(self, rows: np.ndarray, which: np.ndarray) -> None:
        self.rows, self.which = rows, which

    @classmethod
    def of_rows(cls, rows: np.ndarray) -> _Sets:
        """From the members of each lookup's set; equal sets in another order count as another set."""
        # Sorting the rows themselves would take ten times as long as sorting one number of each.
        factors = np.random.default_rng(0).integers(1, 2**63, rows.shape[1], np.uint64)
        _, first, which = np.unique(rows.astype(np.uint64) @ factors, return_index=True, return_inverse=True)
        if not np.array_equal(rows[first][which], rows):
            _, first, which = np.unique(rows, axis=0, return_index=True, return_inverse=True)
        return cls(rows[first], which.ravel())

    def all_touched(self) -> np.ndarray:
        """Members of any set."""
        return np.unique(self.rows[self.rows >= 0])


def _mark_pairs(pairs: np.ndarray, views: _Sets, lights: _Sets, lit: np.ndarray) -> None:
    """Mark all pairs of a lookup's views and lights; ``lights`` has the lookups of ``lit`` alone."""
    n_sets = len(lights.rows)
    both = np.unique(views.which[lit].astype(np.int64) * n_sets + lights.which)
    for first in range(0, len(both), 4096):
        view, light = (
            sets[some]
            for sets, some in zip(
                (views.rows, lights.rows), np.divmod(both[first : first + 4096], n_sets), strict=True
            )
        )
        inside = (view >= 0)[:, :, None] & (light >= 0)[:, None, :]
        flat = view[:, :, None] * pairs.shape[1] + light[:, None, :]
        pairs.reshape(-1)[flat[inside]] = True


def _upper(w: np.ndarray) -> np.ndarray:
    """Unit vectors above the horizon nearest to ``w``."""
    w = np.array(w)
    w[:, 2] = np.maximum(w[:, 2], 1e-6)
    return w / np.linalg.norm(w, axis=1, keepdims=True)
