"""Representations of which only some views are kept: equal where these suffice, never another view's value."""

import fnmatch
from importlib.resources import files

import numpy as np
import pytest
from probes import hemisphere

from btfref.cli import main
from btfref.conventions import texel_stencil
from btfref.errors import InputError
from btfref.gates import tolerance
from btfref.numerics.sphere import interpolation
from btfref.registry import methods
from btfref.rendering.gl.probe import probe
from btfref.rendering.gl.realtime import realtime
from btfref.representations import load, save
from btfref.representations.file.resident import KINDS, SLOTS, keeping, with_views
from btfref.representations.file.rows import RowReader
from btfref.representations.gbrdf.definition import texel_weights
from btfref.representations.protocol import direction_axes

CASES = [
    (key, kind)
    for key, row in methods().items()
    for kind in KINDS
    if direction_axes(row.representation, kind)
]
#: Share of the lookups that each side has at least.
MIXED = tolerance("resident.lookups.min_mixed")
PLANE = files("btfref.scene.shipped").joinpath("plane.xml")


def lookups(rng, representation, kind, chosen, n=4000):
    """Random lookups, and whether the kept views, or lights, suffice for each."""
    uv, w_light, w_view = rng.uniform(size=(n, 2)).astype(np.float32), hemisphere(rng, n), hemisphere(rng, n)
    w = w_view if kind == "view" else w_light
    index, weight = interpolation.from_arrays(representation.arrays(), kind).stencil(w)
    # Neighbours with a weight of rounding size may or may not count in float32.
    clear = ((weight == 0) | (weight > 1e-4)).all(1)
    absent = ~np.isin(index, chosen) & (weight > 0)
    return (uv[clear], w_light[clear], w_view[clear]), ~absent.any(1)[clear]


@pytest.mark.parametrize("directions", ["ubo81", "scattered"])
@pytest.mark.parametrize(("key", "kind"), CASES)
def test_kept_directions_give_the_same_numbers_and_others_none(
    need, fits, evaluator, rng, key, kind, directions
):
    need("gl")
    whole, path = fits(key, directions), fits.path(key, directions)
    total = whole.meta[f"{kind}s"]["count"]
    count = 2 * total // 3
    chosen = np.sort(rng.choice(total, count, replace=False))
    some = load(path, **{f"{kind}s": chosen})
    for pattern, axis in direction_axes(whole, kind).items():
        names = fnmatch.filter(some.maps, pattern)
        assert names or pattern == "mean"
        assert all(some.maps[name].shape[axis] == count for name in names)
    points, enough = lookups(rng, whole, kind, chosen)
    assert MIXED < enough.mean() < 1 - MIXED
    inside, outside = (tuple(a[mask] for a in points) for mask in (enough, ~enough))
    np.testing.assert_array_equal(some.evaluate(*inside), whole.evaluate(*inside))
    with pytest.raises(InputError, match="not resident"):
        some.evaluate(*outside)

    np.testing.assert_array_equal(probe(some, *inside), probe(whole, *inside))
    assert np.isnan(probe(some, *outside)).all()

    values = [
        evaluator("drjit", whole, path, **kept(more)).evaluate(*points) for more in ({}, {f"{kind}s": chosen})
    ]
    np.testing.assert_array_equal(values[1][enough], values[0][enough])
    assert np.isnan(values[1][~enough]).all()


def kept(chosen):
    """The plugin's parameters for indices of what is kept, by name."""
    return {name: " ".join(map(str, indices)) for name, indices in chosen.items()}


@pytest.mark.parametrize("filter_type", ["bilinear", "nearest"])
@pytest.mark.parametrize("key", ["lpca", "gbrdf"])
def test_kept_entries_give_the_same_numbers_and_others_none(
    need, fits, evaluator, rng, tmp_path, key, filter_type
):
    need("gl")
    fitted = fits(key)
    names = type(fitted).ENTRIES
    maps = dict(fitted.maps)
    if key == "gbrdf":
        # As many materials as there are clusters, in stripes.
        count = 4
        maps["material"] = np.broadcast_to(
            (np.arange(maps["material"].shape[1]) * count // maps["material"].shape[1])[None, :, None],
            maps["material"].shape,
        ).astype(np.uint32)
        maps |= {name: np.resize(maps[name], (count, *maps[name].shape[1:])) for name in names.axes}
    whole = fitted.from_arrays(maps, fitted.meta | {"filter_type": filter_type})
    path = tmp_path / f"whole.{key}.exr"
    save(whole, path)
    total = len(maps[next(iter(names.axes))])
    chosen = np.arange(0, total, 2)
    some = load(path, entries=chosen)
    assert all(some.maps[name].shape[axis] == len(chosen) for name, axis in names.axes.items())
    uv, _, w_view = points = (
        rng.uniform(size=(3000, 2)).astype(np.float32), hemisphere(rng, 3000), hemisphere(rng, 3000)
    )  # fmt: skip
    if key == "gbrdf":
        index, weight = texel_weights(whole.field.view_hits(uv, w_view), whole.field.shape, filter_type)
    else:
        index, weight = texel_stencil(uv, whole.meta["texels"], filter_type)
    there = np.isin(maps[names.index].reshape(-1)[index], chosen)
    inside, outside = (there | (weight == 0)).all(1), (~there & (weight > 1e-3)).any(1)
    assert min(inside.mean(), outside.mean()) > MIXED
    expected = whole.evaluate(*points)
    np.testing.assert_array_equal(some.evaluate(*(a[inside] for a in points)), expected[inside])
    lit = outside & (expected > 0).any(1)
    with pytest.raises(InputError, match="entries that are not resident"):
        some.evaluate(*(a[lit] for a in points))
    pairs = (
        (probe(some, *points), probe(whole, *points)),
        [
            evaluator("drjit", whole, path, **more).evaluate(*points)
            for more in (kept({"entries": chosen}), {})
        ],
    )
    for found, full in pairs:
        # Where a ray passes a silhouette, a port may see another texel than the definition.
        same = (found == full).all(1)
        lost = np.isnan(found).all(1)
        assert (same | lost).all()
        assert same[inside].mean() > tolerance("resident.lookups.min_agree")
        assert lost[lit].mean() > tolerance("resident.lookups.min_agree")
    again = tmp_path / f"some.{key}.exr"
    save(some, again)
    np.testing.assert_array_equal(probe(load(again), *points), pairs[0][0])
    with pytest.raises(InputError, match="chosen already"):
        load(again, entries=[0])
    with pytest.raises(InputError, match="no such entries"):
        load(path, entries=[total])
    with pytest.raises(InputError, match="no entries"):
        load(fits.path("svd"), entries=[0])


def test_kept_levels_give_the_same_numbers_and_finer_ones_none(need, fits, evaluator, rng):
    need("gl")
    whole, path = fits("laplacian"), fits.path("laplacian")
    total = len(whole.meta["levels"])
    points = rng.uniform(size=(500, 2)).astype(np.float32), hemisphere(rng, 500), hemisphere(rng, 500)
    for first in (1, total - 1):
        levels = kept({"levels": np.arange(first, total)})

        def ported(lod, **more):
            level = {"lod": "none", "lod_bias": lod}
            return evaluator("drjit", whole, path, **level, **more).evaluate(*points)

        some = load(path, levels=np.arange(first, total))
        assert not any(name in some.maps for name in ("basis_0", "weights_0"))
        assert some.port_arrays()["weights"].size < whole.port_arrays()["weights"].size
        for lod in (first, min(first + 0.3, total - 1), total + 2.0):
            for evaluate in (
                lambda rep, lod: rep.evaluate(*points, lod=lod), lambda rep, lod: probe(rep, *points, lod)
            ):  # fmt: skip
                np.testing.assert_array_equal(evaluate(some, lod), evaluate(whole, lod))
            np.testing.assert_array_equal(ported(lod, **levels), ported(lod))
        with pytest.raises(InputError, match="levels that are not resident"):
            some.evaluate(*points, lod=first - 0.1)
        assert np.isnan(probe(some, *points, first - 0.1)).all()
        assert np.isnan(ported(first - 0.1, **levels)).all()
        assert np.isfinite(some.sampling_tables()[1]).all()
    for levels, message in (([0], "from one on"), ([total], "no such levels"), ([], "no such levels")):
        with pytest.raises(InputError, match=message):
            load(path, levels=levels)
    with pytest.raises(InputError, match="no levels"):
        load(fits.path("raw"), levels=[0])


def test_only_what_is_kept_is_read(fits, tmp_path, monkeypatch):
    """Rows and parts of their own are read alone, give the same maps, and damage elsewhere is not noticed."""
    read = []
    leave = RowReader.__exit__
    monkeypatch.setattr(
        RowReader, "__exit__", lambda self, *error: (read.append(self.bytes_read), leave(self, *error))[1]
    )
    choices = {
        "lpca": {"entries": [1], "views": range(5)}, "svd": {"views": [3, 4]}, "rf_lobes": {"views": range(6)},
        "rf_poly": {"views": [80]}, "laplacian": {"levels": [4]},
    }  # fmt: skip
    for key, choice in choices.items():
        path = fits.path(key)
        whole = keeping(load(path), **choice)
        read.clear()
        some = load(path, **choice)
        assert len(read) == 1
        assert read[0] < tolerance("resident.bytes.share") * path.stat().st_size
        assert some.meta == whole.meta
        assert list(some.maps) == list(whole.maps)
        for name, array in whole.maps.items():
            np.testing.assert_array_equal(some.maps[name], array)
    spoiled = tmp_path / "spoiled.rf_lobes.exr"
    content = bytearray(fits.path("rf_lobes").read_bytes())
    for n in (100, len(content) // 3, len(content) - 10):
        spoiled.write_bytes(content[:n])
        with pytest.raises(InputError, match=r"truncated|missing|damaged"):
            load(spoiled, views=[80])


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
    some = realtime(PLANE, parameters=parameters, grid=2, size=(64, 64), keep="needed")
    np.testing.assert_array_equal(some.image, whole.image)
    (kept,) = some.meta["kept"].values()
    assert 3 <= kept["views"] < 60
    assert some.meta["not_finite"] == 0
    out = tmp_path / "plane.exr"
    arguments = [f"-D{key}={value}" for key, value in parameters.items()]
    assert main(["realtime", "plane", "-o", str(out), "--size", "32x32", "--keep", "needed", *arguments]) == 0
    assert out.exists()
