"""The evaluators of a representation under one interface: lookups in, values of B out."""

from __future__ import annotations

import numpy as np

from btfref import conventions
from btfref.errors import InputError

#: Ports by name. The definition, in float64, is what they are measured against.
PORTS = ("numpy float32", "drjit", "drjit without FastMath", "glsl")


def definition(representation, lookups):
    """Values in float64; a representation with levels gets each lookup's own, shape (n, 3)."""
    return representation.evaluate(*lookups.points, lod=lookups.lod)


def port(name, representation, path):
    """An evaluator.

    Parameters
    ----------
    name : str
        One of ``PORTS``.
    representation : Representation
    path : path-like
        Its file.

    Returns
    -------
    callable
        ``Lookups -> ndarray of float32, shape (n, 3)``.

    Raises
    ------
    InputError
        Unknown name.
    """
    if name == "glsl":
        return _glsl(representation)
    if name == "numpy float32":
        return _single(representation)
    if name in ("drjit", "drjit without FastMath"):
        return _drjit(path, fast=name == "drjit")
    raise InputError("unknown evaluator", field="--evaluator", got=repr(name), expected=", ".join(PORTS))


def count_malformed(name, representation, lookups):
    """Malformed lookups as a port counts them.

    Parameters
    ----------
    name : str
        One of ``PORTS``.
    representation : Representation
    lookups : Lookups

    Returns
    -------
    dict of str to int
        As :func:`btfref.conventions.malformed`.
    """
    if name == "glsl":
        from btfref.rendering.gl.probe import probe_malformed

        return probe_malformed(representation, *lookups.points)
    if name == "numpy float32":
        from btfref.precision import computing_in

        with computing_in(np.float32):
            return conventions.malformed(*lookups.points)
    dr, mi = _mitsuba()
    from mitsuba_plugins.lib.lookup import malformed

    uv, light, view = (np.ascontiguousarray(a.T) for a in lookups.points)
    with dr.scoped_set_flag(dr.JitFlag.FastMath, name == "drjit"):
        found = malformed(mi.Point2f(uv), mi.Vector3f(light), mi.Vector3f(view))
        counts = [int(np.count_nonzero(np.array(mask))) for mask in found]
    return dict(zip(("directions", "coordinates"), counts, strict=True))


def _single(representation):
    from btfref.precision import computing_in

    def evaluate(lookups):
        with computing_in(np.float32):
            return definition(representation, lookups)

    return evaluate


def _glsl(representation):
    from btfref.rendering.gl.probe import probe

    return lambda lookups: probe(representation, *lookups.points, lookups.lod)


def _mitsuba():
    """Dr.Jit and Mitsuba in a variant of its compiler."""
    from btfref.platform import prepare_llvm

    prepare_llvm()
    import drjit as dr
    import mitsuba as mi

    if mi.variant() is None or mi.variant().startswith("scalar"):
        mi.set_variant("llvm_ad_rgb")
    return dr, mi


def _drjit(path, *, fast):
    dr, mi = _mitsuba()
    import mitsuba_plugins
    from mitsuba_plugins.protocol import LevelledEvaluator

    mitsuba_plugins.register()
    # The level is fixed to 0 here; other levels go to the plugin's evaluator directly.
    bsdf = mi.load_dict({"type": "btf", "filename": str(path), "lod": "none"})
    levelled = isinstance(bsdf.evaluator, LevelledEvaluator)

    def evaluate(lookups):
        from mitsuba_plugins.lib.lookup import valid_directions

        uv, light, view = (np.ascontiguousarray(a.T) for a in lookups.points)
        with dr.scoped_set_flag(dr.JitFlag.FastMath, fast):
            light = mi.Vector3f(light)
            if not levelled:
                si = dr.zeros(mi.SurfaceInteraction3f, len(lookups))
                si.uv, si.wi = mi.Point2f(uv), mi.Vector3f(view)
                return np.array(bsdf.eval(mi.BSDFContext(), si, light)).T
            view = mi.Vector3f(view)
            valid = valid_directions(light) & valid_directions(view)
            up = mi.Vector3f(0, 0, 1)
            light, view = dr.select(valid, light, up), dr.select(valid, view, up)
            value = bsdf.evaluator.evaluate(mi.Point2f(uv), light, view, valid, lod=mi.Float(lookups.lod))
            return np.array(dr.select(valid, value, 0)).T

    return evaluate
