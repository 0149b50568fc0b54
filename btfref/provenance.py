"""Version of btfref and of what its results depend on."""

from __future__ import annotations

__version__ = "0.1.0"

#: Distributions whose version can change a result; recorded in every artefact.
RELEVANT = (
    "numpy",
    "scipy",
    "mitsuba",
    "drjit",
    "OpenEXR",
    "zarr",
    "trimesh",
    "moderngl",
    "scikit-image",
    "flip-evaluator",
)


def versions(names=RELEVANT):
    """Versions of btfref, Python and installed distributions, read from metadata without importing them.

    Parameters
    ----------
    names : iterable of str, optional
        Distribution names; those not installed map to None.

    Returns
    -------
    dict of str to str or None
        ``btfref`` and ``python`` first, then `names` in their order.
    """
    import platform
    from importlib import metadata

    found = {"btfref": __version__, "python": platform.python_version()}
    for name in names:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = None
    return found
