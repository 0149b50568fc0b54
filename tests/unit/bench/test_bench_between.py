"""The suite that measures methods between their samples."""

import numpy as np
import pytest
from oracle import oracle_btf

from btfref.bench.experiments import between
from btfref.bench.options import Options
from btfref.errors import InputError
from btfref.gates.tolerances import tolerance
from btfref.registry import methods


def test_true_values_are_met_in_the_order_of_their_pairs():
    """The samples themselves as true values: raw returns them, and a method's errors are set against its own."""
    btf = oracle_btf((3, 2), "10x5", "ubo81")
    value = between.at_pairs(methods()["raw"].fit(btf), btf)
    np.testing.assert_allclose(value, btf.values, atol=tolerance("interpolation.float32.max"))
    found = between._against_truth(3 * value, 2 * value, value)
    np.testing.assert_allclose(list(found.values()), [2, 3, 2])


def test_a_btf_of_a_user_has_no_true_values():
    btf = oracle_btf((2, 2), "10x5", "10x5")
    result = between.run(Options(btf=btf, only=("raw", "svd")))
    (found,) = result["summary"].values()
    assert list(found) == ["raw", "svd"]
    assert "rms_truth" not in found["svd"]
    header, rows = between.table(result)
    assert all(len(row) == len(header) for row in rows)
    with pytest.raises(InputError, match="nothing of that name"):
        between.run(Options(btf=btf, only=("svd", "velvet")))
