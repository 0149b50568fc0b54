"""The witness agrees with both renderers, for every method; that it can disagree is what the self-test shows."""

import pytest

from btfref.gates import tolerance
from btfref.registry import methods
from btfref.validate.witness import gates as witness
from btfref.validate.witness.scene import SIZE

pytestmark = pytest.mark.usefixtures("renderers")


@pytest.mark.long
@pytest.mark.parametrize("key", methods())
def test_both_renderers_are_as_the_witness_says(fits, key):
    found = witness.testify(fits.path(key))
    gates = found.gates()
    assert {gate.detail for gate in gates} == {"Mitsuba", "OpenGL"}
    assert [gate.line for gate in gates if not gate.passed] == []
    assert len(found.expected) / SIZE**2 > tolerance("rendered.subject.min_covered_full")
    assert (found.expected.max(-1) > 0).mean() > tolerance("rendered.subject.min_lit")
