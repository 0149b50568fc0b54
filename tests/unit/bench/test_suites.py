"""What all suites have in common."""

from importlib import import_module

import pytest

from btfref.bench import SUITES
from btfref.bench.options import Options
from btfref.errors import InputError


@pytest.mark.parametrize("suite", SUITES)
def test_a_name_that_a_suite_does_not_know_is_refused_at_once(suite):
    with pytest.raises(InputError) as error:
        import_module(SUITES[suite]).run(Options(quick=True, only=["chess"]))
    assert error.value.field == "--only"
    assert "chess" in str(error.value)
