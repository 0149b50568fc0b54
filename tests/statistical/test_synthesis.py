"""Synthesis: closed forms, honest variance, exact tiling, same seed same bytes, resumed after SIGKILL."""

import filecmp
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from honest import assert_variances_are_honest

from btfref.comparison.significance import bias_interval, difference_test, welch_test
from btfref.errors import InputError
from btfref.gates.tolerances import tolerance
from btfref.mesostructure import Mesostructure, Part, build
from btfref.numerics.sphere.directions import directions
from btfref.numerics.sphere.quadrature import gauss_hemisphere
from btfref.sampling import SampledBTF, open_store, tiled_scene
from btfref.sampling.paths import estimator
from btfref.sampling.synthesis import synthesize, synthesize_store

pytestmark = pytest.mark.usefixtures("llvm")

SMALL = {"texels": 4, "views": "2x3", "lights": "2x4", "spp": 4, "resolution": 16, "estimator": "path"}


def _faceted(mesostructure):
    """The same geometry without interpolated normals, which keep neither energy nor reciprocity."""
    parts = tuple(Part(part.vertices, part.faces, part.bsdf) for part in mesostructure.parts)
    return Mesostructure("faceted", {}, parts)


def _diffuse(mesostructure, reflectance):
    """The same geometry, Lambertian."""
    bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [reflectance] * 3}}
    parts = tuple(Part(part.vertices, part.faces, bsdf, normals=part.normals) for part in mesostructure.parts)
    return Mesostructure("diffuse", {}, parts)


@pytest.mark.parametrize("dtype", ["float16", "float32"])
def test_lambertian_tile_has_its_albedo(dtype):
    rho = np.array([0.2, 0.5, 1.0])
    btf = synthesize("flat", reflectance=rho.tolist(), texels=2, spp=2, dtype=dtype, estimator="path")
    values = btf.values.astype(np.float64)
    # View along the normal, light from everywhere; light along it, views everywhere with their cosine.
    from_lights = np.einsum("l,lrcx->rcx", btf.lights.quadrature_weights, values[0])
    to_views = np.einsum("v,vrcx->rcx", btf.views.quadrature_weights * btf.views.vectors[:, 2], values[:, 0])
    assert np.abs(from_lights - rho).max() <= tolerance("lambert.albedo")
    assert np.abs(to_views - rho).max() <= tolerance("lambert.albedo")


@pytest.mark.parametrize(
    "bsdf",
    [
        {"type": "roughconductor", "alpha": 0.3, "material": "Au"},
        {"type": "roughconductor", "alpha_u": 0.1, "alpha_v": 0.4, "distribution": "ggx", "material": "none"},
        {"type": "roughplastic", "alpha": 0.2},
    ],
)
def test_flat_material_equals_its_eval(llvm, bsdf):
    mi = llvm
    settings = {"texels": 1, "views": "6x5", "lights": "7x6", "dtype": "float32", "estimator": "path"}
    btf = synthesize("flat", bsdf=bsdf, spp=2, **settings)
    material = mi.load_dict(bsdf)
    interaction = mi.SurfaceInteraction3f()
    wi, wo = (np.repeat(btf.views.vectors, 42, 0), np.tile(btf.lights.vectors, (30, 1)))
    interaction.wi = mi.Vector3f(wi.T.astype(np.float32))
    interaction.t = 0.0
    value = np.array(material.eval(mi.BSDFContext(), interaction, mi.Vector3f(wo.T.astype(np.float32)))).T
    error = np.abs(btf.values[:, :, 0, 0] - value.reshape(30, 42, 3)) / value.max()
    assert error.max() <= tolerance("synthesis.flat_eval")
    assert value.max() > 0


@pytest.mark.parametrize(("estimator", "spp"), [("path", 2048), ("surface", 256)])
def test_white_furnace(estimator, spp):
    """All-white walls at full depth return all light, whatever the view: the hemispherical albedo is 1."""
    tile = _faceted(_diffuse(build("checker", resolution=32), 1.0))
    lights, weights = gauss_hemisphere(8, 16)
    views = directions("ubo81").vectors[[0, 70]]
    settings = {"texels": 2, "views": views, "lights": lights, "dtype": "float32", "estimator": estimator}

    def albedo(spp, max_depth):
        values = synthesize(tile, spp=spp, max_depth=max_depth, seed=3, **settings).values.astype(np.float64)
        return np.einsum("l,vlrcx->vrcx", weights, values).mean((1, 2, 3))

    limit = tolerance("synthesis.furnace")
    assert np.abs(albedo(spp, -1) - 1).max() <= limit
    # Direct light alone loses what falls on other walls.
    assert (1 - albedo(256, 2) > 5 * limit).all()


@pytest.mark.parametrize(("estimator", "spp", "runs"), [("path", 256, 1), ("surface", 16, 12)])
def test_tile_means_are_reciprocal_and_texels_are_not(estimator, spp, runs):
    """The tile's mean f is reciprocal (Snyder 1998), that of a texel is not (Suykens et al. 2003, fig. 2)."""
    vectors = directions("ubo81").vectors[[0, 22, 44, 66]]
    tile = _faceted(build("checker", resolution=32, raised_roughness=0.3))
    settings = {"texels": 8, "views": vectors, "lights": vectors, "spp": spp, "dtype": "float32"}
    made = [synthesize(tile, seed=11 + run, estimator=estimator, **settings) for run in range(runs)]
    cosine = vectors[:, 2][:, None, None, None]
    f = np.stack([btf.values / cosine for btf in made]).astype(np.float64)
    upper = np.triu_indices(4, 1)
    p = []
    for v, k in zip(*upper, strict=True):
        difference = f[:, v, k] - f[:, k, v]
        if runs > 1:
            # A pair and its reverse share points and walks: what whole runs differ by holds what goes together.
            means = difference.mean((1, 2, 3))
            p.append(welch_test(means.mean(), means.var(ddof=1) / runs, 0.0, 0.0, n_a=runs)[1])
            continue
        # A pair and its reverse are independent: their views are traced with other random numbers.
        variance = (made[0].variance / cosine**2)[[v, k], [k, v]].sum(0)
        interval = bias_interval(difference[0], variance)
        p.append(welch_test(interval.estimate, interval.standard_error**2, 0.0, 0.0)[1])
    assert difference_test(np.array(p), significance=tolerance("synthesis.z.significance")).rejected == 0
    there, back = f[:, upper[0], upper[1]], f[:, upper[1], upper[0]]
    if runs > 1:
        gap = there - back
        texels = gap.mean(0), gap.var(0, ddof=1) / runs, np.zeros(gap.shape[1:]), 0.0
        texel_p = welch_test(*texels, n_a=runs)[1]
    else:
        variance = made[0].variance / cosine**2
        texel_p = welch_test(there[0], variance[upper], back[0], variance.swapaxes(0, 1)[upper])[1]
    rejected = difference_test(texel_p, significance=tolerance("synthesis.z.significance"))
    assert rejected.rejected_fraction > tolerance("synthesis.seen.min_rejected")


def _groove():
    """Lambertian V-groove along y with walls of 45 degrees, its edges at x = 0 and x = 1, its bottom at x = ½."""
    vertices = np.array([[x, y, -z] for x, z in ((0, 0), (0.5, 0.5), (1, 0)) for y in (0, 1)], np.float64)
    faces = np.array([[0, 2, 3], [0, 3, 1], [2, 4, 5], [2, 5, 3]])
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    part = Part(
        corners.reshape(-1, 3),
        np.arange(12).reshape(-1, 3),
        {"type": "diffuse", "reflectance": 0.5},
        normals=np.repeat(normal, 3, 0),
    )
    return Mesostructure("groove", {}, (part,))


@pytest.mark.parametrize(("estimator", "spp"), [("path", 256), ("surface", 256)])
def test_shadow_of_a_v_groove(estimator, spp):
    """Direct light in the groove, seen from above, has a closed form.

    A light (s, t, c) meets the left wall, normal (1, 0, 1)/√2, at cosine (s + c)/√2. A ray from its point
    (x, −x) passes under the right edge (1, 0) where (1 − x) c < x s: the wall is in shadow beyond
    x = c/(s + c). The right wall, normal (−1, 0, 1)/√2, is lit at cosine (c − s)/√2 when that is positive.
    """
    n, thetas = 16, (0.5, 1.0, 1.1)
    lights = [
        [sign * np.sin(t) * np.cos(0.4), np.sin(t) * np.sin(0.4), np.cos(t)]
        for t in thetas
        for sign in (1, -1)
    ]
    btf = synthesize(
        _groove(), texels=n, views=[[0.0, 0.0, 1.0]], lights=lights, spp=spp, max_depth=2, dtype="float32",
        estimator=estimator, seed=4,
    )  # fmt: skip
    p = []
    for k, (x, _, c) in enumerate(lights):
        s, lower = abs(x), np.arange(n) / n
        lit = np.clip((c / (s + c) - lower) * n, 0.0, 1.0)
        expected = np.where(lower < 0.5, lit * (s + c), max(c - s, 0.0)) * 0.5 / np.pi / np.sqrt(2)
        expected = expected if x > 0 else expected[::-1]
        found = btf.values[0, k, :, :, 0].astype(np.float64)
        border = (lit > 0) & (lit < 1) & (lower < 0.5)
        border = border if x > 0 else border[::-1]
        assert border.sum() == (c < s)
        error = np.abs(found - expected)[:, ~border].max() / expected.max()
        assert error <= tolerance("synthesis.flat_eval")
        if not border.any():
            continue
        # Rows are samples of the texel that the shadow's border crosses.
        mean, spread = found[:, border].mean(0), found[:, border].var(0, ddof=1) / n
        p.append(welch_test(mean, spread, expected[border], 0.0, n_a=n)[1])
        # It could tell a border that is off by a tenth of a texel.
        assert (3 * np.sqrt(spread) < tolerance("synthesis.border") * expected.max()).all()
    p = np.concatenate(p)
    assert len(p) == 4
    assert difference_test(p, significance=tolerance("synthesis.z.significance")).rejected == 0


@pytest.mark.parametrize("spp", [64, 27, 25])
def test_variance_is_honest(spp):
    tile = _diffuse(build("checker", resolution=32), 0.8)
    settings = {"texels": 8, "views": "2x4", "lights": "2x4", "dtype": "float32", "estimator": "path"}
    settings |= {"spp": spp}
    first, second = (synthesize(tile, seed=seed, **settings) for seed in (1, 2))
    assert_variances_are_honest(first, second)


def test_variance_falls_with_samples():
    tile = _diffuse(build("checker", resolution=32), 0.8)
    settings = {"texels": 4, "views": "2x4", "lights": "2x4", "dtype": "float32", "estimator": "path"}
    few, many = (synthesize(tile, spp=spp, **settings).variance.mean() for spp in (16, 256))
    # Stratification makes it fall faster than 1/spp.
    assert many <= few / 16


def test_same_seed_same_bytes_whatever_the_batches(monkeypatch):
    whole = synthesize("checker", seed=9, **SMALL)
    again = synthesize("checker", seed=9, **SMALL)
    # Five texels at a time, which do not divide sixteen.
    monkeypatch.setattr(estimator, "SAMPLE_BUFFER", 5 * 4 * 12 * 8)
    batches = synthesize("checker", seed=9, **SMALL)
    other = synthesize("checker", seed=10, **SMALL)
    for btf in (again, batches):
        assert np.array_equal(btf.values, whole.values)
        assert np.array_equal(btf.variance, whole.variance)
    assert not np.array_equal(other.values, whole.values)


def test_a_subset_of_lights_gives_the_same_values():
    vectors = directions("2x4").vectors
    settings = SMALL | {"seed": 4}
    whole = synthesize("checker", **settings)
    part = synthesize("checker", **settings | {"lights": vectors[[0, 3, 5, 6]]})
    assert np.array_equal(part.values, whole.values[:, [0, 3, 5, 6]])


def test_rays_that_leave_the_patch_go_on(monkeypatch):
    """A deep tile under low lights: one tile around and wrapped rays give what four tiles around give."""
    vectors = directions("ubo81").vectors[[0, 44, 60, 70]]
    settings = {
        "texels": 8,
        "views": vectors,
        "lights": vectors,
        "spp": 8,
        "dtype": "float32",
        "resolution": 16,
        "estimator": "path",
    }
    wide = synthesize("checker", amplitude=1.0, **settings)
    monkeypatch.setattr(tiled_scene, "MAXIMUM_REACH", 1)
    wrapped = synthesize("checker", amplitude=1.0, **settings)
    difference = np.abs(wide.values - wrapped.values) / wide.values.max()
    # The same random numbers: only rays that graze an edge may differ by rounding.
    assert np.quantile(difference, 0.99) <= tolerance("synthesis.wrap")
    assert wide.values.mean() > 0
    monkeypatch.setattr(tiled_scene, "MAXIMUM_ROUNDS", 0)
    cut = synthesize("checker", amplitude=1.0, **settings)
    assert np.quantile(np.abs(wide.values - cut.values) / wide.values.max(), 0.99) > tolerance(
        "synthesis.wrap"
    )


def _table(shift):
    """A square plate above a floor; moved over the tile's border it must look the same, moved along."""
    grey = {
        "type": "twosided",
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.6] * 3}},
    }
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    faces, up = [[0, 1, 2], [0, 2, 3]], np.tile([0.0, 0.0, 1.0], (4, 1))
    plate = square * [0.5, 0.5, 1] + [0.25 + shift, 0.25, 0]
    return Mesostructure(
        "table", {"shift": shift}, (Part(square - [0, 0, 0.3], faces, grey, up), Part(plate, faces, grey, up))
    )


def test_geometry_may_stick_out_of_its_tile():
    vectors = directions("ubo81").vectors[[0, 44, 60, 70]]
    settings = {"texels": 8, "views": vectors, "lights": vectors, "dtype": "float32", "estimator": "path"}
    settings |= {"spp": 128}
    inside, outside = synthesize(_table(0.0), seed=1, **settings), synthesize(_table(0.5), seed=2, **settings)
    assert _table(0.5).overhang == 0.25
    # The plate's top has no noise at all, but float32 rounding.
    rounding = (tolerance("synthesis.rounding") * inside.values.max()) ** 2
    moved = np.roll(outside.values, -4, axis=3), np.roll(outside.variance, -4, axis=3) + rounding
    _, p = welch_test(inside.values, inside.variance, *moved, n_a=64, n_b=64)
    limit = tolerance("closing_loop.difference.rejected_fraction")
    assert difference_test(p, significance=tolerance("synthesis.z.significance")).rejected_fraction <= limit
    _, p = welch_test(inside.values, inside.variance, outside.values, outside.variance + rounding)
    assert difference_test(p, significance=tolerance("synthesis.z.significance")).rejected_fraction > limit


def test_horizon_is_black():
    vectors = np.array([[0.0, 0, 1], [1, 0, 0], [0.6, 0, 0.8], [0, 0.6, 0.8]])
    btf = synthesize("flat", texels=2, spp=2, views=vectors, lights=vectors, estimator="path")
    assert not btf.values[1].any()
    assert not btf.values[:, 1].any()
    assert btf.values[0, 0].all()


def test_transmission_is_traced():
    """A diffusely transmitting sheet over a white floor is brighter than over a black one."""
    sheet = {"type": "principledthin", "base_color": {"type": "rgb", "value": [0.8] * 3}, "diff_trans": 1.6}
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    faces, up = [[0, 1, 2], [0, 2, 3]], np.tile([0.0, 0.0, 1.0], (4, 1))

    def brightness(floor):
        ground = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [floor] * 3}}
        parts = (Part(square, faces, sheet, up), Part(square - [0, 0, 0.2], faces, ground, up))
        tile = Mesostructure("sheet", {"floor": floor}, parts)
        made = synthesize(tile, texels=2, spp=256, views="2x3", lights="2x3", dtype="float32")
        assert made.attributes["estimator"] == "path"
        return made.values.mean()

    assert brightness(0.9) > tolerance("synthesis.light_through") * brightness(0.0)


@pytest.mark.parametrize(
    ("settings", "field"),
    [
        ({"texels": 0}, "texels"),
        ({"texels": -4}, "texels"),
        ({"texels": 2.5}, "texels"),
        ({"texels": (4, 4, 4)}, "texels"),
        ({"spp": 1}, "spp"),
        ({"seed": -1}, "seed"),
        ({"max_depth": 1}, "max_depth"),
        ({"dtype": "float64"}, "dtype"),
        ({"estimator": "magic"}, "estimator"),
        ({"variant": "scalar_rgb"}, "variant"),
        ({"views": "ubo80"}, None),
        ({"lights": [[0, 0, np.nan]]}, None),
        ({"lights": [[0, 0, -1.0]]}, None),
        ({"mesostructure": "chess"}, "mesostructure"),
        ({"bumps": 3}, "bumps"),
    ],
)
def test_bad_settings_are_one_clear_line(tmp_path, settings, field):
    out = tmp_path / "a.btf.zarr"
    with pytest.raises(InputError) as error:
        synthesize(**SMALL | settings, out=out)
    assert "\n" not in str(error.value)
    assert error.value.field == field
    assert os.listdir(tmp_path) == []


def _equal(left, right):
    """Whether two folders hold the same files with the same bytes."""
    names = [
        sorted(str(p.relative_to(root)) for p in Path(root).rglob("*") if p.is_file())
        for root in (left, right)
    ]
    return names[0] == names[1] and not any(filecmp.cmpfiles(left, right, names[0], shallow=False)[1:])


def test_a_finished_store_is_returned_and_another_refused(tmp_path):
    out = tmp_path / "a.btf.zarr"
    calls = []
    first = synthesize("checker", out=out, progress=lambda *call: calls.append(call), **SMALL)
    assert calls == [(k, 6, "synthesis") for k in range(1, 7)]
    stamp = {p: p.stat().st_mtime_ns for p in out.rglob("*")}
    again = synthesize("checker", out=out, progress=lambda *call: calls.append(call), **SMALL)
    assert len(calls) == 6
    assert {p: p.stat().st_mtime_ns for p in out.rglob("*")} == stamp
    memory = synthesize("checker", **SMALL)
    for btf in (again, memory):
        assert np.array_equal(btf.values, first.values)
        assert btf.attributes["parent"] == first.attributes["parent"]
    for other, field in (
        ({"seed": 1}, "seed"),
        ({"spp": 6}, "parameters.spp"),
        ({"amplitude": 0.2}, "parent.parameters.amplitude"),
        ({"views": "2x4"}, "views"),
        ({"mesostructure": "flat", "resolution": None}, "parent.name"),
    ):
        settings = {key: value for key, value in (SMALL | other).items() if value is not None}
        with pytest.raises(InputError, match="other settings") as error:
            synthesize_store(out, **settings)
        assert error.value.field == field
    assert {p: p.stat().st_mtime_ns for p in out.rglob("*")} == stamp
    synthesize("checker", out=out, overwrite=True, **SMALL | {"seed": 1})
    assert open_store(out).attributes["seed"] == 1


def test_an_interrupted_run_of_other_settings_is_not_continued(tmp_path):
    out = tmp_path / "a.btf.zarr"

    class StopError(Exception):
        pass

    def stop(done, total, label):
        raise StopError

    with pytest.raises(StopError):
        synthesize("checker", out=out, progress=stop, **SMALL)
    assert not open_store(out).complete
    with pytest.raises(InputError, match="other settings"):
        synthesize("checker", out=out, **SMALL | {"seed": 3})
    assert synthesize("checker", out=out, **SMALL).values.shape == (6, 8, 4, 4, 3)


CHILD = """
import sys
from btfref.sampling.synthesis import synthesize_store
import mitsuba, zarr
print("ready", flush=True)
synthesize_store(sys.argv[1], "checker", texels=8, views="ubo81", lights="3x3", spp=16, seed=8, resolution=32,
                 estimator=sys.argv[2], progress=lambda done, total, label: print(done, flush=True))
"""


def _child(out, estimator):
    root = str(Path(__file__).parents[2])
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([root, os.environ.get("PYTHONPATH", "")])}
    return subprocess.Popen(
        [sys.executable, "-c", CHILD, str(out), estimator], stdout=subprocess.PIPE, text=True, env=environment
    )


@pytest.mark.parametrize("estimator", ["path", pytest.param("surface", marks=pytest.mark.long)])
def test_killed_runs_resume_to_the_same_bytes(tmp_path, rng, estimator):
    whole = tmp_path / "whole.btf.zarr"
    process = _child(whole, estimator)
    process.communicate()
    assert process.returncode == 0

    killed = tmp_path / "killed.btf.zarr"
    partial = 0
    for attempt in range(5):
        process = _child(killed, estimator)
        assert process.stdout.readline() == "ready\n"
        if attempt % 2:
            # Some views further: one is being traced, written or marked.
            for _ in range(rng.integers(1, 20)):
                process.stdout.readline()
            time.sleep(rng.uniform(0, 0.02))
        else:
            # Near the start: the store is being laid out, or the scene built.
            time.sleep(rng.uniform(0, 0.3))
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
        process.stdout.close()
        if killed.exists():
            store = open_store(killed)
            partial += 0 < store.coverage.mean() < 1
            if estimator == "surface" and store.complete:
                break  # all views come within moments of each other
            assert not store.complete
            with pytest.raises(InputError, match="incomplete"):
                SampledBTF.load(killed)
    assert partial >= (2 if estimator == "path" else 0)
    process = _child(killed, estimator)
    process.communicate()
    assert process.returncode == 0
    assert SampledBTF.load(killed).values.any()
    assert _equal(whole, killed)
    assert sorted(os.listdir(tmp_path)) == ["killed.btf.zarr", "whole.btf.zarr"]
