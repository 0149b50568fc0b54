"""The GLSL ports: they compile for both targets, and agree with the float64 definition point by point."""

import re
import subprocess
from collections import Counter

import numpy as np
import pytest
from probes import probe_points

from btfref.registry import methods
from btfref.rendering.gl import composer, device
from btfref.rendering.gl.probe import probe
from btfref.stress.judging import port_agreement

#: Sets of directions: test_evaluators.py has the others.
SETS = ("shifted", "capped")

N_POINTS = 10_000


@pytest.mark.parametrize("kind", SETS)
@pytest.mark.parametrize("key", methods())
def test_probe_agrees_with_the_definition(need, rng, fits, key, kind):
    need("gl")
    rep = fits(key, kind)
    points = probe_points(rng, N_POINTS, rep)
    for result in port_agreement(probe(rep, *points), rep, points).gates:
        assert result.passed, result.line


@pytest.mark.parametrize("key", methods())
@pytest.mark.parametrize("kind", ["ubo81", "scattered"])
def test_below_the_horizon_is_exactly_zero(need, fits, key, kind):
    need("gl")
    up, down, level = [0.6, 0, 0.8], [0.6, 0, -0.8], [1, 0, 0]
    bad = [down, level, [np.nan, 0, 1], [0, 0, np.inf], [0, 0, 3], [0, 0, 0]]
    w_light = np.array([*bad, *[up] * len(bad), up])
    w_view = np.array([*[up] * len(bad), *bad, up])
    values = probe(fits(key, kind), [0.3, 0.4], w_light, w_view)
    assert (values[:-1] == 0).all()
    assert (values[-1] != 0).all()


@pytest.mark.parametrize("key", methods())
def test_coordinates_that_are_not_finite_count_as_zero(need, fits, key):
    need("gl")
    rep = fits(key)
    up = [0, 0, 1]
    values = probe(rep, [[np.nan, 0.5], [np.inf, 0.5], [0, 0.5]], up, up)
    assert (values == values[2]).all()
    assert np.isfinite(values).all()


def test_a_lost_piece_fails_the_probe(need, rng, fits, tmp_path, monkeypatch):
    """The gate can fail: Mesa's own atan, which is good to 1e-5, is already too coarse."""
    need("gl")
    from btfref.platform import shader_directory

    text = (shader_directory() / "lib/lookup/angles.glsl").read_text()
    coarse = text.replace("return x + x * z * p;", "return atan(x) + 3e-6 * x;")
    assert coarse != text
    (tmp_path / "lib/lookup").mkdir(parents=True)
    (tmp_path / "lib/lookup/angles.glsl").write_text(coarse)
    rep = fits("raw")
    shader, _ = device.shader_file(rep)
    monkeypatch.setattr(device, "shader_file", lambda rep: (shader, [tmp_path]))
    points = probe_points(rng, N_POINTS, rep)
    assert not port_agreement(probe(rep, *points), rep, points).passed


STAGES = [
    ("hosts/probe.vert", "hosts/probe.frag"),
    ("hosts/mesh.vert", "hosts/mesh.frag"),
    ("hosts/mesh.vert", "hosts/seen.frag"),
    ("hosts/screen.vert", "hosts/depth.frag"),
    ("hosts/shadow.vert", "hosts/shadow.frag"),
]

#: The same on spheres, disks and cylinders.
ON_QUADRICS = [("hosts/quadric.vert", f"hosts/{name}.frag") for name in ("mesh", "seen", "depth")]


def compiled(source):
    """The text without definitions that it does not use: many hosts read nothing of a representation."""
    text = str(source)
    words = Counter(re.findall(r"\w+", text))
    return re.sub(r"(?m)^#define (\w+).*\n", lambda line: line[0] if words[line[1]] > 1 else "", text)


@pytest.fixture(scope="module")
def accepted():
    """Programs that were accepted: the same text needs no other look."""
    return set()


@pytest.mark.parametrize("target", composer.TARGETS)
@pytest.mark.parametrize("kind", ["ubo81", "scattered"])
@pytest.mark.parametrize("key", methods())
def test_glslang_accepts_every_representation_in_every_host(
    need, fits, tmp_path, accepted, key, kind, target
):
    validator = need("glslang")
    rep = fits(key, kind)
    shader, directories = device.shader_file(rep)
    # The filter of texels and the shape know nothing of the directions' stencils: one set stands for both there.
    filters, pairs = ("bilinear", "nearest"), [*STAGES, *ON_QUADRICS]
    if kind == "scattered":
        filters, pairs = filters[:1], STAGES
    for filter_type in filters:
        defines = {**device.shader_defines(rep, filter_type=filter_type), "N_LIGHTS": 3}
        for pair in pairs:
            more = {"QUADRIC": 1} if pair in ON_QUADRICS else {}
            files, sources = [], []
            for name in pair:
                source = composer.compose(
                    name, defines | more, representation=shader, directories=directories, target=target
                )
                path = tmp_path / name.replace("/", "_")
                path.write_text(source, encoding="utf-8")
                files.append(str(path))
                sources.append(source)
            program = (*pair, *map(compiled, sources))
            if program in accepted:
                continue
            # -l links the stages: their interfaces must match too.
            done = subprocess.run([validator, "-l", *files], capture_output=True, text=True, check=False)
            assert done.returncode == 0, "\n".join(source.explain(done.stdout) for source in sources)
            accepted.add(program)


def test_glslang_refuses_a_broken_shader(need, tmp_path):
    validator = need("glslang")
    path = tmp_path / "broken.frag"
    path.write_text(composer.compose("hosts/probe.frag") + "oops\n")
    assert subprocess.run([validator, str(path)], capture_output=True, check=False).returncode != 0
    # What the tests above take for the same program: all but what no line uses.
    text = "#version 330 core\n#define ROWS 4\n#define COLUMNS 3\nint rows = ROWS;\n"
    assert compiled(text) == text.replace("#define COLUMNS 3\n", "")
