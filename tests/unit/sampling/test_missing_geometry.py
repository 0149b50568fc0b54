"""Geometry of a user that is missing, or shows its back: refused with where and how much."""

import numpy as np
import pytest
from user_files import grid, write_obj

from btfref.errors import InputError
from btfref.gates.tolerances import tolerance
from btfref.mesostructure import Mesostructure, Part, build

PLAIN = '<bsdf version="3.0.0" type="{}"/>'


def _bare(folder, lines, name="bare.obj"):
    (folder / name).write_text("\n".join(lines) + "\n")
    return folder / name


def _material(folder, text='<bsdf version="3.0.0" type="diffuse"/>'):
    (folder / "plain.xml").write_text(text)
    return {"bsdf": str(folder / "plain.xml")}


def _corners(low, high):
    return [f"v {x} {y} 0" for x, y in ((low, 0), (high, 0), (high, 1), (low, 1))]


def test_faces_that_lie_on_each_other_do_not_close_a_tile(tmp_path):
    file = _bare(tmp_path, [*_corners(0.25, 1), "f 1 2 3 4", "f 4 3 2 1"])
    with pytest.raises(
        InputError, match=r"no surface over a part of the tile.*0\.25 of its area.*x = 0 … 0\.25"
    ) as error:
        build(file, **_material(tmp_path))
    assert "faces lie over each other, in all 1.5 tiles" in str(error.value)
    assert "\n" not in str(error.value)
    assert build(file, allow_seams=True, **_material(tmp_path)).parts
    walls = _bare(
        tmp_path,
        ["v 0.5 0 0", "v 0.5 1 0", "v 0.5 1 -1", "v 0.5 0 -1", "v 1.5 0 0", "f 1 2 3 4", "f 1 4 3 2"],
    )
    with pytest.raises(InputError, match=r"1 of its area empty|do not fit the unit tile"):
        build(walls, **_material(tmp_path))


def test_closed_geometry_between_gaps_and_across_the_border_is_measured(tmp_path):
    from btfref.mesostructure.coverage import topmost

    vertices, faces = grid(8, lambda x, y: 0.1 * np.sin(2 * np.pi * x))
    for move in ([0, 0, 0], [0.37, -0.61, 0]):
        face, z = topmost(vertices + move, faces)
        assert (face >= 0).all()
        # Heights of the facets at the places, which stand at equal steps.
        x = (np.arange(64) + 0.4871) / 64 - move[0]
        exact = np.interp(x, np.arange(9) / 8, 0.1 * np.sin(np.pi / 4 * np.arange(9)), period=1)
        assert np.abs(z - exact).max() <= tolerance("mesostructure.units")
    face, _ = topmost(vertices, faces[vertices[faces][:, :, 0].max(1) <= 0.5])
    assert (face[:, :32] >= 0).all()
    assert (face[:, 32:] < 0).all()


def test_indices_that_count_back_are_read_where_they_stand(tmp_path):
    """Between the vertices that they count: a reader that waits for the end of the file reads one face twice."""
    face = "f -4/-4 -3/-3 -2/-2 -1/-1"
    uv = ["vt 0 0", "vt 1 0", "vt 1 1", "vt 0 1"]
    lines = [*_corners(0, 0.5), *uv, face, *_corners(0.5, 1), *[t.replace("1", "0.5") for t in uv], face]
    (part,) = build(_bare(tmp_path, lines), **_material(tmp_path)).parts
    middles = part.vertices[part.faces].mean(1)
    right = middles[:, 0] > 0.5
    assert sorted(right.tolist()) == [False, False, True, True]
    assert part.uv[part.faces][right][..., 0].max() == 0.5
    with pytest.raises(InputError, match="'line 5'; got -9; expected at least -4"):
        build(_bare(tmp_path, [*_corners(0, 1), "f -9 -3 -2"]), **_material(tmp_path))


@pytest.mark.parametrize("estimator", ["path", "surface"])
def test_faces_without_area_are_no_obstacle(tmp_path, llvm, estimator):
    import btfref

    file = _bare(tmp_path, [*_corners(0, 1), "v 0.5 0.5 0", "f 1 2 3 4", "f 1 1 2", "f 1 5 3"])
    settings = {
        "texels": 2,
        "views": "1x3",
        "lights": "1x3",
        "spp": 8,
        "estimator": estimator,
        "dtype": "float32",
    }
    values = btfref.synthesize(file, **_material(tmp_path), **settings).values
    whole = btfref.synthesize("flat", **settings).values
    assert np.abs(values - whole).max() / whole.max() <= tolerance("synthesis.flat_eval")
    # Nor where a caller hands such faces over as they are.
    part = build("flat").parts[0]
    flat = Mesostructure("own", {}, (Part(part.vertices, np.vstack([part.faces, [[0, 0, 1]]]), part.bsdf),))
    values = btfref.synthesize(flat, **settings).values
    assert np.abs(values - whole).max() / whole.max() <= tolerance("synthesis.flat_eval")


def test_a_surface_wound_downwards_is_refused_where_it_would_be_black(tmp_path):
    down = _bare(tmp_path, [*_corners(0, 1), "f 4 3 2 1"])
    for text in (PLAIN.format("diffuse"), PLAIN.format("roughconductor")):
        with pytest.raises(InputError, match=r"wound downwards.*1 of the surface.*twosided") as error:
            build(down, **_material(tmp_path, text))
        assert "\n" not in str(error.value)
    both = '<bsdf version="3.0.0" type="twosided"><bsdf type="diffuse"/></bsdf>'
    for text in (both, PLAIN.format("roughdielectric")):
        assert build(down, **_material(tmp_path, text)).parts
    assert build(_bare(tmp_path, [*_corners(0, 1), "f 1 2 3 4"]), **_material(tmp_path)).parts
    # Shading normals that point up turn the face.
    normals = [*_corners(0, 1), "vn 0 0 1", "f 4//1 3//1 2//1 1//1"]
    assert build(_bare(tmp_path, normals), **_material(tmp_path)).parts


def test_a_wavefront_material_that_emits_is_refused_and_maps_that_are_not_read_are_named(tmp_path):
    file = write_obj(tmp_path)
    text = (tmp_path / "m.mtl").read_text()
    (tmp_path / "m.mtl").write_text(text + "map_Bump t.png\nd 0.5\n")
    assert build(file).ignored == (
        "bump map of a Wavefront material (a)",
        "opacity (d, Tr) of a Wavefront material (a)",
    )
    (tmp_path / "m.mtl").write_text(text + "Ke 1 1 1\n")
    with pytest.raises(InputError, match=r"emits light.*a: Ke"):
        build(file)
    (tmp_path / "m.mtl").write_text(text)
    file.write_text(file.read_text().replace("/1", "").replace("/2", "").replace("/3", "").replace("/4", ""))
    with pytest.raises(InputError, match="texture on faces without texture coordinates"):
        build(file)
