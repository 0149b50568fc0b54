"""Bidirectional texture functions: synthesis, compression, reference and real-time rendering, comparison.

>>> import btfref
>>> btf = btfref.synthesize("checker", texels=64, views="ubo81", lights="ubo81", spp=16)
>>> lpca = btfref.fit("lpca", btf, clusters=16, components=4)
>>> btfref.save(lpca, "checker.lpca.exr")
>>> reference = btfref.render("plane", parameters={"btf": "checker.lpca.exr"}, grid=4)
>>> image = btfref.realtime("plane", parameters={"btf": "checker.lpca.exr"}, grid=4)
>>> btfref.compare(image, reference, gate="image.noise_free").passed
True

Importing btfref loads nothing but the standard library; each name brings in what it needs when it is first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from btfref.provenance import __version__

if TYPE_CHECKING:
    from btfref.comparison import compare
    from btfref.datasets.package import dataset
    from btfref.numerics.sphere.directions import DirectionSet
    from btfref.querying.batches import queries
    from btfref.refining import refine
    from btfref.rendering.gl.realtime import realtime
    from btfref.rendering.offline.reference import render
    from btfref.representations.protocol import Representation
    from btfref.sampling import SampledBTF
    from btfref.sampling.synthesis import synthesize
    from btfref.types import PathLike, Progress

__all__ = [
    "DirectionSet",
    "SampledBTF",
    "__version__",
    "compare",
    "dataset",
    "fit",
    "load",
    "queries",
    "realtime",
    "refine",
    "render",
    "save",
    "synthesize",
]

#: Where what is not defined here comes from.
_HOMES = {
    "DirectionSet": "btfref.numerics.sphere.directions",
    "SampledBTF": "btfref.sampling",
    "compare": "btfref.comparison",
    "dataset": "btfref.datasets.package",
    "queries": "btfref.querying.batches",
    "refine": "btfref.refining",
    "realtime": "btfref.rendering.gl.realtime",
    "render": "btfref.rendering.offline.reference",
    "synthesize": "btfref.sampling.synthesis",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'btfref' has no attribute {name!r}")
    from importlib import import_module

    found = globals()[name] = getattr(import_module(_HOMES[name]), name)
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})


def load(path: PathLike) -> SampledBTF | Representation:
    """Read a sampled BTF (a ``.btf.zarr`` folder) or a representation (an ``.exr`` file).

    Parameters
    ----------
    path : path-like

    Returns
    -------
    SampledBTF or Representation

    Raises
    ------
    InputError
        When the file is missing, damaged or of another kind.
    """
    from pathlib import Path

    if Path(path).is_dir() or Path(path).suffix == ".zarr":
        from btfref.sampling import SampledBTF

        return SampledBTF.load(path)
    from btfref.representations.file.container import load as read

    return read(path)


def fit(
    method: str,
    btf: SampledBTF,
    *,
    preset: str | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    **parameters: Any,
) -> Representation:
    """Compress a sampled BTF.

    Parameters
    ----------
    method : str
        Key of the method, such as "lpca"; see ``btfref.registry.methods()``.
    btf : SampledBTF
    preset : str, optional
        Named settings, such as "paper"; `parameters` go before them.
    seed : int
        Same seed, same bytes (on the same machine), whatever the number of threads.
    progress : callable, optional
        Called as ``progress(done, total, label)``.
    **parameters
        Of the method: ``btfref fit METHOD --help`` lists them.

    Returns
    -------
    Representation
        ``meta["fit"]["between_samples"]`` says how wrong it is between the samples:
        :func:`btfref.representations.between.measure`.

    Raises
    ------
    InputError
        For an unknown method, preset or parameter, or one that is out of range.
    """
    from btfref.registry import method as row
    from btfref.representations import between

    found = row(method)
    return between.fit(found, btf, seed=seed, progress=progress, **found.settings(preset, parameters))


def save(data: SampledBTF | Representation, path: PathLike) -> None:
    """Write a sampled BTF (a ``.btf.zarr`` folder, a new one) or a representation (one OpenEXR file).

    Parameters
    ----------
    data : SampledBTF or Representation
    path : path-like

    Raises
    ------
    InputError
        When a folder of that name is there, or a value cannot be stored.
    """
    from btfref.representations.file.container import save as write
    from btfref.sampling import SampledBTF

    if isinstance(data, SampledBTF):
        data.save(path)
    else:
        write(data, path)
