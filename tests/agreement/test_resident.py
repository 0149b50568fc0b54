"""Representations of which only some views are kept: equal where these suffice, never another view's value."""

import fnmatch
from importlib.resources import files

import numpy as np
import pytest
from probes import hemisphere

from btfref.cli import main
from btfref.errors import InputError
from btfref.numerics import interpolation
from btfref.registry import methods
from btfref.render.probe import probe
from btfref.render.realtime import realtime
from btfref.representations import load, save
from btfref.representations.resident import KINDS, SLOTS, with_views

CASES = [
    (key, kind)
    for key, row in methods().items()
    for kind, axes in KINDS.items()
    if getattr(row.representation, axes, None)
]
PLANE = files("btfref.scenes").joinpath("plane.xml")


def lookups(rng, representation, kind, chosen, n=4000):
    """Random lookups, and whether the kept views, or lights, suffice for each."""
    uv, w_light, w_view = rng.uniform(size=(n, 2)).astype(np.float32), hemisphere(rng, n), hemisphere(rng, n)
    w = w_view if kind == "view" else w_light
    index, weight = interpolation.from_arrays(representation.arrays(), kind).stencil(w)
    # Neighbours with a weight of rounding size may or may not count in float32.
    clear = ((weight == 0) | (weight > 1e-4)).all(1)
    absent = ~np.isin(index, chosen) & (weight > 0)
    return (uv[clear], w_light[clear], w_view[clear]), ~absent.any(1)[clear]


@pytest.mark.parametrize("directions", ["ubo81", "triangles"])
@pytest.mark.parametrize(("key", "kind"), CASES)
def test_kept_directions_give_the_same_numbers_and_others_none(need, fits, llvm, rng, key, kind, directions):
    import drjit as dr

    import mitsuba_plugins

    need("gl")
    whole, path = fits(key, directions), fits.path(key, directions)
    total = whole.meta[f"{kind}s"]["count"]
    kept = 2 * total // 3
    chosen = np.sort(rng.choice(total, kept, replace=False))
    some = load(path, **{f"{kind}s": chosen})
    for pattern, axis in getattr(type(whole), KINDS[kind]).items():
        names = fnmatch.filter(some.maps, pattern)
        assert names or pattern == "mean"
        assert all(some.maps[name].shape[axis] == kept for name in names)
    points, enough = lookups(rng, whole, kind, chosen)
    assert 0.1 < enough.mean() < 0.9
    inside, outside = (tuple(a[mask] for a in points) for mask in (enough, ~enough))
    np.testing.assert_array_equal(some.evaluate(*inside), whole.evaluate(*inside))
    with pytest.raises(InputError, match="not resident"):
        some.evaluate(*outside)

    np.testing.assert_array_equal(probe(some, *inside), probe(whole, *inside))
    assert np.isnan(probe(some, *outside)).all()

    mitsuba_plugins.register()
    names = " ".join(map(str, chosen))
    parts = [
        llvm.load_dict({"type": "btf", "filename": str(path), **more}) for more in ({}, {f"{kind}s": names})
    ]
    si = dr.zeros(llvm.SurfaceInteraction3f, len(points[0]))
    si.uv, si.wi = llvm.Point2f(points[0].T), llvm.Vector3f(points[2].T)
    values = [np.array(p.eval(llvm.BSDFContext(), si, llvm.Vector3f(points[1].T))).T for p in parts]
    np.testing.assert_array_equal(values[1][enough], values[0][enough])
    assert np.isnan(values[1][~enough]).all()


def test_a_selection_is_stored_and_selected_again(fits, tmp_path):
    whole = fits("rf_lobes")
    some = with_views(whole, [3, 17, 40, 41])
    save(some, tmp_path / "some.rf_lobes.exr")
    again = load(tmp_path / "some.rf_lobes.exr", views=[41, 3])
    direct = with_views(whole, [3, 41])
    assert again.meta["resident_views"] == [3, 41]
    for name, array in direct.arrays().items():
        np.testing.assert_array_equal(again.arrays()[name], array)
    with pytest.raises(InputError, match="not there"):
        with_views(some, [3, 4])


def test_what_cannot_be_selected(fits, tmp_path):
    with pytest.raises(InputError, match="no such views"):
        with_views(fits("rf_poly"), [80, 81])
    with pytest.raises(InputError, match="no such views"):
        with_views(fits("rf_poly"), [])
    with pytest.raises(InputError, match="by view"):
        with_views(fits("lafortune"), [0])
    assert SLOTS not in fits("rf_poly").arrays()


def test_a_picture_needs_some_views_only(need, fits, tmp_path, capsys):
    """The camera before the plane sees a third of the views: the same picture, bit by bit, from their maps alone."""
    need("llvm")
    need("gl")
    parameters = {"btf": str(fits.path("rf_lobes")), "lights": "directional3", "tiling": "3"}
    whole = realtime(PLANE, parameters=parameters, grid=2, size=(64, 64))
    some = realtime(PLANE, parameters=parameters, grid=2, size=(64, 64), views="needed")
    np.testing.assert_array_equal(some.image, whole.image)
    (kept,) = some.meta["resident_views"].values()
    assert 3 <= kept < 60
    assert some.meta["not_finite"] == 0
    out = tmp_path / "plane.exr"
    arguments = [f"-D{key}={value}" for key, value in parameters.items()]
    assert (
        main(["realtime", "plane", "-o", str(out), "--size", "32x32", "--views", "needed", *arguments]) == 0
    )
    assert out.exists()
