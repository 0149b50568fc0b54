"""Three evaluators, one truth: Dr.Jit and GLSL against the float64 definition, for every registered method."""

import dataclasses

import numpy as np
import pytest
from probes import hit_allowance, probe_points

from btfref.comparison.comparison import agreement
from btfref.conventions import FILTER_TYPES
from btfref.registry import methods

N_PROBES = 24_000
SETS = ("ubo81", "scattered")


def with_filter(representation, filter_type):
    return dataclasses.replace(representation, meta=representation.meta | {"filter_type": filter_type})


def off_texel_edges(uv, shape):
    """Nearest lookups exactly on an edge may round to either texel: keep away from edges by 1e-4 of a texel."""
    size = np.array(shape[::-1], np.float32)
    position = uv.astype(float) * size
    fraction = position - np.floor(position)
    return np.where((fraction < 1e-3) | (fraction > 1 - 1e-3), uv + 0.01 / size, uv).astype(np.float32)


@pytest.fixture(params=[(k, s, f) for k in methods() for s in SETS for f in FILTER_TYPES], ids="-".join)
def case(request, fits):
    key, kind, filter_type = request.param
    path = fits.path(key, kind)
    representation = with_filter(fits(key, kind), filter_type)
    btf = fits.btf(kind)
    uv, w_light, w_view = probe_points(np.random.default_rng(7), N_PROBES, btf.views, btf.lights)
    if filter_type == "nearest":
        uv = off_texel_edges(uv, representation.meta["texels"])
    return representation, path, filter_type, (uv, w_light, w_view)


def assert_agrees(value, representation, points):
    reference = representation.evaluate(*points)
    allowance = hit_allowance(representation, value, reference, points)
    for gate in agreement(value, reference, allowance=allowance).gates:
        assert gate.passed, gate.line


def test_drjit_agrees(case, llvm):
    import drjit as dr

    import mitsuba_plugins

    representation, path, filter_type, points = case
    mi = llvm
    mitsuba_plugins.register()
    bsdf = mi.load_dict({"type": "btf", "filename": str(path), "filter_type": filter_type})
    uv, w_light, w_view = points
    si = dr.zeros(mi.SurfaceInteraction3f, len(uv))
    si.uv, si.wi = mi.Point2f(uv.T), mi.Vector3f(w_view.T)
    value = np.array(bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(w_light.T))).T
    assert_agrees(value, representation, points)


def test_glsl_agrees(case, need):
    need("gl")
    from btfref.rendering.gl.probe import probe

    representation, _, _, points = case
    assert_agrees(probe(representation, *points), representation, points)


@pytest.mark.parametrize("key", methods())
def test_swapped_directions_are_caught(key, fits):
    """A BTF is not reciprocal: an evaluator that swaps light and view must not pass."""
    representation, btf = fits(key), fits.btf()
    uv, w_light, w_view = probe_points(np.random.default_rng(7), 2000, btf.views, btf.lights)
    swapped = representation.evaluate(uv, w_view, w_light)
    assert not agreement(swapped, representation.evaluate(uv, w_light, w_view)).passed


@pytest.mark.parametrize("key", methods())
def test_invalid_lookups_are_zero_everywhere(key, fits, llvm, need):
    """Below the horizon, NaN, infinite: exactly 0 in all evaluators; non-finite uv count as 0."""
    import drjit as dr

    import mitsuba_plugins
    from btfref.rendering.gl.probe import probe

    need("gl")
    mi = llvm
    mitsuba_plugins.register()
    representation, path = fits(key), fits.path(key)
    up, nan, inf = [0, 0, 1], [np.nan, 0, 1], [0, 0, np.inf]
    down, flat = [0.6, 0, -0.8], [1, 0, 0]
    pairs = [(down, up), (up, down), (flat, up), (up, flat), (nan, up), (up, nan), (inf, up), (up, inf)]
    w_light, w_view = (np.array([p[i] for p in pairs], np.float32) for i in (0, 1))
    uv = np.full((len(pairs), 2), 0.3, np.float32)
    si = dr.zeros(mi.SurfaceInteraction3f, len(uv))
    si.uv, si.wi = mi.Point2f(uv.T), mi.Vector3f(w_view.T)
    bsdf = mi.load_dict({"type": "btf", "filename": str(path)})
    for fast in (True, False):
        with dr.scoped_set_flag(dr.JitFlag.FastMath, fast):
            value = np.array(bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(w_light.T)))
            np.testing.assert_array_equal(value, 0)
    np.testing.assert_array_equal(representation.evaluate(uv, w_light, w_view), 0)
    np.testing.assert_array_equal(probe(representation, uv, w_light, w_view), 0)

    uv = np.array([[np.nan, 0.2], [np.inf, 0.2], [-np.inf, np.nan], [1e6, -1e6], [3e38, 0]], np.float32)
    up = np.broadcast_to(np.float32(up), (len(uv), 3))
    si = dr.zeros(mi.SurfaceInteraction3f, len(uv))
    si.uv, si.wi = mi.Point2f(uv.T), mi.Vector3f(up.T)
    value = np.array(bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(up.T))).T
    assert_agrees(value, representation, (uv, up, up))
    assert_agrees(probe(representation, uv, up, up), representation, (uv, up, up))
