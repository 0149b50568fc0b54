"""Geometry truth: the flat scene with the mesostructure itself, against what it must equal."""

import numpy as np
import pytest

from btfref.comparison.significance import bias_interval, difference_test, welch_test
from btfref.conventions import PixelClass
from btfref.errors import InputError
from btfref.gates.tolerances import tolerance
from btfref.mesostructure import build
from btfref.numerics.sphere.directions import directions
from btfref.rendering.offline.geometry import geometry_classes, render_geometry
from btfref.sampling.synthesis import synthesize

pytestmark = pytest.mark.usefixtures("llvm")

SIZE = (48, 32)


def _scene(mi, btf, *, tiles=1.0, origin=(0.4, -0.9, 1.6), **material):
    transform = mi.ScalarTransform4f
    scene = {
        "type": "scene",
        "camera": {
            "type": "perspective",
            "fov": 55.0,
            "to_world": transform().look_at(origin=list(origin), target=[0, 0, 0], up=[0, 1, 0]),
            "film": {"type": "hdrfilm", "width": SIZE[0], "height": SIZE[1], "rfilter": {"type": "box"}},
        },
        "plane": {
            "type": "rectangle",
            "bsdf": {
                "type": "btf",
                "filename": str(btf),
                "to_uv": transform().scale([tiles, tiles, 1]),
                **material,
            },
        },
    }
    scene["light"] = {
        "type": "directional",
        "direction": [-0.3, 0.0, -1.0],
        "irradiance": {"type": "rgb", "value": [2.0, 1.5, 1.0]},
    }
    return scene


@pytest.fixture(scope="module")
def files(need, tmp_path_factory):
    """Raw BTFs of a flat tile and of a checker."""
    need("llvm")
    from btfref.representations.file.container import save
    from btfref.representations.tabulated import raw

    folder = tmp_path_factory.mktemp("btf")
    vectors = directions("ubo81").vectors[:19]
    settings = {"views": vectors, "lights": vectors, "spp": 16, "texels": 8, "estimator": "path"}
    for name, parameters in (("flat", {"reflectance": 0.4}), ("checker", {"resolution": 32})):
        save(raw.fit(synthesize(name, **settings, **parameters)), folder / f"{name}.raw.exr")
    return folder


def test_flat_tile_is_lambertian(llvm, files):
    scene = _scene(llvm, files / "flat.raw.exr")
    result = render_geometry(scene, spp=8)
    classes = geometry_classes(scene)
    expected = 0.4 / np.pi / np.hypot(0.3, 1.0) * np.array([2.0, 1.5, 1.0])
    assert (classes == PixelClass.INTERIOR).mean() > tolerance("rendered.subject.min_covered")
    error = np.abs(result.image[classes == PixelClass.INTERIOR] / expected - 1)
    assert error.max() <= tolerance("geometry.flat")
    assert not result.image[classes == PixelClass.BACKGROUND].any()
    assert result.meta["mesostructure"]["name"] == "flat"


def test_checker_comes_from_the_file_and_tiles_as_the_texture(llvm, files):
    """Same camera and plane, the mesostructure as one mesh at the place that uv gives, without instances."""
    mi = llvm
    scene = _scene(mi, files / "checker.raw.exr", tiles=2.0)
    result = render_geometry(scene, spp=1024, seed=3)
    tile = build("checker", resolution=32)
    # u = (x + 1)/2 · 2 = x + 1: tiles of side 1 from x = −1.
    shapes = {}
    for index, part in enumerate(tile.parts):
        offsets = [np.array([i, j, 0.0]) for i in (-1, 0) for j in (-1, 0)]
        vertices = np.concatenate([part.vertices + offset for offset in offsets])
        faces = np.concatenate([part.faces + len(part.vertices) * k for k in range(4)])
        properties = mi.Properties()
        properties["material"] = mi.load_dict(part.bsdf)
        mesh = mi.Mesh(str(index), len(vertices), len(faces), has_vertex_normals=True, props=properties)
        values = mi.traverse(mesh)
        values["vertex_positions"] = vertices.astype(np.float32).ravel()
        values["vertex_normals"] = np.tile(part.normals, (4, 1)).astype(np.float32).ravel()
        values["faces"] = faces.astype(np.uint32).ravel()
        values.update()
        shapes[f"part_{index}"] = mesh
    plain = mi.load_dict({key: value for key, value in scene.items() if key != "plane"} | shapes)
    integrator = mi.load_dict({"type": "path", "max_depth": result.meta["max_depth"]})
    images = np.stack(
        [np.array(mi.render(plain, integrator=integrator, spp=64, seed=50 + k)) for k in range(16)]
    )
    mean, variance = images.mean(0, dtype=np.float64), images.var(0, ddof=1, dtype=np.float64) / 16
    p = welch_test(result.image, result.variance, mean, variance, n_a=16, n_b=16)[1]
    difference = difference_test(p, significance=tolerance("closing_loop.difference.significance"))
    assert difference.rejected_fraction <= tolerance("closing_loop.difference.rejected_fraction")
    bias = bias_interval(result.image - mean, result.variance + variance)
    assert abs(bias.estimate) <= tolerance("closing_loop.bias.z") * bias.standard_error
    shifted = np.roll(result.image, 2, axis=1)
    p = welch_test(shifted, result.variance, mean, variance, n_a=16, n_b=16)[1]
    difference = difference_test(p, significance=tolerance("closing_loop.difference.significance"))
    assert difference.rejected_fraction > tolerance("closing_loop.difference.rejected_fraction")


def test_mirrored_tiles_in_mirrored_light_are_the_mirrored_picture(llvm, files):
    """By symmetry of the plane: camera in the middle, texture and light mirrored."""
    scene = _scene(llvm, files / "checker.raw.exr", tiles=2.0, origin=(0, -0.9, 1.6))
    straight = render_geometry(scene, spp=256, seed=3)
    scene["plane"]["bsdf"]["to_uv"] = llvm.ScalarTransform4f().scale([-2, 2, 1])
    lit_alike = render_geometry(scene, spp=256, seed=4)
    scene["light"]["direction"] = [0.3, 0.0, -1.0]
    mirrored = render_geometry(scene, spp=256, seed=4)
    rejected = []
    for one in (mirrored, lit_alike):
        there = straight.image[:, ::-1], straight.variance[:, ::-1]
        p = welch_test(one.image, one.variance, *there, n_a=16, n_b=16)[1]
        found = difference_test(p, significance=tolerance("closing_loop.difference.significance"))
        rejected.append(found.rejected_fraction)
    limit = tolerance("closing_loop.difference.rejected_fraction")
    assert rejected[0] <= limit < rejected[1]


def test_same_seed_same_bytes(llvm, files):
    scene = _scene(llvm, files / "checker.raw.exr")
    first, second, other = (render_geometry(scene, spp=4, seed=seed) for seed in (1, 1, 2))
    assert np.array_equal(first.image, second.image)
    assert np.array_equal(first.variance, second.variance)
    assert not np.array_equal(first.image, other.image)


def test_interior_keeps_away_from_the_border(llvm, files):
    """The margin grows with the depth of the mesostructure."""
    scene = _scene(llvm, files / "checker.raw.exr", tiles=4.0)
    shallow = geometry_classes(scene, mesostructure=build("checker", resolution=32, amplitude=0.05))
    deep = geometry_classes(scene, mesostructure=build("checker", resolution=32, amplitude=0.4))
    assert 0 < (deep == PixelClass.INTERIOR).sum() < (shallow == PixelClass.INTERIOR).sum()
    assert (shallow[deep == PixelClass.INTERIOR] == PixelClass.INTERIOR).all()
    assert ((shallow == PixelClass.BACKGROUND) == (deep == PixelClass.BACKGROUND)).all()


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"scale": 2.0}, "no scale"),
        ({"to_uv": "stretched"}, "not square"),
        ({"to_uv": "turned"}, "turned"),
        ({"spp": 1}, "spp"),
        ({"shape": "sphere"}, "flat"),
    ],
)
def test_scenes_that_have_no_geometry_truth_are_refused(llvm, files, change, match):
    transform = llvm.ScalarTransform4f
    scene = _scene(llvm, files / "checker.raw.exr")
    if "scale" in change:
        scene["plane"]["bsdf"]["scale"] = change["scale"]
    if change.get("to_uv") == "stretched":
        scene["plane"]["bsdf"]["to_uv"] = transform().scale([2, 1, 1])
    if change.get("to_uv") == "turned":
        scene["plane"]["bsdf"]["to_uv"] = transform().rotate([0, 0, 1], 30)
    if "shape" in change:
        scene["plane"]["type"] = change["shape"]
    with pytest.raises(InputError, match=match):
        render_geometry(scene, spp=change.get("spp", 4))


def test_a_btf_without_a_parent_is_refused(llvm, files, tmp_path, rng):
    from btfref.representations.file.container import save
    from btfref.representations.tabulated import raw
    from btfref.sampling import SampledBTF

    vectors = directions("2x4")
    values = rng.gamma(2.0, 0.05, (8, 8, 2, 2, 3)).astype(np.float16)
    save(raw.fit(SampledBTF(values, vectors, vectors)), tmp_path / "measured.raw.exr")
    with pytest.raises(InputError) as error:
        render_geometry(_scene(llvm, tmp_path / "measured.raw.exr"), spp=4)
    assert error.value.field == "parent"
