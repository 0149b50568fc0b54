"""Powers of lobes under any stored parameters: finite in every type, and equal to the definition within a bound."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from btfref.gates.tolerances import tolerance
from btfref.numerics import powers

#: 100 examples of 1000 parameter sets.
EXAMPLES, SETS = 100, 1000

SMALLEST = {np.float16: 2.0**-24, np.float32: 2.0**-126, np.float64: 2.0**-126}


def parameter_sets(seed, kind, n=SETS):
    """Axes, lights and exponents: ordinary, huge (‖t‖ = 10³, n = 10⁴), tiny, subnormal and signed, in ``kind``."""
    rng = np.random.default_rng(seed)
    length = np.choose(
        rng.integers(0, 5, n),
        [
            rng.uniform(0, 2, n),
            np.full(n, 1e3),
            10 ** rng.uniform(-8, 4, n),
            10 ** rng.uniform(-45, -7, n),
            np.ones(n),
        ],
    )
    t = unit(rng.normal(size=(n, 3))) * length[:, None]
    t[rng.integers(0, 4, n) == 0, 0] = np.float32(1e-41)
    light = unit(rng.normal(size=(n, 3)))
    along = rng.integers(0, 3, n) == 0
    light[along] = unit(
        t[along] + 1e-3 * np.maximum(length[along, None], 1e-30) * rng.normal(size=(along.sum(), 3))
    )
    exponent = np.choose(
        rng.integers(0, 5, n),
        [
            rng.uniform(1, 100, n),
            np.full(n, 1e4),
            10 ** rng.uniform(-7, 4.8, n),
            np.zeros(n),
            10 ** rng.uniform(-44, -7, n),
        ],
    )
    return t.astype(kind), light.astype(kind), exponent.astype(kind)


def unit(w):
    return w / np.maximum(np.linalg.norm(w, axis=-1, keepdims=True), 1e-300)


def interval(t, light, n, kind):
    """Where a computation with the roundoff of ``kind`` may fall: the definition at a cosine that is off by its
    rounding, its logarithm off by some roundoffs of itself.
    """
    t, light, n = (np.asarray(a, float) for a in (t, light, n))
    roundoff = tolerance("powers.stress.roundoffs") * np.finfo(kind).eps / 2
    scale = np.abs(t).max(-1)
    counts = scale >= powers.FLOOR
    scale = np.where(counts, scale, 1)
    terms = t / scale[:, None] * light
    cosine, slack = terms.sum(-1), roundoff * np.abs(terms).sum(-1) + 4 * SMALLEST[kind]
    ends = []
    for sign in (-1, 1):
        c = cosine + sign * slack
        some = counts & (c >= powers.FLOOR)
        log_scale, log = np.log2(scale), np.log2(np.where(some, c, 1))
        log = n * (log_scale + log + sign * roundoff * (np.abs(log_scale) + np.abs(log) + 1e-9))
        value = np.exp2(np.clip(log, -1000, powers.LIMIT_LOG2)) * (1 + sign * roundoff)
        ends.append(np.where(some, value, 0))
    low, high = ends
    return np.where(low > SMALLEST[kind], low - SMALLEST[kind], 0), high + SMALLEST[kind]


def assert_within(value, t, light, n, kind):
    low, high = interval(t, light, n, kind)
    value = np.asarray(value, float)
    assert np.isfinite(value).all()
    assert (value >= low).all(), (value - low).min()
    assert (value <= high).all(), (value - high).max()


@pytest.mark.parametrize("kind", [np.float16, np.float32, np.float64])
@given(seed=st.integers(0, 2**63 - 1))
@settings(max_examples=EXAMPLES, derandomize=True, deadline=None, database=None)
def test_definition_in_every_type(kind, seed):
    t, light, n = parameter_sets(seed, kind)
    value = powers.lobe_power(t, light, n)
    assert value.dtype == kind
    assert_within(value, t, light, n, kind)
    product = np.einsum("ij,ij->i", t.astype(float) / 1e3, light.astype(float)).astype(kind)
    assert np.isfinite(powers.safe_power(product, n)).all()


@pytest.fixture(scope="module", params=[np.float16, np.float32], ids=["stored as half", "stored as float"])
def many(request):
    """All the examples at once, stored in halves or floats and widened to the float32 that ports compute in."""
    sets = [parameter_sets(seed, request.param) for seed in range(EXAMPLES)]
    return tuple(np.concatenate(part).astype(np.float32) for part in zip(*sets, strict=True))


def test_drjit(many, llvm):
    from mitsuba_plugins.lib.analytic import lobe_power

    t, light, n = many
    value = np.array(lobe_power(llvm.Vector3f(t.T), llvm.Vector3f(light.T), llvm.Float(n)))
    assert_within(value, t, light, n, np.float32)
    assert np.isfinite(value.astype(np.float16)).all()


VERTEX = """// Provides lobe powers of vertex attributes.
// Expects nothing.
#include "lib/numbers/powers.glsl"
in vec3 t;
in vec3 l;
in float n;
out vec3 value;
void main() {
    float base = dot(t, l);
    value = vec3(lobe_power(t, l, n), safe_power(base, n), unit_lobe(normalize(t + vec3(0.0, 0.0, 1e-3)), l, n));
    gl_Position = vec4(0.0, 0.0, 0.0, 1.0);
}
"""


def test_glsl(many, need, tmp_path):
    need("gl")
    from btfref.rendering.gl import composer, device

    (tmp_path / "powers.vert").write_text(VERTEX)
    source = composer.compose("powers.vert", directories=[tmp_path])
    ctx = device.context()
    target = ctx.simple_framebuffer((1, 1))
    target.use()
    program = ctx.program(vertex_shader=source, varyings=("value",))
    t, light, n = many
    forms = {"t": (t, "3f"), "l": (light, "3f"), "n": (n, "1f")}
    buffers = [
        (ctx.buffer(np.ascontiguousarray(a).tobytes()), form, name) for name, (a, form) in forms.items()
    ]
    result = ctx.buffer(reserve=12 * len(n))
    vertices = ctx.vertex_array(program, buffers)
    vertices.transform(result, mode=ctx.POINTS, vertices=len(n))
    value = np.frombuffer(result.read(), np.float32).reshape(-1, 3).copy()
    for thing in (*(b for b, _, _ in buffers), vertices, result, program, target):
        thing.release()
    assert_within(value[:, 0], t, light, n, np.float32)
    assert np.isfinite(value).all()
    assert (value[:, 2] <= 1 + tolerance("powers.unit.max")).all()


def test_the_paper_s_form_overflows():
    """The test above can fail: the power as eq. 1 has it is infinite for the same parameters."""
    t, light, n = parameter_sets(0, np.float32)
    with np.errstate(all="ignore"):
        plain = np.maximum((t * light).sum(-1), 0) ** n
    assert not np.isfinite(plain).all()


@pytest.mark.parametrize("kind", [np.float16, np.float32, np.float64])
def test_negative_and_zero_bases_give_zero(kind):
    base = np.array([-1e3, -1.0, -1e-7, -0.0, 0.0], kind)
    for n in (0.0, 0.5, 1.0, 3.0, 1e4):
        np.testing.assert_array_equal(powers.safe_power(base, kind(n)), 0)
    assert powers.unit_lobe([0.0, 0.0, 1.0], [0.6, 0.0, -0.8], 3.0) == 0


def test_near_the_axis_nothing_is_lost(rng):
    """The power of unit vectors agrees with the textbook form where that is well conditioned, and keeps its digits."""
    axis, light = (unit(rng.normal(size=(1000, 3))) for _ in range(2))
    plain = np.maximum((axis * light).sum(-1), 0) ** 3
    np.testing.assert_allclose(
        powers.unit_lobe(axis, light, 3.0), plain, atol=tolerance("metric.closed_form.atol")
    )
    angle = 1e-6
    exact = np.cos(angle) ** 1e4
    value = powers.unit_lobe([0, 0, 1], [np.sin(angle), 0, np.cos(angle)], 1e4)
    np.testing.assert_allclose(value, exact, rtol=tolerance("metric.closed_form.rtol"))
