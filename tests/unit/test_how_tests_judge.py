"""Tests judge by limits that have a reason: no literal tolerance, no clock, no requirement past BTFREF_REQUIRE."""

import ast
from pathlib import Path

import pytest

TESTS = Path(__file__).parents[1]
FILES = sorted(path for path in TESTS.rglob("*.py") if path != Path(__file__))

#: Calls that take tolerances → how many of their arguments are none.
COMPARING = {"approx": 1, "allclose": 2, "isclose": 2, "assert_allclose": 2}
#: Of the wall; processor time, which the fuzzer reports, does not pass faster on a busy machine.
CLOCKS = {"perf_counter", "perf_counter_ns", "monotonic", "monotonic_ns", "time", "time_ns"}


def _value(node, constants):
    """The number that an expression of nothing but numbers has, None for any other."""
    if isinstance(node, ast.Name):
        return constants.get(node.id)
    if isinstance(node, ast.Constant):
        number = isinstance(node.value, (int, float)) and not isinstance(node.value, bool)
        return node.value if number else None
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        value = _value(node.operand, constants)
        return None if value is None else -value
    if isinstance(node, ast.BinOp):
        left, right = (_value(side, constants) for side in (node.left, node.right))
        if None not in (left, right):
            numbers = ast.BinOp(ast.Constant(left), node.op, ast.Constant(right))
            return eval(compile(ast.fix_missing_locations(ast.Expression(numbers)), "", "eval"))
    return None


def _fractions(node, constants):
    """Numbers with a fraction in the arithmetic of an expression; what is passed to calls is not part of it."""
    value = _value(node, constants)
    if value is not None:
        return [] if float(value).is_integer() else [value]
    if isinstance(node, ast.BinOp):
        return _fractions(node.left, constants) + _fractions(node.right, constants)
    return _fractions(node.operand, constants) if isinstance(node, ast.UnaryOp) else []


def _name(call):
    return getattr(call.func, "attr", getattr(call.func, "id", ""))


def literal_limits(source):
    """Lines in which a test decides by a number written there.

    That is: a fraction on either side of < ≤ > ≥ in an assert, a tolerance other than 0 of a comparison, and a
    comparison to a number of decimals. Numbers that are given to what is tested are none, nor are the libraries' own
    defaults.

    Parameters
    ----------
    source : str

    Returns
    -------
    list of int
        Sorted.
    """
    tree, found = ast.parse(source), set()
    constants = {
        target.id: value
        for node in tree.body
        if isinstance(node, ast.Assign) and (value := _value(node.value, {})) is not None
        for target in node.targets
        if isinstance(target, ast.Name)
    }
    order = (ast.Lt, ast.LtE, ast.Gt, ast.GtE)
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            name = _name(node)
            if name.endswith("almost_equal"):
                found.add(node.lineno)
            given = node.args[COMPARING[name] :] if name in COMPARING else []
            given += [k.value for k in node.keywords if k.arg in ("rtol", "atol")]
            given += [k.value for k in node.keywords if k.arg in ("rel", "abs") and name == "approx"]
            found |= {v.lineno for v in given if _value(v, constants) or _fractions(v, constants)}
        elif isinstance(node, ast.Assert):
            for part in ast.walk(node):
                if isinstance(part, ast.Compare) and any(isinstance(op, order) for op in part.ops):
                    sides = [part.left, *part.comparators]
                    found |= {side.lineno for side in sides if _fractions(side, constants)}
    return sorted(found)


def calls_of(source, wanted):
    """Lines that call, or import, one of the wanted names of a module."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            if (getattr(node.func.value, "id", None), node.func.attr) in wanted:
                found.add(node.lineno)
        elif isinstance(node, ast.ImportFrom):
            found |= {node.lineno for alias in node.names if (node.module, alias.name) in wanted}
    return sorted(found)


def everywhere(finder):
    assert len(FILES) > 80
    return [f"{path.relative_to(TESTS)}:{line}" for path in FILES for line in finder(path.read_text("utf-8"))]


def test_no_limit_is_a_literal():
    assert everywhere(literal_limits) == []


def test_no_test_reads_a_clock():
    """A busy machine fails no test: what is fast is counted (imports, kernels, calls) or a benchmark's."""
    assert everywhere(lambda source: calls_of(source, {("time", name) for name in CLOCKS})) == []


def test_what_is_missing_goes_through_need():
    """`pytest.importorskip` skips where BTFREF_REQUIRE says that there is nothing to skip."""
    assert everywhere(lambda source: calls_of(source, {("pytest", "importorskip")})) == []


@pytest.mark.parametrize(
    "line",
    [
        "assert error < 1e-3",
        "assert 0.1 < share.mean() < 1",
        "assert (abs(a - b) <= 1e-6 * b.max()).all()",
        "assert a >= b * (1 - 1e-6)",
        "assert all(x <= 0.5 for x in a)",
        "assert x < -2e-5",
        "assert x < 1 / 255",
        "LIMIT = 1e-3\nassert x < 2 * LIMIT",
        "np.testing.assert_allclose(a, b, rtol=1e-5)",
        "np.testing.assert_allclose(a, b, 1e-5)",
        "np.testing.assert_allclose(a, b, atol=1e-6 * b.max())",
        "np.testing.assert_allclose(a, b, rtol=2**-6)",
        "assert a == pytest.approx(1, abs=1)",
        "assert a == approx(1, 1e-3)",
        "np.testing.assert_array_almost_equal(a, b)",
    ],
)
def test_a_literal_limit_is_found(line):
    assert literal_limits(f"import numpy as np\n{line}") == [2 + line.count("\n")]


@pytest.mark.parametrize(
    "line",
    [
        "assert error <= tolerance('fit.stated.max')",
        "assert error <= target * (1 + tolerance('fit.stated.max'))",
        "assert np.quantile(error, 0.99) < tolerance('fit.stated.max')",
        "assert f(0.5) == 0.25",
        "assert n > 3",
        "assert 9 * size <= 1e6 * tolerance('fit.stated.max')",
        "np.testing.assert_allclose(a, 0.5, rtol=0, atol=tolerance('fit.stated.max'))",
        "np.testing.assert_allclose(a, b, atol=n**2 * EXACT)",
        "assert a == pytest.approx(0.5)",
    ],
)
def test_what_is_no_limit_is_let_through(line):
    assert literal_limits(line) == []


@pytest.mark.parametrize("line", ["start = time.perf_counter()", "from time import perf_counter"])
def test_a_clock_is_found(line):
    assert calls_of(line, {("time", "perf_counter")}) == [1]
