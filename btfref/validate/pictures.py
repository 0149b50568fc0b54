"""Pictures of the matrix that do not depend on the method: the truth, the sampled BTF, pixel classes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from btfref.scene.facts import scene_facts
from btfref.scene.shipped import scene_file
from btfref.validate.cache import key_of
from btfref.validate.material import load_material, make_material, material_key
from btfref.validate.matrix import ENVIRONMENTS, LIGHTS
from btfref.validate.stages.drawn import code_of
from btfref.validate.stages.fits import fit_key, make_fit

if TYPE_CHECKING:
    from collections.abc import Callable

    from btfref.representations.protocol import Representation
    from btfref.types import Facts, PathLike
    from btfref.validate.cache import Cache
    from btfref.validate.matrix import Settings, Spec


#: Fit whose file stands for the material where only its origin counts: the smallest one.
CARRIER, CARRIER_PARAMETERS = "svd", {"components": 1}

#: Seed of the truth; not that of the synthesis or its twin, whose noise must be independent.
TRUTH_SEED = 77


@dataclass(frozen=True, eq=False)
class Views:
    """What all methods' cells of one scene, its lights and one mesostructure share.

    Parameters
    ----------
    truth : ndarray of float32, shape (batches, H, W, 3)
        The mesostructure under every hit.
    sampled : ndarray of float32, shape (n, H, W, 3)
        The sampled BTF, interpolated: in float64 without noise; under an environment, independent pictures by paths.
    twin : ndarray of float32, shape (H, W, 3), or (0,)
        A sampled BTF of other random numbers, under delta lights.
    classes : ndarray of uint8, shape (H, W)
    """

    truth: np.ndarray
    sampled: np.ndarray
    twin: np.ndarray
    classes: np.ndarray


def views_key(mesostructure: str, scene: str | Path, lights: str, settings: Settings) -> str:
    """Key of a `Views`."""
    named = ("truth_spp", "environment_spp")
    return key_of(
        {
            "views": material_key(mesostructure, settings),
            "scene": scene_facts(scene, {"btf": "", **LIGHTS[lights]}),
            "size": [settings.edge(lights), settings.cells(lights)],
            **{name: getattr(settings, name) for name in named},
            "carrier": [CARRIER, CARRIER_PARAMETERS],
            "code": code_of(__name__, CARRIER, "raw"),
        }
    )


def make_views(cache: Cache, mesostructure: str, scene: str | Path, lights: str, settings: Settings) -> Views:
    """Compute, or read, the `Views` of a scene.

    Returns
    -------
    Views
    """

    def save(path: Path) -> None:
        np.savez(path, **vars(_views(cache, mesostructure, scene, lights, settings)))

    key = views_key(mesostructure, scene, lights, settings)
    with np.load(cache.get(key, ".views.npz", save)) as stored:
        return Views(**{name: stored[name] for name in stored.files})


def _views(cache: Cache, mesostructure: str, scene: str | Path, lights: str, settings: Settings) -> Views:
    from btfref.registry import method
    from btfref.rendering.offline.approximate import approximate
    from btfref.rendering.offline.exact import render_exact
    from btfref.rendering.offline.reference import render
    from btfref.scene.pixel_classes import pixel_classes

    carrier = make_carrier(cache, mesostructure, settings)
    path = scene_file(scene)
    shared = shared_settings(carrier, lights, settings)
    truth = render_exact(path, spp=settings.truth_spp, seed=TRUTH_SEED, **shared)
    classes = pixel_classes(path, **shared)
    if lights in ENVIRONMENTS:
        table = make_fit(cache, mesostructure, "raw", settings)
        pictures = render(
            path,
            spp=settings.environment_spp,
            seed=TRUTH_SEED + 1,
            shadows=False,
            **shared_settings(table, lights, settings),
        )
        return Views(truth.batches, pictures.batches, np.zeros(0, np.float32), classes)
    seen = []
    for twin in (False, True):
        store = make_material(cache, mesostructure, settings, twin=twin)
        table = method("raw").fit(load_material(store))
        seen.append(approximate(path, load_file=_always(table), **shared).image)
    return Views(truth.batches, seen[0][None], seen[1], classes)


def _always(representation: Representation) -> Callable[[str], Representation]:
    """A loader of files that gives one representation for each."""
    return lambda file: representation


def shared_settings(file: PathLike, lights: str, settings: Settings) -> Facts:
    """What all renderers of a cell are told alike."""
    edge = settings.edge(lights)
    return {
        "parameters": {"btf": str(file), **LIGHTS[lights]},
        "grid": settings.cells(lights),
        "size": (edge, edge),
    }


def make_carrier(cache: Cache, mesostructure: str, settings: Settings) -> Path:
    """A small file that says what the material is of."""
    from btfref.registry import method
    from btfref.representations import save

    def save_carrier(path: Path) -> None:
        btf = load_material(make_material(cache, mesostructure, settings))
        save(method(CARRIER).fit(btf, **CARRIER_PARAMETERS), path)

    key = key_of({"carrier": CARRIER_PARAMETERS, "fit": fit_key(mesostructure, CARRIER, settings)})
    return cache.get(key, ".carrier.exr", save_carrier)


def fitted(cache: Cache, spec: Spec, settings: Settings) -> Path:
    """The file of a cell's method."""
    return make_fit(cache, spec.mesostructure, spec.method, settings)
