"""Demand: what scenes need, tracing and loading no more than that, and the same picture bit by bit."""

import itertools
import json

import numpy as np
import pytest

from btfref.cli import main
from btfref.errors import BtfrefError, InputError
from btfref.gates.tolerances import tolerance
from btfref.numerics.sphere.directions import directions, spherical
from btfref.rendering.gl.realtime import realtime
from btfref.rendering.offline.reference import render
from btfref.representations import load, save
from btfref.representations.tabulated import raw
from btfref.sampling import SampledBTF, open_store
from btfref.sampling.store.selection import Selection
from btfref.sampling.synthesis import synthesize_store
from btfref.scene.demand import MARGIN, Demand, demand, maps_needed
from btfref.scene.shipped import scene_file

SIZE = (40, 40)
PLANE = scene_file("plane")


def shape(views="ubo81", lights="ubo81", texels=(16, 12)):
    return directions(views), directions(lights), texels


@pytest.fixture
def one_light(fits):
    return {"btf": str(fits.path("raw")), "lights": "directional1", "tiling": "3"}


def test_one_light_needs_its_neighbours(need, one_light):
    need("llvm")
    (found,) = demand(PLANE, parameters=one_light, size=SIZE, grid=1, margin=MARGIN).values()
    from btfref.scene.description import read_scene

    (light,) = read_scene(PLANE, one_light).lights
    index, weight = directions("ubo81").stencil(light.position)
    assert set(index[weight > 0]) <= set(np.flatnonzero(found.lights))
    assert found.lights.sum() <= 6
    assert 3 <= found.views.sum() < 40
    assert found.texels.all()
    pixels = SIZE[0] * SIZE[1]
    assert tolerance("demand.seen.min_covered") * pixels < found.lookups <= pixels
    # Pairs lie within what views and lights span.
    assert not (found.pairs & ~(found.views[:, None] & found.lights[None])).any()
    assert found.pairs.any(1).sum() <= found.views.sum()
    needed, whole = found.shares()["samples"]
    assert whole == 81 * 81 * 16 * 12
    assert needed == found.views.sum() * found.lights.sum() * 16 * 12


def brute_views(representation, parameters):
    """Views with weight at the pixels' centres, from the geometry of a pinhole before the plane z = 0."""
    from btfref.scene.description import read_scene

    scene = read_scene(PLANE, parameters, size=SIZE)
    corner, right, down = scene.camera.ray_basis()
    y, x = np.mgrid[: SIZE[1], : SIZE[0]] + 0.5
    ray = corner + x[..., None] * right + y[..., None] * down
    t = -scene.camera.origin[2] / ray[..., 2]
    hit = scene.camera.origin + t[..., None] * ray
    inside = (np.abs(hit[..., :2]) < 0.999).all(-1) & (t > 0)
    w = -ray[inside] / np.linalg.norm(ray[inside], axis=-1, keepdims=True)
    index, weight = directions("ubo81").stencil(w)
    return set(index[weight > 1e-6])


def test_views_are_those_of_a_pinhole(need, fits, one_light):
    need("llvm")
    (found,) = demand(PLANE, parameters=one_light, size=SIZE, grid=1, margin=MARGIN).values()
    expected = brute_views(fits("raw"), one_light)
    assert expected <= set(np.flatnonzero(found.views))
    assert len(found.views.nonzero()[0]) <= len(expected) + 4


def test_margin_and_grid_only_add(need, one_light):
    need("llvm")
    found = [
        next(iter(demand(PLANE, parameters=one_light, size=SIZE, grid=grid, margin=margin).values()))
        for grid, margin in ((1, MARGIN), (1, 0.2), (2, 0.2))
    ]
    for small, large in itertools.pairwise(found):
        for name in ("views", "lights", "texels"):
            assert not (getattr(small, name) & ~getattr(large, name)).any()
    assert found[1].views.sum() > found[0].views.sum()


def test_environments_need_all_lights_and_bounces_all_views(need, one_light):
    need("llvm")
    (sky,) = demand(PLANE, parameters=one_light | {"lights": "constant"}, size=SIZE, grid=1).values()
    assert sky.lights.all()
    assert not sky.views.all()
    (indirect,) = demand(PLANE, parameters=one_light, size=SIZE, grid=1, indirect=True).values()
    assert indirect.lights.all()
    assert indirect.views.all()


def test_union_and_parts():
    def some(views, lights, texels, lod=0.0):
        masks = [np.zeros(n, bool) for n in (5, 4)]
        masks[0][views], masks[1][lights] = True, True
        there = np.zeros((100, 70), bool)
        there[texels] = True
        return Demand("x", *masks, masks[0][:, None] & masks[1], there, lod, 7)

    one, two = some([1, 3], [0], (3, 3), 1.5), some([1], [2], (99, 69), 0.25)
    both = one | two
    assert both.views.nonzero()[0].tolist() == [1, 3]
    assert both.lights.nonzero()[0].tolist() == [0, 2]
    assert both.least_lod == 0.25
    assert both.lookups == 14
    assert one.part() == Selection((1, 3), (0,), (0,))
    assert both.part(64) == Selection(tiles=(0, 3), pairs=((1, (0, 2)), (3, (0,))))
    assert both.tiles(32).sum() == 2
    # Tiles as stores have them, here of 50 × 35 texels: as alike as they can be.
    assert some([1], [2], (55, 36)).part() == Selection((1,), (2,), (3,))
    assert some([1], [2], (49, 36)).part() == Selection((1,), (2,), (1,))
    with pytest.raises(InputError, match="needs nothing"):
        some([], [0], (0, 0)).part()
    with pytest.raises(InputError, match="different shapes"):
        one | Demand("y", *(np.zeros(3, bool),) * 2, np.zeros((3, 3), bool), np.zeros((2, 2), bool))


def test_levels_and_entries(need, fits):
    need("llvm")
    for key in ("laplacian", "lpca"):
        parameters = {"btf": str(fits.path(key)), "lights": "directional1", "tiling": "60"}
        (found,) = demand(PLANE, parameters=parameters, size=SIZE, grid=1).values()
        maps = maps_needed(found, fits(key)).maps
        if key == "lpca":
            used, whole = maps["entries of cluster"]
            assert 1 <= used <= whole
            continue
        needed, whole = maps["levels"]
        # 60 tiles of 16 x 12 texels on some 30 pixels: the finest levels are not looked up.
        assert found.least_lod > 1
        assert needed < whole
        near = demand(PLANE, parameters=parameters | {"tiling": "0.2"}, size=SIZE, grid=1)
        assert maps_needed(next(iter(near.values())), fits(key)).maps["levels"] == (whole, whole)


def test_pictures_are_equal_bit_by_bit(need, fits, one_light):
    """Reference and real-time picture from the needed maps alone, of methods that keep maps by both directions."""
    need("llvm")
    need("gl")
    for key in ("raw", "lpca"):
        parameters = one_light | {"btf": str(fits.path(key))}
        whole = render(PLANE, parameters=parameters, grid=2, size=SIZE)
        some = render(PLANE, parameters=parameters, grid=2, size=SIZE, keep="needed")
        np.testing.assert_array_equal(some.image, whole.image)
        (kept,) = some.meta["kept"].values()
        assert kept["views"] < 40
        assert kept["lights"] <= 6
        assert some.meta["not_finite"] == 0
    # Levels of a far plane, materials of a height field's hits, views alone.
    for key, tiling in (("laplacian", "40"), ("gbrdf", "3"), ("rf_lobes", "3")):
        parameters = one_light | {"btf": str(fits.path(key)), "tiling": tiling}
        for pictures in (
            [render(PLANE, parameters=parameters, grid=2, size=SIZE, keep=m) for m in ("all", "needed")],
            [realtime(PLANE, parameters=parameters, grid=2, size=SIZE, keep=m) for m in ("all", "needed")],
        ):
            np.testing.assert_array_equal(pictures[1].image, pictures[0].image)
        if key == "laplacian":
            (kept,) = pictures[1].meta["kept"].values()
            assert kept["levels"] < len(fits(key).meta["levels"])
    fast = [realtime(PLANE, parameters=one_light, grid=1, size=SIZE, keep=keep) for keep in ("all", "needed")]
    np.testing.assert_array_equal(fast[0].image, fast[1].image)
    (kept,) = fast[1].meta["kept"].values()
    assert kept["lights"] <= 6


@pytest.fixture(scope="module")
def settings():
    return {
        "texels": 8,
        "views": "ubo81",
        "lights": "ubo81",
        "spp": 2,
        "seed": 3,
        "max_depth": 3,
        "estimator": "path",
    }


@pytest.fixture(scope="module")
def whole(settings, tmp_path_factory):
    out = tmp_path_factory.mktemp("whole") / "whole.btf.zarr"
    return synthesize_store(out, "checker", **settings)


def test_a_store_of_what_is_needed(need, tmp_path, one_light, settings, whole):
    """Traced for one scene: the same samples, the same picture; another scene is an error and never a wrong value."""
    need("llvm")
    scene = one_light | {"btf": "not there yet.exr"}
    (found,) = demand(PLANE, parameters=scene, size=SIZE, grid=2, shape=shape(texels=(8, 8))).values()
    store = synthesize_store(tmp_path / "part.btf.zarr", "checker", only=found.part(), **settings)
    assert store.coverage.mean() <= tolerance("demand.one_light.samples")
    assert not store.complete
    paths = {}
    for name, made in (
        ("part", raw.fit_partial(open_store(store.path))),
        ("whole", raw.fit(SampledBTF.load(whole.path))),
    ):
        paths[name] = tmp_path / f"{name}.raw.exr"
        save(made, paths[name])
    assert paths["part"].stat().st_size <= tolerance("demand.one_light.bytes") * paths["whole"].stat().st_size
    images = [
        render(PLANE, parameters=one_light | {"btf": str(path)}, grid=2, size=SIZE).image
        for path in paths.values()
    ]
    np.testing.assert_array_equal(images[0], images[1])
    other = one_light | {"btf": str(paths["part"]), "lights": "directional3"}
    assert render(PLANE, parameters=other, grid=1, size=SIZE).meta["not_finite"] > 100
    with pytest.raises(BtfrefError, match="no numbers"):
        render(PLANE, parameters=other, grid=1, size=SIZE, debug=True)
    with pytest.raises(InputError, match="not resident"):
        load(paths["part"]).evaluate([0.2, 0.3], spherical(1.2, 3.0), spherical(1.2, 3.0))


@pytest.mark.long
def test_pairs_of_a_sphere(need, tmp_path, settings, whole):
    """A sphere shows all views and most lights under one light, but few of their pairs: those alone are traced."""
    need("llvm")
    need("gl")
    sphere, scene = scene_file("sphere"), {"lights": "directional1", "btf": "not there yet.exr"}
    views, lights, texels = shape(texels=(8, 8))
    (one,) = demand(sphere, parameters=scene, size=SIZE, grid=2, shape=(views, lights, texels)).values()
    assert one.views.mean() > tolerance("demand.seen.min_views")
    assert one.lights.mean() > tolerance("demand.seen.min_lights")
    assert one.pairs.mean() < tolerance("demand.sphere.pairs")
    assert (one.pairs.any(1) <= one.views).all()
    assert (one.pairs.any(0) <= one.lights).all()
    assert one.shares()["samples"] == (one.pairs.sum() * 64, 81 * 81 * 64)
    part = one.part()
    assert sum(len(lights) for _, lights in part.pairs) == one.pairs.sum()
    out = tmp_path / "part.btf.zarr"

    class KilledError(Exception):
        pass

    def kill(done, total, label):
        if done >= total // 2:
            raise KilledError

    with pytest.raises(KilledError):
        synthesize_store(out, "checker", only=part, progress=kill, **settings)
    half = open_store(out).coverage[:, :, 0, 0]
    assert 0 < half.sum() < one.pairs.sum()
    store = synthesize_store(out, "checker", only=part, **settings)
    assert np.array_equal(store.coverage[:, :, 0, 0], one.pairs)
    assert store.info()["coverage_of"]["pairs"] == f"{one.pairs.sum()} of {81 * 81}"
    # Pairs that were not asked for are on no disk, and no number.
    assert out_bytes(out) < (one.pairs.mean() + tolerance("demand.files.headers")) * out_bytes(whole.path)
    assert np.isnan(store._values[:][~one.pairs]).all()
    np.testing.assert_array_equal(store._values[:][one.pairs], whole._values[:][one.pairs])
    np.testing.assert_array_equal(store._variance[:][one.pairs], whole._variance[:][one.pairs])
    made = {"part": raw.fit_partial(store), "whole": raw.fit(SampledBTF.load(whole.path))}
    paths = {name: tmp_path / f"{name}.raw.exr" for name in made}
    for name, path in paths.items():
        save(made[name], path)
    parameters = [scene | {"btf": str(path)} for path in paths.values()]
    for pictures in (
        [render(sphere, parameters=p, grid=2, size=SIZE) for p in parameters],
        [realtime(sphere, parameters=p, grid=2, size=SIZE) for p in parameters],
    ):
        assert pictures[0].image.max() > 0
        np.testing.assert_array_equal(pictures[0].image, pictures[1].image)
    # Samples of another picture lie between those that were looked at: the margin covers them but for a few at the
    # silhouette, which are counted and never wrong.
    for settings_of_samples in ({"grid": 5}, {"spp": 16, "seed": 5}):
        made = [render(sphere, parameters=p, size=SIZE, **settings_of_samples) for p in parameters]
        there = np.isfinite(made[0].image).all(-1)
        assert (~there).sum() <= tolerance("demand.sphere.missing_pixels")
        assert made[0].meta["not_finite"] == 3 * (~there).sum()
        np.testing.assert_array_equal(made[0].image[there], made[1].image[there])
    # Another light is another set of pairs; both together are filled in without a change of what is there.
    three = scene | {"lights": "directional3"}
    (more,) = demand(sphere, parameters=three, size=SIZE, grid=2, shape=(views, lights, texels)).values()
    assert render(sphere, parameters=three | {"btf": str(paths["part"])}, grid=1, size=SIZE).meta[
        "not_finite"
    ]
    store = synthesize_store(out, "checker", only=(one | more).part(), **settings)
    assert np.array_equal(store.coverage[:, :, 0, 0], one.pairs | more.pairs)
    assert not store.complete
    both = one.pairs | more.pairs
    np.testing.assert_array_equal(store._values[:][both], whole._values[:][both])
    store = synthesize_store(out, "checker", **settings)
    assert store.complete
    assert np.array_equal(store._values[:], whole._values[:])


def out_bytes(path):
    return sum(entry.stat().st_size for entry in path.rglob("*") if entry.is_file())


def test_parts_of_pairs(llvm, tmp_path):
    """Both estimators make pairs alone, with the bytes of the whole."""
    pairs = np.zeros((6, 6), bool)
    pairs[[0, 2, 2, 5], [1, 0, 5, 3]] = True
    part = Selection.of_pairs(pairs)
    assert part.pairs == ((0, (1,)), (2, (0, 5)), (5, (3,)))
    assert Selection.of_pairs(np.eye(3, dtype=bool)[:, :1], (0,)) == Selection((0,), (0,), (0,))
    for estimator in ("path", "surface"):
        made = {"texels": 4, "views": "2x3", "lights": "2x3", "spp": 4, "max_depth": 3, "resolution": 16}
        made["estimator"] = estimator
        full = synthesize_store(tmp_path / f"{estimator}.full.btf.zarr", "checker", **made)
        some = synthesize_store(tmp_path / f"{estimator}.some.btf.zarr", "checker", only=part, **made)
        assert np.array_equal(some.coverage[:, :, 0, 0], pairs)
        np.testing.assert_array_equal(some._values[:][pairs], full._values[:][pairs])
    for wrong in (((0, (6,)),), ((6, (0,)),), ((0, ()),), (), ((0, (1,)), (0, (2,)))):
        with pytest.raises(InputError, match="part of a BTF"):
            Selection(pairs=wrong).wanted(some)
    with pytest.raises(InputError, match="part of a BTF"):
        Selection(views=(0,), pairs=((0, (1,)),)).wanted(some)
    settings = {"texels": 4, "views": "2x3", "lights": "2x3", "target_error": 0.5}
    with pytest.raises(InputError, match="target error"):
        synthesize_store(tmp_path / "no.btf.zarr", "checker", only=part, **settings)


def test_missing_tiles_are_no_numbers(llvm, load_plugin, tmp_path):
    settings = {"texels": (8, 70), "views": "10x5", "lights": [[0, 0, 1]], "spp": 2, "estimator": "path"}
    part = Selection(views=tuple(range(15)), tiles=(1,))
    store = synthesize_store(tmp_path / "part.btf.zarr", "checker", only=part, **settings)
    made = raw.fit_partial(store)
    save(made, tmp_path / "part.raw.exr")
    again = load(tmp_path / "part.raw.exr")
    assert np.isnan(again.maps["values"]).mean() == 0.5  # two tiles of 35 columns
    up, view = [0, 0, 1], store.views.vectors[1]
    assert (again.evaluate([67.5 / 70, 0.3], up, view) > 0).any()
    with pytest.raises(InputError, match="texels or pairs that are not resident"):
        again.evaluate([20 / 70, 0.3], up, view)
    with pytest.raises(InputError, match="not resident"):
        again.evaluate([67.5 / 70, 0.3], up, store.views.vectors[40])
    assert np.isfinite(again.sampling_tables()[1]).all()
    plugin = load_plugin(tmp_path / "part.raw.exr")
    si = llvm.SurfaceInteraction3f()
    si.wi = llvm.Vector3f(view)
    for u, known in ((20, False), (67.5, True)):
        si.uv = llvm.Point2f(u / 70, 0.3)
        value = np.array(plugin.eval(llvm.BSDFContext(), si, llvm.Vector3f(up)))
        assert np.isfinite(value).all() == known


def test_commands(need, tmp_path, capsys, fits):
    need("llvm")
    btf = str(fits.path("lpca"))
    assert main(["demand", "plane", f"-Dbtf={btf}", "--size", "16x16", "--grid", "1", "--json"]) == 0
    (found,) = json.loads(capsys.readouterr().out).values()
    assert set(found["shares"]) == {"views", "lights", "pairs", "texels", "samples", "entries of cluster"}
    assert len(found["views"]) == found["shares"]["views"]["needed"]
    words = ["demand", "turning", "--views", "10x5", "--size", "16x16", "--grid", "1", "--json"]
    counts = []
    for sweep in ("turn=0", "turn=0,40"):
        assert main([*words, "--sweep", sweep]) == 0
        (found,) = json.loads(capsys.readouterr().out).values()
        counts.append(len(found["lights"]) + len(found["views"]))
    assert counts[1] >= counts[0]
    out = tmp_path / "part.btf.zarr"
    words = ["synth", "checker", "-o", str(out), "--texels", "4", "--spp", "2", "--size", "16x16"]
    assert main([*words, "--for", "plane"]) == 0
    assert open_store(out).coverage.mean() < tolerance("demand.files.plane")
    assert main([*words, "--for", "plane", "--only-views", "0"]) == 2
    assert main([*words, "--indirect"]) == 2
    capsys.readouterr()
    made = tmp_path / "part.raw.exr"
    assert main(["fit", "raw", str(out), "--partial", "-o", str(made)]) == 0
    assert main(["fit", "lpca", str(out), "--partial", "-o", str(tmp_path / "no.lpca.exr")]) == 2
    assert "needs the whole BTF" in capsys.readouterr().err
    words = ["render", "plane", "-o", str(tmp_path / "x.exr"), f"-Dbtf={made}", "--grid", "1"]
    assert main([*words, "--size", "16x16", "--debug"]) == 0
