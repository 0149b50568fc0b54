"""Other people's renderers: the matching reference of a scene, cached, and the gates for a picture of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from btfref.comparison import compare
from btfref.conventions import PixelClass
from btfref.errors import InputError
from btfref.images import load_image
from btfref.provenance.code import code_of
from btfref.scene.facts import digest_of, scene_facts
from btfref.scene.shipped import scene_file
from btfref.validate.cache import Cache, digest, key_of

if TYPE_CHECKING:
    from btfref.comparison import Comparison
    from btfref.comparison.picture_gates import Rounding
    from btfref.types import Facts, PathLike, Progress


#: Gates of a picture of linear radiance under delta lights; of one with 8 bits; of one under an environment.
LINEAR = (
    *("image.noise_free", "image.silhouette", "image.mesostructure"),
    *("image.shadow_border", "image.background"),
)
EIGHT_BIT = ("image.eight_bit", "image.eight_bit_silhouette")
NOISY = ("image.equivalence",)

#: Most samples per pixel of a reference that cannot be free of noise: fewer where its gates are decided by then.
SPP = 1 << 14


@dataclass(frozen=True, eq=False)
class Reference:
    """What a picture is judged by.

    Parameters
    ----------
    image : ndarray of float32, shape (H, W, 3)
    classes : ndarray of uint8, shape (H, W)
    variance : ndarray of float32, shape (H, W, 3), or None
        None where the reference has no noise.
    cached : bool
        Whether it was there already.
    rounding : callable, optional
        What the rounding of texture coordinates may move, for :func:`btfref.compare`; None with noise or shadows.
    """

    image: np.ndarray
    classes: np.ndarray
    variance: np.ndarray | None
    cached: bool = False
    rounding: Rounding | None = None


def reference_of(
    scene: PathLike,
    *,
    parameters: Mapping[str, str] | None = None,
    size: tuple[int, int] | None = None,
    grid: int = 4,
    shadows: bool = False,
    spp: int = SPP,
    cache: PathLike | None = None,
    progress: Progress | None = None,
) -> Reference:
    """The reference picture of a scene, rendered once.

    Parameters
    ----------
    scene : path-like
        A Mitsuba scene file, or the name of a shipped scene.
    parameters : dict of str to str, optional
        Values for ``$name`` in the file.
    size : (int, int), optional
        Width and height in place of the scene's.
    grid : int
        n of the n × n sub-pixel samples; with shadows under an environment the samples are random.
    shadows : bool
        Cast shadows. Under an environment the scene as its file says with them, and direct light alone without.
    spp : int
        Samples per pixel at most where other lights need random numbers.
    cache : path-like, optional
    progress : callable, optional
        ``progress(done, total, label)``.

    Returns
    -------
    Reference

    Raises
    ------
    InputError
        For a scene that cannot be read.
    """
    from btfref.rendering.offline.rounding import rounding_of
    from btfref.representations.file.container import read_info
    from btfref.scene.description import read_scene

    path, parameters = scene_file(scene), dict(parameters or {})
    description = read_scene(path, parameters, size=size)
    files = {m.material.filename for m in description.meshes if m.material}
    facts: Facts = {
        "scene": scene_facts(path, parameters),
        "representations": sorted(digest_of(file) for file in files),
        "size": size,
        "delta": description.environment is None,
        "settings": [grid, shadows] if description.environment is None else [grid, shadows, spp],
        "code": code_of(__name__, *(read_info(file)["method"] for file in files)),
    }

    def save(target: Path) -> None:
        asked = (size, grid, shadows, spp, facts["delta"])
        np.savez_compressed(target, **_render(path, parameters, *asked, progress))

    store = Cache(cache)
    with np.load(store.get(key_of({"reference": facts}), ".reference.npz", save)) as stored:
        variance = stored["variance"] if "variance" in stored.files else None
        plain = facts["delta"] and not shadows
        rounding = rounding_of(path, parameters=parameters, size=size, grid=grid) if plain else None
        return Reference(stored["image"], stored["classes"], variance, not store.computed, rounding)


def _render(
    path: Path,
    parameters: Mapping[str, str],
    size: tuple[int, int] | None,
    grid: int,
    shadows: bool,
    spp: int,
    delta: bool,
    progress: Progress | None,
) -> Facts:
    from btfref.rendering.offline.converged import converged
    from btfref.rendering.offline.reference import render
    from btfref.scene.pixel_classes import pixel_classes

    shared: Facts = {"parameters": parameters, "size": size}
    kinds = pixel_classes(path, grid=grid, follows_rays=False, shadows=delta and shadows, **shared)
    made: Facts = {"classes": kinds}
    if delta:
        return made | {"image": render(path, grid=grid, shadows=shadows, **shared).image}
    inside = kinds == PixelClass.INTERIOR
    # An integrator of its own takes its own samples; direct light is taken where the grid has them.
    at = None if shadows else grid
    result = converged(
        path, inside, gate=NOISY, shadows=shadows, grid=at, most=spp, progress=progress, **shared
    )
    return made | {"image": result.image, "variance": result.variance}


def judge_image(
    image: PathLike | np.ndarray,
    reference: Reference,
    *,
    gates: str | Sequence[str] | None = None,
    flip: bool = True,
) -> Comparison:
    """Compare a picture with a reference by the gates that fit it.

    Parameters
    ----------
    image : path-like or (H, W, 3) array
        Linear radiance; a ``.png`` is decoded from sRGB and judged as what 8 bits can show, clipped at 1.
    reference : Reference
    gates : str or sequence of str, optional
        In place of those that are chosen by the kind of picture and of reference.
    flip : bool

    Returns
    -------
    btfref.comparison.Comparison

    Raises
    ------
    InputError
        Unreadable pictures, another size, unknown gates.
    """
    eight_bit = not isinstance(image, np.ndarray) and Path(image).suffix.lower() == ".png"
    test = image if isinstance(image, np.ndarray) else load_image(image)
    if test.shape != reference.image.shape:
        raise InputError(
            "the picture and the scene's film differ in size",
            file=None if isinstance(image, np.ndarray) else image,
            got=f"{test.shape[1]}x{test.shape[0]}",
            expected=f"{reference.image.shape[1]}x{reference.image.shape[0]} (--size chooses another)",
        )
    if gates is None:
        gates = NOISY if reference.variance is not None else EIGHT_BIT if eight_bit else LINEAR
    expected = np.clip(reference.image, 0, 1) if eight_bit else reference.image
    return compare(
        test,
        expected,
        classes=reference.classes,
        gate=gates,
        variance=reference.variance,
        flip=flip,
        rounding=reference.rounding,
    )


def representation_for(
    method: PathLike, btf: PathLike | None = None, *, cache: PathLike | None = None
) -> Path:
    """A file of a method: the file itself, or the key of a method that is fitted to a sampled BTF, once.

    Parameters
    ----------
    method : str
        ``FILE.exr``, or a key of the registry.
    btf : path-like, optional
        Sampled BTF for a key.
    cache : path-like, optional

    Returns
    -------
    pathlib.Path

    Raises
    ------
    InputError
        A key without a BTF, or an unknown one.
    """
    from btfref.registry import method as row
    from btfref.representations import save
    from btfref.representations.file.container import refuse_store
    from btfref.sampling import SampledBTF, open_store

    refuse_store(Path(method))
    if str(method).endswith(".exr"):
        return Path(method)
    found = row(str(method))
    if btf is None:
        expected = "a .btf.zarr, or a file of the method"
        raise InputError("a method needs a BTF to be fitted to", field="--btf", expected=expected)

    open_store(btf)  # says what is wrong with it

    def save_fit(path: Path) -> None:
        save(found.fit(SampledBTF.load(btf, variance=False)), path)

    facts = {
        "fit": found.key,
        "btf": digest(Path(btf), ""),
        "code": code_of("btfref.validate.stages.fits", found.key),
    }
    return Cache(cache).get(key_of(facts), f".{found.key}.exr", save_fit)
