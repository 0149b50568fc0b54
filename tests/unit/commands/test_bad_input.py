"""Bad input on the command line: one clear line, exit status 2, no traceback, nothing written or replaced."""

import shutil

import numpy as np
import pytest

from btfref.cli import main
from btfref.images import save_image
from btfref.numerics.sphere.directions import directions
from btfref.representations.file.container import load, save
from btfref.representations.tabulated import raw
from btfref.sampling import SampledBTF

SENTINEL = b"precious"

SCENE = """<scene version="3.0.0">
  <default name="btf" value="good.exr"/>
  <integrator type="direct"/>
  {sensor}
  {shape}
  {light}
</scene>
"""
SENSOR = """<sensor type="perspective">
    <transform name="to_world"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/></film>
  </sensor>"""
SHAPE = '<shape type="rectangle"><bsdf type="btf"><string name="filename" value="$btf"/></bsdf></shape>'
LIGHT = '<emitter type="directional"><vector name="direction" value="0,0,-1"/></emitter>'

PLY_WITHOUT_UV = """ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
end_header
0 0 0
1 0 0
0 1 0
3 0 1 2
"""


@pytest.fixture(scope="module")
def material(tmp_path_factory):
    """A folder with a good store, representation, image and scene."""
    folder = tmp_path_factory.mktemp("material")
    grid = directions("2x4")
    values = np.full((8, 8, 2, 2, 3), 0.25, np.float32)
    SampledBTF(values, grid, grid, None, {}).save(folder / "good.btf.zarr")
    save(raw.fit(SampledBTF.load(folder / "good.btf.zarr")), folder / "good.exr")
    save_image(folder / "image.exr", np.ones((4, 4, 3)))
    save_image(folder / "image.png", np.ones((4, 4, 3)))
    (folder / "mesh.ply").write_text(PLY_WITHOUT_UV)
    (folder / "good.xml").write_text(SCENE.format(sensor=SENSOR, shape=SHAPE, light=LIGHT))
    return folder


@pytest.fixture
def folder(material, tmp_path, monkeypatch):
    """A private copy of the material, as the current directory, with outputs that must survive."""
    shutil.copytree(material, tmp_path, dirs_exist_ok=True)
    for name in ("out.exr", "out.png", "out.html"):
        (tmp_path / name).write_bytes(SENTINEL)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def contents(folder):
    """Every file with its bytes."""
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def refuse(folder, capsys, *arguments, words=()):
    """Run a command that must fail as bad input does; returns its one line."""
    before = contents(folder)
    capsys.readouterr()
    # The sentinels are of no kind that a command writes.
    over = ["--overwrite"] if {"out.exr", "out.png", "out.html"} & set(arguments) else []
    assert main([*arguments, *over]) == 2
    captured = capsys.readouterr()
    line = captured.err
    assert line.startswith("btfref: error: ")
    assert line.endswith("\n")
    assert line.count("\n") == 1
    assert captured.out == ""
    assert len(line) < 1000
    for word in words:
        assert word in line
    assert contents(folder) == before
    return line


def truncated(path):
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])


def emptied(path):
    path.write_bytes(b"")


def wrong_magic(path):
    path.write_bytes(b"GIF89a" + path.read_bytes()[6:])


def missing(path):
    path.unlink()


def a_folder(path):
    path.unlink()
    path.mkdir()


DAMAGES = (truncated, emptied, wrong_magic, missing, a_folder)


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_representation(damage, folder, capsys):
    damage(folder / "good.exr")
    refuse(folder, capsys, "info", "good.exr", words=["good.exr"])
    refuse(folder, capsys, "render", "good.xml", "-o", "out.exr", "--grid", "1", words=["good.exr"])
    refuse(folder, capsys, "realtime", "good.xml", "-o", "out.exr", words=["good.exr"])


def test_representation_with_nan(folder, capsys):
    good = load(folder / "good.exr")
    arrays = {name: array.copy() for name, array in good.arrays().items()}
    arrays["values"].flat[3] = np.nan
    save(type(good).from_arrays(arrays, good.meta), folder / "good.exr")
    refuse(
        folder,
        capsys,
        "render",
        "good.xml",
        "-o",
        "out.exr",
        "--grid",
        "1",
        words=["good.exr", "values"],
    )
    refuse(folder, capsys, "realtime", "good.xml", "-o", "out.exr", words=["good.exr", "values"])


def test_image_where_a_representation_is_wanted(folder, capsys):
    arguments = ["-o", "out.exr", "-D", "btf=image.exr"]
    refuse(folder, capsys, "realtime", "good.xml", *arguments, words=["image.exr"])
    refuse(folder, capsys, "render", "good.xml", "--grid", "1", *arguments, words=["image.exr"])


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("name", ["image.exr", "image.png"])
def test_damaged_image(damage, name, folder, capsys):
    damage(folder / name)
    refuse(folder, capsys, "compare", name, "image.exr", "--report", "out.html", words=[name])
    other = "image.png" if name == "image.exr" else "image.exr"
    refuse(folder, capsys, "compare", other, name, "--report", "out.html", words=[name])


def test_images_that_do_not_fit(folder, capsys):
    save_image(folder / "other.exr", np.ones((4, 5, 3)))
    refuse(folder, capsys, "compare", "image.exr", "other.exr", words=["4"])
    refuse(folder, capsys, "compare", "image.exr", "image.exr", "--gate", "no.such", words=["no.such"])
    refuse(folder, capsys, "compare", "image.exr", "image.exr", "--classes", "none.png", words=["none.png"])
    save_image(folder / "grey.png", np.full((4, 4, 3), 0.3))
    refuse(folder, capsys, "compare", "image.exr", "image.exr", "--classes", "grey.png", words=["grey.png"])
    refuse(folder, capsys, "compare", "image.exr", "image.exr", "--classes", "good.xml", words=["good.xml"])


def test_image_with_nan_fails_its_gate(folder, capsys):
    image = np.ones((4, 4, 3))
    image[1, 2, 0] = np.nan
    save_image(folder / "nan.exr", image)
    assert main(["compare", "nan.exr", "image.exr"]) == 1
    assert "FAIL  image.finite" in capsys.readouterr().out


def chunks(folder):
    """Files of a store that hold values."""
    store = folder / "good.btf.zarr"
    found = [path for path in (store / "values").rglob("*") if path.is_file() and path.name != "zarr.json"]
    assert found
    return found


@pytest.mark.parametrize("damage", [truncated, emptied, missing])
def test_damaged_store_values(damage, folder, capsys):
    for path in chunks(folder):
        damage(path)
    refuse(folder, capsys, "fit", "raw", "good.btf.zarr", "-o", "out.exr", words=["good.btf.zarr"])


@pytest.mark.parametrize("damage", [truncated, emptied, missing, wrong_magic])
@pytest.mark.parametrize("part", ["zarr.json", "values/zarr.json"])
def test_damaged_store_headers(damage, part, folder, capsys):
    damage(folder / "good.btf.zarr" / part)
    refuse(folder, capsys, "fit", "raw", "good.btf.zarr", "-o", "out.exr", words=["good.btf.zarr"])
    refuse(folder, capsys, "info", "good.btf.zarr", words=["good.btf.zarr"])


def test_store_with_nan(folder, capsys):
    grid = directions("2x4")
    values = np.full((8, 8, 2, 2, 3), 0.25, np.float32)
    values[1, 2, 0, 1, 0] = np.nan
    import zarr

    array = zarr.open_group(folder / "good.btf.zarr", mode="r+")["values"]
    array[:] = values
    line = refuse(folder, capsys, "fit", "raw", "good.btf.zarr", "-o", "out.exr", words=["good.btf.zarr"])
    assert "values" in line
    assert len(grid) == 8


@pytest.mark.parametrize("name", ["none.btf.zarr", "image.exr", "good.xml"])
def test_what_is_no_store(name, folder, capsys):
    refuse(folder, capsys, "fit", "raw", name, "-o", "out.exr", words=[name])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["fit", "nonsense", "good.btf.zarr", "-o", "out.exr"], ["nonsense", "lpca"]),
        (["fit", "raw", "good.btf.zarr", "-o", "none/out.exr"], ["none"]),
        (["fit", "raw", "good.btf.zarr", "-o", "out.txt"], ["out.txt", ".exr"]),
        (["fit", "lpca", "good.btf.zarr", "-o", "out.exr", "--set", "clusters=0"], ["clusters"]),
        (["fit", "lpca", "good.btf.zarr", "-o", "out.exr", "--set", "clusters=none"], ["clusters"]),
        (["fit", "svd", "good.btf.zarr", "-o", "out.exr", "--set", "nonsense=1"], ["nonsense"]),
        (["fit", "svd", "good.btf.zarr", "-o", "out.exr", "--set", "nonsense"], ["nonsense"]),
        (["fit", "svd", "good.btf.zarr", "-o", "out.exr", "--preset", "nonsense"], ["nonsense", "paper"]),
        (["synth", "checker", "-o", "new.btf.zarr", "--texels", "0"], ["texels"]),
        (["synth", "checker", "-o", "new.btf.zarr", "--spp", "1"], ["spp"]),
        (["synth", "checker", "-o", "new.btf.zarr", "--views", "ubo82"], ["ubo82"]),
        (["synth", "checker", "-o", "new.btf.zarr", "--lights", "none.txt"], ["none.txt"]),
        (["synth", "checker", "-o", "new.btf.zarr", "--set", "nonsense=1"], ["nonsense"]),
        (["synth", "checker", "-o", "new.btf.zarr", "--set", "amplitude=high"], ["amplitude"]),
        (["synth", "checker", "-o", "new.btf.zarr", "--set", "texels=3"], ["texels"]),
        (["synth", "nonsense", "-o", "new.btf.zarr"], ["nonsense", "checker"]),
        (["synth", "checker", "-o", "new.zip"], ["new.zip", ".btf.zarr"]),
        (["synth", "checker", "-o", "none/new.btf.zarr"], ["none"]),
        (["synth", "checker", "-o", "good.btf.zarr", "--texels", "2", "--spp", "2"], ["good.btf.zarr"]),
        (["render", "nonsense", "-o", "out.exr"], ["nonsense", "sphere"]),
        (["render", "good.xml", "-o", "out.jpg"], ["out.jpg"]),
        (["render", "good.xml", "-o", "out.exr", "--variant", "nonsense"], ["nonsense"]),
        (["realtime", "good.xml", "-o", "out.exr", "--order", "0"], ["--order"]),
        (["render", "good.xml", "-o", "out.exr", "--geometry", "--grid", "2"], ["--geometry"]),
        (["render", "good.xml", "-o", "out.exr", "-D", "nonsense=1"], ["nonsense"]),
        (["realtime", "good.xml", "-o", "out.exr", "-D", "nonsense=1"], ["nonsense"]),
        (["realtime", "good.xml", "-o", "out.exr", "-D", "nonsense"], ["nonsense"]),
        (
            ["realtime", "plane", "-o", "out.exr", "-D", "lights=foo"],
            ["foo", "lights", "directional1", "envmap"],
        ),
        (
            ["render", "plane", "-o", "out.exr", "-D", "light=points2"],
            ["light=points2", "btf, filter, height"],
        ),
        (["render", "plane", "-o", "out.exr", "-D", "environment=sky"], ["environment=sky", "lights=envmap"]),
        (["realtime", "plane", "-o", "out.exr", "-D", "lights=envmap"], ["environment", "studio"]),
        (
            [
                "realtime",
                "plane",
                "-o",
                "out.exr",
                "-D",
                "btf=good.exr",
                "-D",
                "lights=envmap",
                "-D",
                "environment=nowhere",
            ],
            ["nowhere", "studio"],
        ),
        (["info", "none.exr"], ["none.exr"]),
        (["info", "none.png"], ["none.png"]),
    ],
)
def test_bad_arguments(arguments, words, folder, capsys):
    refuse(folder, capsys, *arguments, words=words)


@pytest.mark.parametrize(
    "arguments",
    [
        ["render", "good.xml", "-o", "out.exr", "-D", "btf=good.btf.zarr"],
        ["realtime", "good.xml", "-o", "out.exr", "-D", "btf=good.btf.zarr"],
        ["demand", "good.xml", "-D", "btf=good.btf.zarr"],
        ["compare", "image.exr", "good.xml", "--method", "good.btf.zarr"],
        ["export", "good.btf.zarr", "-o", "new", "--format", "maps"],
    ],
    ids=lambda arguments: arguments[0],
)
def test_a_store_where_a_representation_is_wanted(arguments, folder, capsys):
    words = ["sampled BTF", "btfref fit raw", "good.btf.zarr -o good.raw.exr"]
    refuse(folder, capsys, *arguments, words=words)


@pytest.mark.parametrize("command", ["render", "realtime"])
@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ({"light": '<emitter type="nonsense"/>'}, ["nonsense"]),
        ({"light": ""}, ["scene.xml", "no light"]),
        ({"light": '<emitter type="sky"/>'}, ["sunsky with sun_scale 0"]),
        ({"sensor": ""}, ["sensor"]),
        (
            {"shape": SHAPE.replace("</bsdf>", '<float name="scall" value="2"/></bsdf>')},
            ["scall", "filter_type"],
        ),
        ({"shape": '<shape type="ply"><string name="filename" value="none.ply"/></shape>'}, ["none.ply"]),
        ({"shape": SHAPE.replace("$btf", "none.exr")}, ["none.exr"]),
        ({"shape": SHAPE.replace('name="filename"', 'name="file"')}, ["filename"]),
        ({"shape": SHAPE.replace("</bsdf>", '<string name="filter_type" value="cubic"/></bsdf>')}, ["cubic"]),
        ({"shape": "<shape"}, ["scene.xml"]),
    ],
)
def test_bad_scenes(command, parts, words, folder, capsys):
    parts = {"sensor": SENSOR, "shape": SHAPE, "light": LIGHT} | parts
    (folder / "scene.xml").write_text(SCENE.format(**parts))
    options = ["--grid", "1"] if command == "render" else []
    refuse(folder, capsys, command, "scene.xml", "-o", "out.exr", *options, words=words)


def test_a_light_that_real_time_lacks(folder, capsys):
    """The reference shows it."""
    light = '<emitter type="projector"/>'
    (folder / "scene.xml").write_text(SCENE.format(sensor=SENSOR, shape=SHAPE, light=light))
    refuse(folder, capsys, "realtime", "scene.xml", "-o", "out.exr", words=["projector"])


@pytest.mark.parametrize("content", [b"", b"\x00\xff", b"<scene>", b"no scene at all"])
def test_files_that_are_no_scene(content, folder, capsys):
    (folder / "scene.xml").write_bytes(content)
    refuse(folder, capsys, "render", "scene.xml", "-o", "out.exr", words=["scene.xml"])
    refuse(folder, capsys, "realtime", "scene.xml", "-o", "out.exr", words=["scene.xml"])


@pytest.mark.parametrize(("own", "word"), [('id="bare"', "bare"), ('name="elm__4"', "ply")])
def test_scene_without_texture_coordinates(own, word, folder, capsys):
    shape = SHAPE.replace('"rectangle">', f'"ply" {own}><string name="filename" value="mesh.ply"/>')
    (folder / "scene.xml").write_text(SCENE.format(sensor=SENSOR, shape=shape, light=LIGHT))
    words = ["scene.xml", word, "texture coordinates"]
    refuse(folder, capsys, "realtime", "scene.xml", "-o", "out.exr", words=words)
    refuse(folder, capsys, "render", "scene.xml", "-o", "out.exr", "--grid", "1", words=words)


@pytest.mark.parametrize("own", ['name="elm__4"', ""])
def test_a_mesh_without_texture_coordinates_beside_a_btf(own, folder, need):
    """Files that Blender writes give shapes names and no identifiers: what is one's BTF is none of the other's."""
    need("llvm")
    need("gl")
    bare = f'<shape type="ply" {own}><string name="filename" value="mesh.ply"/><bsdf type="diffuse"/></shape>'
    shape = bare + SHAPE.replace('"rectangle">', f'"rectangle" {own.replace("4", "6")}>')
    (folder / "scene.xml").write_text(SCENE.format(sensor=SENSOR, shape=shape, light=LIGHT))
    assert main(["render", "scene.xml", "-o", "reference.exr", "--grid", "1"]) == 0
    assert main(["realtime", "scene.xml", "-o", "picture.exr", "--grid", "1"]) == 0
    assert main(["compare", "picture.exr", "reference.exr"]) == 0


def test_the_good_material_is_good(folder):
    """What the cases above damage works when whole: otherwise their refusals would prove nothing."""
    assert main(["info", "good.exr"]) == 0
    assert main(["info", "good.btf.zarr"]) == 0
    assert main(["fit", "raw", "good.btf.zarr", "-o", "out.exr", "--overwrite"]) == 0
    assert main(["render", "good.xml", "-o", "out.exr", "--grid", "1", "--overwrite"]) == 0
    assert main(["realtime", "good.xml", "-o", "other.exr", "--grid", "1"]) == 0
    assert main(["compare", "other.exr", "out.exr", "--gate", "image.noise_free"]) == 0
