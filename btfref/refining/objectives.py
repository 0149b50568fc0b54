"""What refinement makes small: the loss at rows of true values, or of the pixels of a picture.

An objective has two parts that share nothing, one to follow and one to judge by. Each is asked for the loss of random
batches, whose derivatives reach the maps, or of all it has.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Protocol

import numpy as np

from btfref.errors import InputError
from btfref.numerics.device_arrays import to_device
from btfref.querying.footprints import offset
from btfref.refining.losses import LOSSES

if TYPE_CHECKING:
    from btfref.refining.rows import Rows
    from btfref.refining.variables import Variables
    from btfref.types import Facts, JitArray, PathLike, SceneLike

#: Share that is held out, and the most rows of it.
HELD_OUT, MOST_HELD_OUT = 0.1, 1 << 14

#: Random places in the footprint of a row.
LOOKUPS = 4

#: Samples of a pixel, and path lengths, of the pictures that a picture is compared with.
SPP, MAX_DEPTH = 16, 3


class Objective(Protocol):
    """One of the two parts."""

    def batch(self, variables: Variables, rng: np.random.Generator) -> JitArray:
        """Mean loss of a random batch by the maps as they are put, a Float with derivatives."""

    def whole(self, variables: Variables) -> float:
        """Mean loss of all, always by the same random numbers."""


class AtRows:
    """The loss at rows.

    Parameters
    ----------
    rows : Rows
    loss : str
    batch : int
        Rows of a batch.
    seed : int
        Of the places in footprints when all rows are asked for.
    """

    def __init__(self, rows: Rows, loss: str, batch: int, seed: int) -> None:
        import mitsuba_plugins

        mi = mitsuba_plugins.ready()
        self._rows, self._loss, self._batch = rows, LOSSES[loss], min(batch, len(rows))
        columns = rows.columns
        self._level = max(float(np.abs(columns["B"]).mean(dtype=float)), 1e-12)
        place = np.concatenate([columns["uv"], columns["radius"][:, None]], 1)
        self._place = to_device(mi.Float, place)
        self._known = {name: to_device(mi.Float, columns[name]) for name in ("w_light", "w_view", "B")}
        self._lookups = LOOKUPS if (columns["radius"] > 0).any() else 1
        self._seed = seed

    def batch(self, variables: Variables, rng: np.random.Generator) -> JitArray:
        """See :class:`Objective`."""
        n = len(self._rows)
        # With replacement where rows are many: no pass over all of them is needed.
        index = rng.integers(0, n, self._batch) if self._batch < n else np.arange(n)
        return self._mean(variables, index, rng.random((self._batch, self._lookups, 2)))

    def whole(self, variables: Variables) -> float:
        """See :class:`Objective`."""
        import drjit as dr

        n = len(self._rows)
        places = np.random.default_rng([self._seed, 1]).random((n, self._lookups, 2))
        with dr.suspend_grad():
            return float(self._mean(variables, np.arange(n), places)[0])

    def _mean(self, variables: Variables, index: np.ndarray, places: np.ndarray) -> JitArray:
        import drjit as dr
        import mitsuba as mi

        n, k = places.shape[:2]
        at = to_device(mi.UInt32, np.repeat(index, k))
        shift = offset(self._rows.footprint, places.reshape(n * k, 2))
        dx, dy = (to_device(mi.Float, shift[:, axis]) for axis in (0, 1))
        u, v, radius = dr.gather(mi.Vector3f, self._place, at)
        uv = mi.Point2f(dr.fma(radius, dx, u), dr.fma(radius, dy, v))
        w_light, w_view = (dr.gather(mi.Vector3f, self._known[name], at) for name in ("w_light", "w_view"))
        above = (w_light.z > 0) & (w_view.z > 0)
        value = dr.select(above, variables.evaluator.evaluate(uv, w_light, w_view, above), mi.Color3f(0))
        if k > 1:
            value = mi.Color3f(*(dr.block_sum(channel, k) * (1 / k) for channel in value))
        truth = dr.gather(mi.Color3f, self._known["B"], to_device(mi.UInt32, index))
        return dr.mean(self._loss(value, truth, self._level))


def at_rows(
    rows: Rows, loss: str, batch: int, seed: int, rng: np.random.Generator
) -> tuple[AtRows, AtRows, Facts]:
    """The two parts of rows, and what the file says of them."""
    if len(rows) < 2:
        raise InputError("too few rows to hold some out", field="data", got=len(rows), expected="at least 2")
    order = rng.permutation(len(rows))
    n = int(np.clip(HELD_OUT * len(rows), 1, MOST_HELD_OUT))
    held, used = (AtRows(rows.part(part), loss, batch, seed) for part in (order[:n], order[n:]))
    return used, held, {"data": rows.source, "rows": len(rows) - n, "held_out": n}


class AtPixels:
    """The loss of some pixels of a picture.

    Parameters
    ----------
    scene : mitsuba.Scene
    picture : ndarray, shape (height, width, 3)
    mask : ndarray of bool, shape (height, width)
    loss : str
    seed : int
        Of the samples when the whole is asked for.
    """

    def __init__(self, scene: JitArray, picture: np.ndarray, mask: np.ndarray, loss: str, seed: int) -> None:
        import mitsuba as mi

        self._scene, self._loss, self._seed = scene, LOSSES[loss], seed
        self._index = to_device(mi.UInt32, np.flatnonzero(mask))
        # As a value in 1/sr, which losses of colours multiply by π.
        self._truth = to_device(mi.Color3f, (picture[mask] / np.pi).T)
        self._level = max(float(np.abs(picture[mask]).mean()) / np.pi, 1e-12)
        self._integrator = mi.load_dict({"type": "prb", "max_depth": MAX_DEPTH})

    def batch(self, variables: Variables, rng: np.random.Generator) -> JitArray:
        """See :class:`Objective`."""
        return self._mean(variables, int(rng.integers(1 << 30)))

    def whole(self, variables: Variables) -> float:
        """See :class:`Objective`."""
        import drjit as dr

        with dr.suspend_grad():
            return float(self._mean(variables, self._seed)[0])

    def _mean(self, variables: Variables, seed: int) -> JitArray:
        import drjit as dr
        import mitsuba as mi

        # What `mi.render` looks for: the maps whose derivatives it is to pass on.
        maps = mi.SceneParameters({n: (a, None, None, 0) for n, a in variables.tensors.items()}, {})
        picture = mi.render(
            self._scene, maps, integrator=self._integrator, spp=SPP, seed=seed, seed_grad=seed + 1
        )
        value = dr.gather(mi.Color3f, picture.array, self._index) * (1 / np.pi)
        return dr.mean(self._loss(value, self._truth, self._level))


@contextmanager
def at_pixels(
    file: PathLike,
    path: PathLike,
    scene: SceneLike,
    parameters: Mapping[str, object],
    loss: str,
    seed: int,
    rng: np.random.Generator,
) -> Iterator[tuple[AtPixels, AtPixels, JitArray, Facts]]:
    """The two parts of a picture, the material to move, and what the file says of them.

    Parameters
    ----------
    file : path-like
        Of the representation.
    path : path-like
        Picture (``.exr``).
    scene, parameters
        As `btfref.render` takes them; the scene's one BTF, its parameter ``btf``, is `file`.

    Raises
    ------
    InputError
        For a picture that is not finite, or a scene with no or several materials of `file`.
    """
    from pathlib import Path

    from btfref.images import load_image
    from btfref.scene.camera import tell_camera
    from btfref.scene.loading import loaded
    from mitsuba_plugins.protocol import shown_by

    picture = np.asarray(load_image(path), np.float32)[..., :3]
    finite = np.isfinite(picture).all(-1)
    if not finite.all():
        raise InputError("pixels that are not finite", file=path, got=int((~finite).sum()))
    height, width = picture.shape[:2]
    with loaded(scene, {**parameters, "btf": str(file)}, size=(width, height)) as made:
        tell_camera(made, SPP**-0.5)
        found: dict[int, JitArray] = {
            id(one): one for shape in made.shapes() for one in shown_by(shape.bsdf())
        }
        own = [one for one in found.values() if Path(one.filename).samefile(file)]
        if len(own) != 1:
            raise InputError("materials of the scene with this file", file=file, got=len(own), expected=1)
        held = rng.random((height, width)) < HELD_OUT
        held.flat[rng.integers(held.size)] = True
        if held.all():
            raise InputError("too few pixels to hold some out", file=path, got=held.size)
        parts = [AtPixels(made, picture, mask, loss, seed) for mask in (~held, held)]
        facts: Facts = {"data": Path(path).name, "rows": int((~held).sum()), "held_out": int(held.sum())}
        yield parts[0], parts[1], own[0], facts
