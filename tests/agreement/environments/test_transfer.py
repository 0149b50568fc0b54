"""Clustered transfer: GLSL against float64, shadows and light between meshes against the path tracer."""

from dataclasses import replace

import numpy as np
import pytest

from btfref.comparison import compare
from btfref.conventions import PixelClass
from btfref.errors import InputError
from btfref.gates.tolerances import tolerance
from btfref.numerics.sphere import harmonics
from btfref.numerics.sphere.quadrature import gauss_hemisphere
from btfref.rendering.environment_light import transfer, transfer_light
from btfref.rendering.environment_light.lighting import lighting_of
from btfref.rendering.environment_light.transfer import (
    TransferSettings,
    clustered,
    corner_matrices,
    vertex_transfer,
)
from btfref.rendering.gl.realtime import realtime
from btfref.rendering.gl.renderer import Renderer
from btfref.rendering.offline.approximate import approximate
from btfref.rendering.offline.reference import render
from btfref.scene.description import Light, read_scene
from btfref.scene.environments import harmonic_environment
from btfref.scene.pixel_classes import pixel_classes
from btfref.scene.shapes import neighbours
from btfref.scene.shipped import scene_file

pytestmark = pytest.mark.usefixtures("renderers", "coarse_environments")

SIZE = (32, 32)
SUM = tolerance("rendered.sum.rtol")


def parameters(fits, environment="harmonics", **more):
    return {"btf": str(fits.path("lpca")), "lights": "envmap", "environment": environment, **more}


def described(fits, name, **more):
    return read_scene(scene_file(name), parameters(fits, **more), size=SIZE)


@pytest.mark.parametrize(
    ("scene", "settings"),
    [
        ("cloth", TransferSettings(clusters=6, components=3, bits=8)),
        pytest.param(
            "bowl",
            TransferSettings(clusters=12, components=5, shadows=True, bounces=1),
            marks=pytest.mark.long,
        ),
        ("plane", TransferSettings(map_size=12)),
    ],
)
def test_pictures_equal_float64(fits, scene, settings):
    """Both sides, boundaries between clusters, codes and floats."""
    options = {"parameters": parameters(fits), "grid": 1, "size": SIZE, "order": 3, "transfer": settings}
    image = realtime(scene_file(scene), environment="transfer", **options)
    exact = approximate(scene_file(scene), path="transfer", **options)
    classes = pixel_classes(scene_file(scene), parameters=parameters(fits), grid=1, size=SIZE)
    found = compare(image, exact, classes=classes, gate="image.float64", flip=False)
    assert found.passed, [gate.line for gate in found.gates]
    facts = ("matrix_clusters", "table_bytes", "map_size", "bits", "environment_shadows", "bounces")
    assert {k: image.meta[k] for k in facts} == {k: exact.meta[k] for k in facts}
    assert image.meta["environment_shadows"] == settings.shadows
    if scene == "plane":
        # One frame, one matrix: nothing else is computed.
        assert image.meta["matrix_clusters"] == 1


def test_the_table_of_the_paper(fits):
    """32 matrix clusters × (8 + 1) × 16 material clusters × (4 + 1) × 16² × 3 bytes."""
    scene = described(fits, "bowl")
    light = lighting_of(scene, "transfer", transfer=TransferSettings(bits=8))
    rep = fits("lpca")
    prepared = light.prepared(rep, mesh=0)
    assert prepared.facts["material_clusters"] == 16
    assert prepared.facts["table_bytes"] == 17_694_720
    assert prepared.tables["transfer_products"].nbytes == 17_694_720


def test_nothing_hidden_is_the_rotation(fits):
    scene = described(fits, "plane")
    (found,) = vertex_transfer(scene.meshes, 4)
    np.testing.assert_array_equal(found, np.broadcast_to(np.eye(16, dtype=np.float32), found.shape))


def test_what_misses_leave_in_memory_is_not_read(fits, llvm):
    """Mitsuba writes no coordinates where a ray meets nothing; a signalling NaN there is an error to look at."""
    import drjit as dr

    mi, mesh = llvm, described(fits, "plane").meshes[0]

    class Littered:
        def __init__(self):
            self.scene = mi.load_dict({"type": "scene", "mesh": transfer._mitsuba_mesh(mi, mesh, 0)})
            self.shapes = self.scene.shapes

        def ray_intersect_preliminary(self, ray):
            found = self.scene.ray_intersect_preliminary(ray)
            garbage = dr.reinterpret_array(mi.Float, dr.opaque(mi.UInt32, 0x7FA00000, dr.width(found.t)))
            found.prim_uv = dr.select(found.is_valid(), found.prim_uv, mi.Point2f(garbage, garbage))
            return found

    w = np.array([[0, 0, 1.0], [0.6, 0, 0.8]])
    vertex, weight, _ = transfer._hits(mi, Littered(), mesh, [mesh], np.array([0]), w, 1e-4)
    assert (vertex == -1).all()
    assert not weight.any()


def test_a_closed_surface_hides_the_half_behind_it(fits):
    """The matrices of a sphere: products of harmonics over a hemisphere."""
    mesh = described(fits, "sphere").meshes[0]
    (found,) = vertex_transfer([mesh], 3)
    w, weight = gauss_hemisphere(32, 64)
    at = np.flatnonzero(mesh.positions[:, 2] > 0.999)[0]
    y = harmonics.values(w, 3)
    expected = y.T @ (y * weight[:, None])
    assert np.abs(found[at] - expected).max() <= tolerance("transfer.visibility")


def test_large_scale_shadows(fits):
    """A bowl against the path tracer that hides the sky by the bowl, with shadows in the matrices and without."""
    file, own = scene_file("bowl"), parameters(fits)
    settings = {"parameters": own, "size": SIZE, "grid": 1}
    inside = pixel_classes(file, **settings) == PixelClass.INTERIOR
    reference = render(file, spp=1024, seed=2, **settings)
    noise = np.mean(reference.variance[inside])

    def error(transfer):
        image = realtime(file, environment="transfer", transfer=transfer, **settings).image
        square = np.mean((image - reference.image)[inside] ** 2) - noise
        return np.sqrt(max(square, 0)) / reference.image[inside].mean()

    assert error(TransferSettings(shadows=True)) <= tolerance("transfer.shadows")
    assert error(TransferSettings()) > 5 * tolerance("transfer.shadows")


@pytest.mark.long
def test_light_from_wall_to_wall(fits):
    """One bounce by the materials' mean albedo brings the picture nearer to two bounces of the path tracer."""
    file = scene_file("bowl")
    settings = {"size": SIZE, "parameters": parameters(fits)}
    deeper = settings | {"parameters": parameters(fits, depth="3")}
    inside = pixel_classes(file, grid=2, **settings) == PixelClass.INTERIOR
    reference = render(file, spp=512, seed=2, **deeper).image[inside].mean(0)

    def mean(bounces):
        transfer = TransferSettings(shadows=True, bounces=bounces)
        image = realtime(file, environment="transfer", transfer=transfer, grid=2, **settings).image
        return image[inside].mean(0)

    without, with_one = mean(0), mean(1)
    # In every channel: light takes the walls' colour.
    assert (with_one > without).all()
    left = np.abs(with_one - reference) / np.abs(without - reference)
    assert (left < tolerance("transfer.bounce.left")).all()


def test_light_between_meshes_has_the_walls_colour(fits):
    """To the first bounce linear in the albedo, by channel; black walls send nothing."""
    mesh = described(fits, "bowl").meshes[0]
    (direct,) = vertex_transfer([mesh], 2)
    (found,) = vertex_transfer([mesh], 2, bounces=1, albedo=[(0.9, 0.3, 0.0)])
    assert found.shape == (len(mesh.positions), 3, 4, 4)
    sent = found - direct
    assert np.abs(sent[:, 0]).max() > tolerance("transfer.bounce.min_sent")
    np.testing.assert_allclose(sent[:, 0], 3 * sent[:, 1], atol=tolerance("transfer.bounce.linear"))
    np.testing.assert_allclose(sent[:, 2], 0, atol=tolerance("transfer.bounce.black"))


def test_more_clusters_and_components_compress_less(fits):
    mesh = described(fits, "bowl").meshes[0]
    matrices = corner_matrices(mesh, 3)
    errors = [
        clustered(matrices, TransferSettings(clusters=k, components=c)).error
        for k, c in ((2, 2), (8, 2), (8, 6))
    ]
    assert errors[0] > errors[1] > errors[2]
    transfer = clustered(matrices, TransferSettings(clusters=8, components=6))
    rebuilt = np.einsum("tcj,tcj...->tc...", transfer.weights, transfer.basis[transfer.cluster])
    found = np.sqrt(((rebuilt - matrices) ** 2).sum() / (matrices**2).sum())
    assert found == pytest.approx(transfer.error, rel=tolerance("transfer.codes.stated"))


def test_bins_hold_every_triangle_of_their_clusters(fits):
    mesh = described(fits, "bowl").meshes[0]
    transfer = clustered(corner_matrices(mesh, 2), TransferSettings(clusters=5, components=2))
    table, starts = transfer_light.bins(transfer, neighbours(mesh.positions, mesh.faces))
    assert len(starts) == len(transfer.basis) + 1
    for k in range(len(transfer.basis)):
        own = set(table[starts[k] : starts[k + 1], 0].astype(int).tolist())
        assert set(np.flatnonzero((transfer.cluster == k).any(1)).tolist()) <= own
        assert len(own) < len(mesh.faces)


def test_codes_are_half_a_step_off(rng):
    table = rng.normal(size=(3, 1, 2, 4, 2, 5, 3)).astype(np.float32)
    table[:, :, :, 1:] *= 0.01
    codes, scales = transfer_light.encoded(table)
    assert 10 * scales[1, 0] < scales[0, 0]
    difference = np.abs(transfer_light.decoded(codes, scales) - table)
    for a, j in enumerate((slice(0, 1), slice(1, None))):
        for b, m in enumerate((slice(0, 1), slice(1, None))):
            step = scales[a, b] / transfer_light.LEVELS
            assert difference[:, :, :, j, :, :, m].max() <= tolerance("transfer.codes.step") * step


def test_a_moving_light_is_coarse_and_then_refined(fits):
    """The renderer's own way: few components at first, then what a fresh start would show."""
    scene = described(fits, "bowl")
    other = harmonic_environment(seed=3)[0]
    options = {"transfer": TransferSettings(clusters=6), "order": 3}
    with Renderer(scene, lighting=lighting_of(scene, "transfer", **options)) as renderer:
        renderer.draw()
        first = renderer.read().copy()
        renderer.relight(other, moving=True)
        renderer.draw()
        coarse = renderer.read().copy()
        renderer.relight(other)
        renderer.draw()
        refined = renderer.read().copy()
    light = lighting_of(scene, "transfer", **options)
    light.environment = other
    with Renderer(scene, lighting=light) as renderer:
        renderer.draw()
        fresh = renderer.read()
        np.testing.assert_allclose(refined, fresh, rtol=SUM, atol=tolerance("rendered.sum.atol"))
    change = np.abs(fresh - first).mean()
    assert 0 < np.abs(coarse - fresh).mean() < tolerance("transfer.refined.coarse") * change
    plain = lighting_of(scene, "sh")
    with Renderer(scene, lighting=plain) as renderer, pytest.raises(InputError, match="transfer"):
        renderer.relight(other)


def test_larger_maps_approach_harmonics(fits):
    """With nothing lost in the matrices, the parabolic maps over the views are what is left."""
    options = {"parameters": parameters(fits), "grid": 1, "size": SIZE, "order": 3}
    exact = realtime(scene_file("plane"), environment="sh", **options).image

    def error(size):
        settings = TransferSettings(map_size=size)
        image = realtime(scene_file("plane"), environment="transfer", transfer=settings, **options).image
        return np.sqrt(np.mean((image - exact) ** 2)) / exact.mean()

    coarse, fine = error(8), error(64)
    assert fine < coarse / 4


def test_settings_are_checked(fits):
    for wrong in ({"clusters": 0}, {"bits": 16}, {"bounces": 1}, {"components": 2.5}, {"map_size": 1}):
        with pytest.raises(InputError, match=next(iter(wrong))):
            TransferSettings(**wrong)


def test_other_lights_are_added_once(fits):
    """A directional light beside the environment: bins overlap, the light does not."""
    scene = described(fits, "cloth")
    lit = replace(scene, lights=(Light("directional", np.array([0.36, -0.48, 0.8]), np.full(3, 2.0)),))
    options = {"environment": "transfer", "order": 2, "grid": 1, "transfer": TransferSettings(clusters=5)}
    alone, both = (realtime(s, **options).image for s in (scene, lit))
    light = realtime(replace(lit, environment=None), grid=1, shadows=False).image
    assert 10 * light.max() > alone.max() > 0
    np.testing.assert_allclose(
        both, alone + light, rtol=SUM, atol=tolerance("rendered.sum.atol") * both.max()
    )
