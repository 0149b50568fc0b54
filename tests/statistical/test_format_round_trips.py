"""Synthesized materials out to every format and back, and a measured-style BTF through the whole chain."""

import io

import numpy as np
import pytest
from PIL import Image
from stores import imported

from btfref.cli import main
from btfref.formats import export_btf
from btfref.gates import tolerance
from btfref.images import load_image
from btfref.numerics.sphere.directions import directions
from btfref.sampling.synthesis import synthesize

#: The pole and the ring at 15°: whole degrees, which names can say.
FEW = directions("ubo81").vectors[:7]


@pytest.fixture(scope="module", params=["checker", "rings", "tissue"])
def material(request):
    return synthesize(request.param, texels=8, views=FEW, lights=FEW, spp=4, estimator="path")


#: Format, settings, and the gate of the largest error over the largest value; None: the stored bits themselves.
EXACT = [
    ("bonn", "x.btf", {"family": "BDI"}),
    ("ubo", "x", {"image": "exr"}),
    ("ubo", "x.zip", {"image": "exr"}),
]


@pytest.mark.parametrize(("format", "name", "settings"), EXACT)
def test_formats_of_half_floats_are_exact(format, name, settings, material, tmp_path):
    export_btf(material, tmp_path / name, format, **settings)
    found = imported(tmp_path / name, dtype="float16")
    assert np.array_equal(found.values, material.values)
    np.testing.assert_allclose(
        found.lights.vectors, material.lights.vectors, atol=tolerance("formats.float32.atol")
    )


@pytest.mark.parametrize(
    ("format", "settings", "gate"),
    [
        ("utia", {"image": "exr"}, "formats.half_xyz"),
        ("ubo", {"image": "hdr"}, "formats.radiance"),
        ("ubo", {"image": "png"}, "formats.code_gamma"),
        ("utia", {"image": "png"}, "formats.code_srgb"),
    ],
)
def test_other_pictures_err_as_their_codes_do(format, settings, gate, material, tmp_path):
    largest = float(material.values.max())
    if settings["image"] == "png":
        # UTIA's codes hold π · B / cos θ: the largest inverse cosine here is that of 15°.
        settings = settings | {"scale": largest * (np.pi / np.cos(np.pi / 12) if format == "utia" else 1)}
    facts = export_btf(material, tmp_path / "x", format, **settings)
    error = np.abs(imported(tmp_path / "x").values - material.values.astype(float)).max()
    assert facts["clipped"] == 0
    assert error / largest <= tolerance(f"{gate}.max")


@pytest.mark.parametrize("components", [4, 16])
def test_dfmf_errs_as_it_says(components, material, tmp_path):
    facts = export_btf(material, tmp_path / "x.btf", "bonn", components=components, scalar=4)
    original = material.values.astype(float)
    difference = imported(tmp_path / "x.btf").values - original
    error = np.sqrt((difference**2).sum((0, 1, 2, 3)) / (original**2).sum((0, 1, 2, 3)))
    np.testing.assert_allclose(
        error, facts["error"], rtol=tolerance("formats.stated.rtol"), atol=tolerance("formats.stated.atol")
    )


def test_measured_style(tmp_path, monkeypatch, capsys):
    """JPEG pictures to 75° with lights moved out of the camera's way, through fit, both renderers and their gate."""
    monkeypatch.chdir(tmp_path)
    original = synthesize("checker", texels=8, views="ubo81", lights="ubo81", spp=4, estimator="surface")
    scale = float(np.quantile(original.values, 0.9995))
    facts = export_btf(original, tmp_path / "m.zip", "ubo", image="jpg", scale=scale, moved=10)
    assert facts["lights_moved"] == 81
    assert facts["clipped"] > 0
    found = imported(tmp_path / "m.zip", dtype="float16")
    assert found.views == original.views
    assert found.lights == original.lights
    # Highlights are clipped, and what comes back is what Pillow makes of the codes.
    for view, light in ((0, 5), (17, 3), (80, 60)):
        codes = np.round(
            255 * np.clip(original.values[view, light, ::-1] / np.float32(scale), 0, 1) ** (1 / 2.2)
        )
        stream = io.BytesIO()
        Image.fromarray(codes.astype(np.uint8)).save(stream, "JPEG", quality=95, subsampling=0)
        expected = scale * (np.asarray(Image.open(stream)) / 255) ** 2.2
        np.testing.assert_allclose(
            found.values[view, light, ::-1],
            expected,
            rtol=tolerance("formats.half.rtol"),
            atol=tolerance("formats.half.atol"),
        )
    size, classes = ["--size", "64x64"], ["--classes", "c.png"]
    for command in (
        ["fit", "lpca", "m.zip.btf.zarr", "-o", "m.exr", "--set", "clusters=4", "components=4"],
        [
            "render",
            "cloth",
            "-o",
            "a.exr",
            "-D",
            "btf=m.exr",
            "--grid",
            "4",
            *classes,
            *size,
        ],
        ["realtime", "cloth", "-o", "b.exr", "-D", "btf=m.exr", "--grid", "4", *size],
        ["compare", "b.exr", "a.exr", *classes, "--gate", "image.noise_free"],
    ):
        assert main(command) == 0, (command, capsys.readouterr())
    assert load_image("a.exr").max() > 0
