"""The synthesis benchmark: its error measures and its table, without timing anything."""

import numpy as np

from btfref.bench import synth


def test_errors_take_the_references_noise_off():
    rng = np.random.default_rng(0)
    truth = rng.uniform(0.5, 1.5, (4, 32, 32, 3))
    variance = np.full(truth.shape, 0.01**2)
    data = {"mean": truth + rng.normal(0, 0.01, truth.shape), "variance": variance}
    found = synth._errors(truth + rng.normal(0, 0.05, truth.shape), data)
    assert abs(found["rmse"] / 0.05 - 1) < 0.05
    assert found["trimmed"] < np.hypot(0.05, 0.01)
    assert found["z"] < 4
    assert synth._errors(1.05 * truth, data)["z"] > 10


def test_pairs_are_the_same_in_every_run():
    first, second = synth.pairs(81, 81), synth.pairs(81, 81)
    assert np.array_equal(first, second)
    assert len(np.unique(first, axis=0)) == synth.PAIRS
    assert first.max() < 81


def test_the_table_gives_ratios_to_the_naive_loop():
    errors = [{"rmse": 0.1, "trimmed": 0.05, "mae": 0.02, "z": 1.0, "bias": 0.0}] * 3
    labels = ("naive 16", "surface 16")
    result = {
        "raw": {"checker": {"naive 16": [100.0, 90.0, 110.0], "surface 16": [5.0, 4.0, 5.5]}},
        "errors": {"checker": dict.fromkeys(labels, errors)},
        "peak_bytes": {"checker": dict.fromkeys(labels, 2**30)},
        "kernel_s": {"checker": {"naive 16": [80.0, 70.0, 90.0]}},
        "growth": [],
    }
    header, rows = synth.table(result)
    assert [row[header.index("× naive 16")] for row in rows] == ["1.0", "20.0"]
    assert [row[header.index("× its kernels")] for row in rows] == ["0.8", "16.0"]
    assert rows[1][header.index("MiB")] == "1024"
