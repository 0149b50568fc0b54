"""Closing the loop: the synthetic BTF, and the raw plugin showing it, against plain renders of geometry."""

import numpy as np
import pytest
from plain_renders import PlainRenders, texel_camera

from btfref.comparison.significance import bias_interval, difference_test, welch_test
from btfref.gates.tolerances import tolerance
from btfref.mesostructure import build
from btfref.numerics.sphere.directions import directions
from btfref.sampling.synthesis import synthesize

TEXELS = 16
SPP = 1024
ROUNDS, ROUND_SPP = 16, 64
MAX_DEPTH = 8

#: Indices into ubo81: polar angles 0, 15, 30, 45, 60, 60, 75, 75 degrees; the same set for views and lights.
CHOSEN = [0, 5, 12, 30, 40, 52, 62, 75]

#: (view, light) as indices into CHOSEN.
PAIRS = [
    (0, 0),
    (0, 6),
    (1, 2),
    (2, 7),
    (3, 3),
    (4, 1),
    (4, 5),
    (5, 4),
    (6, 0),
    (6, 3),
    (6, 6),
    (7, 5),
    (7, 6),
]


@pytest.fixture(scope="module")
def mesostructure():
    # Gloss of 0.3: lobes that plain path tracing resolves, so that its variance estimate can be believed.
    return build("checker", resolution=64, raised_roughness=0.3)


@pytest.fixture(scope="module")
def vectors():
    return directions("ubo81").vectors[CHOSEN]


@pytest.fixture(scope="module")
def btf(need, mesostructure, vectors):
    need("llvm")
    return synthesize(
        mesostructure,
        texels=TEXELS,
        views=vectors,
        lights=vectors,
        spp=SPP,
        max_depth=MAX_DEPTH,
        dtype="float32",
        seed=5,
        estimator="path",
    )


@pytest.fixture(scope="module")
def plain(need, mesostructure, vectors):
    """Mean and variance of the mean of every pair, by plain Mitsuba."""
    need("llvm")
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    renders = PlainRenders(mi, mesostructure, texels=TEXELS, reach=3, max_depth=MAX_DEPTH)
    options = {"spp": ROUND_SPP, "rounds": ROUNDS}
    return {
        (v, k): renders.pair(vectors[v], vectors[k], seed=1000 * v + 100 * k, **options) for v, k in PAIRS
    }


def _judge(btf, plain, values=None):
    """Share of rejected texels, largest |z| of a pair's mean, and its largest relative bias."""
    values = btf.values if values is None else values
    p, z, bias = [], [], []
    for (v, k), (mean, variance) in plain.items():
        test, spread = values[v, k].astype(np.float64), btf.variance[v, k].astype(np.float64)
        p.append(welch_test(test, spread, mean, variance, n_a=SPP // 2, n_b=ROUNDS)[1])
        interval = bias_interval(test - mean, spread + variance)
        z.append(interval.estimate / interval.standard_error)
        # The far end of the interval: noise cannot hide a bias.
        bias.append(max(abs(interval.low), abs(interval.high)) / mean.mean())
    difference = difference_test(np.stack(p), significance=tolerance("closing_loop.difference.significance"))
    return difference.rejected_fraction, np.abs(z).max(), max(bias)


def _passes(btf, plain, values=None):
    rejected, z, bias = _judge(btf, plain, values)
    return (
        rejected <= tolerance("closing_loop.difference.rejected_fraction")
        and z <= tolerance("closing_loop.bias.z")
        and bias <= tolerance("closing_loop.bias.relative")
    )


@pytest.mark.usefixtures("llvm")
def test_the_camera_of_the_plain_renders_sees_texels(llvm, vectors):
    for view in vectors:
        camera = texel_camera(llvm, view, TEXELS)
        at = llvm.Point2f([0.0, 0.25, 1.0], [0.0, 0.5, 0.75])
        ray, _ = camera.sample_ray(0.0, 0.0, at, llvm.Point2f(0.5, 0.5))
        t = -ray.o.z / ray.d.z
        hit = np.array(ray.o + t * ray.d).T
        assert np.abs(hit - [[0, 0, 0], [0.25, 0.5, 0], [1, 0.75, 0]]).max() <= tolerance(
            "closing_loop.camera"
        )
        assert np.abs(np.array(ray.d).T + view).max() <= tolerance("closing_loop.camera")


@pytest.mark.usefixtures("llvm")
def test_synthesis_equals_plain_renders(btf, plain):
    rejected, z, bias = _judge(btf, plain)
    assert rejected <= tolerance("closing_loop.difference.rejected_fraction")
    assert z <= tolerance("closing_loop.bias.z")
    assert bias <= tolerance("closing_loop.bias.relative")


FAULTS = {
    "cosine dropped": lambda values, w: values / w[None, :, 2, None, None, None],
    "cosine twice": lambda values, w: values * w[None, :, 2, None, None, None],
    "light and view swapped": lambda values, w: values.swapaxes(0, 1),
    "texels transposed": lambda values, w: values.swapaxes(2, 3),
    "v flipped": lambda values, w: values[:, :, ::-1],
    "half a texel off": lambda values, w: 0.5 * (values + np.roll(values, 1, axis=3)),
    "one light on": lambda values, w: np.roll(values, 1, axis=1),
    "channels reversed": lambda values, w: values[..., ::-1],
    "one percent too bright": lambda values, w: 1.01 * values,
}


@pytest.mark.parametrize("fault", sorted(FAULTS))
@pytest.mark.usefixtures("llvm")
def test_faults_are_caught(btf, plain, vectors, fault):
    values = FAULTS[fault](btf.values.astype(np.float64), vectors)
    assert not _passes(btf, plain, values)


@pytest.mark.usefixtures("llvm")
def test_direct_light_alone_is_caught(mesostructure, vectors, btf, plain):
    direct = synthesize(
        mesostructure,
        texels=TEXELS,
        views=vectors,
        lights=vectors,
        spp=64,
        max_depth=2,
        dtype="float32",
        seed=6,
        estimator="path",
    )
    assert not _passes(btf, plain, direct.values)


@pytest.mark.usefixtures("llvm")
def test_raw_plugin_on_a_plane_equals_the_geometry(llvm, load_plugin, btf, plain, vectors, tmp_path):
    """The same camera on a flat rectangle with the raw BTF: the picture is the texels, and the geometry's."""
    from btfref.representations.file.container import save
    from btfref.representations.tabulated import raw

    mi = llvm
    save(raw.fit(btf), tmp_path / "checker.raw.exr")
    material = load_plugin(tmp_path / "checker.raw.exr", filter_type="nearest")
    place = mi.ScalarTransform4f().translate([0.5, 0.5, 0]).scale([0.5, 0.5, 1])
    integrator = mi.load_dict({"type": "direct", "bsdf_samples": 0, "emitter_samples": 1})
    pictures = np.zeros_like(btf.values)
    for v, k in PAIRS:
        light = {"type": "directional", "direction": (-vectors[k]).tolist(), "irradiance": 1.0}
        scene = mi.load_dict(
            {
                "type": "scene",
                "light": light,
                "plane": {"type": "rectangle", "to_world": place, "bsdf": material},
            }
        )
        camera = texel_camera(mi, vectors[v], TEXELS)
        pictures[v, k] = np.array(mi.render(scene, sensor=camera, integrator=integrator, spp=4, seed=1))
        error = np.abs(pictures[v, k] - btf.values[v, k]).max() / btf.values[v, k].max()
        assert error <= tolerance("closing_loop.raw")
    assert _passes(btf, plain, pictures)
