"""Bidirectional texture functions: synthesis, compression, reference and real-time rendering, comparison.

The stages are sub-packages along the data flow: ``mesostructure``, ``sampling``, ``representations``,
``render``, ``compare``, ``report``. What one uses most is here; `btfref.rendering.offline.reference.render`,
`btfref.rendering.gl.renderer.realtime` and `btfref.comparison.comparison.compare` stand where they belong. Importing
btfref loads nothing but the standard library; each stage brings in what it needs when it is used.
"""

from __future__ import annotations

from btfref.provenance import __version__

__all__ = ["__version__", "fit", "load", "save", "synthesize"]


def synthesize(mesostructure="checker", **settings):
    """Path trace a mesostructure into a sampled BTF: `btfref.sampling.synthesis.synthesize`."""
    from btfref.sampling.synthesis import synthesize as run

    return run(mesostructure, **settings)


def load(path):
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


def fit(method, btf, *, seed=0, progress=None, **parameters):
    """Compress a sampled BTF.

    Parameters
    ----------
    method : str
        Key of the method, such as "lpca"; see ``btfref.registry.methods()``.
    btf : SampledBTF
    seed : int
        Same seed, same bytes (on the same machine).
    progress : callable, optional
        Called as ``progress(done, total, label)``.
    **parameters
        Of the method.

    Returns
    -------
    Representation

    Raises
    ------
    InputError
        For an unknown method or a parameter out of range.
    """
    from btfref.registry import method as row

    return row(method).fit(btf, seed=seed, progress=progress, **parameters)


def save(representation, path):
    """Write a representation as one OpenEXR file: `btfref.representations.file.container.save`."""
    from btfref.representations.file.container import save as write

    write(representation, path)
