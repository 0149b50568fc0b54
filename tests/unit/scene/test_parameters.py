"""Parameters of scene files: what is refused, what is left to Mitsuba, what the shipped scenes say of themselves."""

import re

import pytest

from btfref.errors import InputError
from btfref.scene.environments import is_shipped
from btfref.scene.parameters import check_parameters
from btfref.scene.shipped import ENVIRONMENTS, described, lights, names, scene_file

SCENE = """<scene version="3.0.0">
  {defaults}
  <include filename="part_$part.xml"/>
  <integer name="width" value="$width"/>
</scene>"""


@pytest.fixture
def file(tmp_path):
    """A scene of a user's own with a part to choose, one of which has a parameter."""
    (tmp_path / "part_a.xml").write_text('<scene version="3.0.0"/>')
    (tmp_path / "part_b.xml").write_text('<scene version="3.0.0"><float name="x" value="$size"/></scene>')

    def write(defaults='<default name="part" value="a"/><default name="width" value="8"/>'):
        (tmp_path / "own.xml").write_text(SCENE.format(defaults=defaults))
        return tmp_path / "own.xml"

    return write


@pytest.mark.parametrize("scene", names())
def test_shipped_scenes_take_what_they_describe(scene):
    summary, parameters = described(scene)
    assert len(summary) > 20
    keys = {key for group in parameters for key in group.split(", ")}
    assert {"btf", "lights", "filter", "width", "height"} <= keys
    own = dict.fromkeys(keys - {"lights", "environment"}, "1")
    check_parameters(scene_file(scene), own)
    for chosen in lights():
        check_parameters(
            scene_file(scene),
            own | {"lights": chosen} | ({"environment": "sky"} if chosen == "envmap" else {}),
        )
    defaults = set(re.findall(r'<default name="(\w+)"', scene_file(scene).read_text("utf-8")))
    assert defaults - keys == set()


def test_names_of_environments_are_those_that_are_made():
    assert all(map(is_shipped, ENVIRONMENTS))


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"part": "c"}, ("no such part", "got c", "expected a, b")),
        ({"with": "9"}, ("no such parameter", "got with=9", "expected part, width")),
        ({"size": "9"}, ("no such parameter", "got size=9", "expected part, width")),
        ({"part": "b"}, ("needs a value", "'size'", "-D size=VALUE")),
    ],
)
def test_what_a_scene_does_not_have_is_refused(file, given, words):
    with pytest.raises(InputError) as error:
        check_parameters(file(), given)
    assert [word for word in words if word not in str(error.value)] == []


def test_what_it_has_is_taken(file):
    check_parameters(file(), {"part": "b", "size": "1", "width": "3"})
    check_parameters(file(""), {"part": "a", "width": "3"})


@pytest.mark.parametrize("content", ["<scene", "", '<scene version="3.0.0"><path value="x"/></scene>'])
def test_what_cannot_be_read_here_is_left_to_mitsuba(tmp_path, content):
    (tmp_path / "odd.xml").write_text(content)
    check_parameters(tmp_path / "odd.xml", {"anything": "1"})
