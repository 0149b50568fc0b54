"""Evaluations of a representation by NumPy, Dr.Jit and GLSL, ready to be timed; what is set up once is set up here."""

from __future__ import annotations

from contextlib import contextmanager

import numpy as np

#: Evaluators by name; a peer has the first alone.
EVALUATORS = ("numpy", "drjit", "glsl")


def random_points(n, rng):
    """Texture coordinates and directions, uniform over the tile and over the hemispheres.

    Parameters
    ----------
    n : int
    rng : numpy.random.Generator

    Returns
    -------
    uv : ndarray of float32, shape (n, 2)
    w_light, w_view : ndarray of float32, shape (n, 3)
    """
    uv = rng.random((n, 2), np.float32)
    directions = []
    for _ in range(2):
        z, phi = rng.random(n), 2 * np.pi * rng.random(n)
        s = np.sqrt(1 - z * z)
        directions.append(np.stack([s * np.cos(phi), s * np.sin(phi), z], 1).astype(np.float32))
    return uv, *directions


@contextmanager
def evaluation(kind, built, path, points, query):
    """A call that evaluates all points and waits for them, and one that fetches the values.

    Parameters
    ----------
    kind : {"numpy", "drjit", "glsl"}
    built : btfref.bench.subjects.Built
    path : path-like
        File of the representation.
    points : tuple of ndarray
        Of :func:`random_points`.
    query : dict
        Parameters of lookups.

    Yields
    ------
    run, values : callable
    """
    if kind == "numpy":
        uv, w_light, w_view = (a.astype(float) for a in points)
        evaluate = _with_filter(built, query).evaluate
        found = []

        def run():
            found[:] = [evaluate(uv, w_light, w_view)]

        yield run, lambda: found[0]
    elif kind == "drjit":
        yield _drjit(path, points, query)
    else:
        from btfref.rendering.gl.probe import broadcast_points, probe_points

        rows, _ = broadcast_points(*points)
        with probe_points(built.representation, rows, filter_type=query.get("filter_type")) as made:
            yield made.run, made.values


def _with_filter(built, query):
    rep = built.representation
    if rep is None or "filter_type" not in query:
        return built
    return type(rep).from_arrays(rep.arrays(), {**rep.meta, "filter_type": query["filter_type"]})


def _drjit(path, points, query):
    import drjit as dr
    import mitsuba as mi

    bsdf = mi.load_dict({"type": "btf", "filename": str(path), **query})
    uv, w_light, w_view = points
    si = dr.zeros(mi.SurfaceInteraction3f, len(uv))
    si.uv, si.wi = mi.Point2f(uv.T), mi.Vector3f(w_view.T)
    wo, context = mi.Vector3f(w_light.T), mi.BSDFContext()
    dr.eval(si, wo)
    found = []

    def run():
        value = bsdf.eval(context, si, wo)
        dr.eval(value)
        dr.sync_thread()
        found[:] = [value]

    return run, lambda: np.array(found[0]).T
