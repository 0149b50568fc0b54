"""The synthesis benchmark: its error measures, what it makes of them, and its processes, without timing anything."""

import numpy as np
import pytest
from PIL import Image

from btfref.bench import synth, synth_methods
from btfref.cli import main
from btfref.gates import tolerance
from btfref.report.growth_plot import plot_growth


def test_errors_take_the_references_noise_off():
    rng = np.random.default_rng(0)
    truth = rng.uniform(0.5, 1.5, (4, 32, 32, 3))
    reference, variance = truth + rng.normal(0, 0.01, truth.shape), np.full(truth.shape, 0.01**2)
    found = synth_methods.errors(truth + rng.normal(0, 0.05, truth.shape), reference, variance)
    assert abs(found["rmse"] / 0.05 - 1) <= tolerance("bench.errors.relative")
    assert found["trimmed"] < np.hypot(0.05, 0.01)


def _means(rng, n, *, factor=1.0):
    """Means of images most of whose noise is in few texels: one in ten runs has a firefly."""
    fireflies = rng.binomial(3, 0.1, (n, synth.PAIRS)) - 0.3
    return (
        factor
        * np.linspace(0.5, 1, synth.PAIRS)
        * (1 + 1e-3 * (fireflies + rng.normal(size=fireflies.shape)))
    )


def test_the_z_of_means_keeps_its_level_and_sees_a_bias():
    rng = np.random.default_rng(1)
    found = [synth.bias(_means(rng, 12), _means(rng, 16)) for _ in range(200)]
    above = np.mean([row["z"] > row["limit"] for row in found])
    assert above <= tolerance("bench.z.rejected")  # 1 % is meant
    # Intervals of 95 % hold the truth: 190 of 200 do, give or take 3.
    assert np.mean([abs(row["bias"]) <= row["half_width"] for row in found]) > tolerance("bench.z.min_held")
    seen = np.median([np.median(row["seen"]) for row in found])
    error = 1e-3 * np.sqrt((1 + 0.27) * (1 / 12 + 1 / 16))
    assert seen < tolerance("bench.z.seen") * error
    # What is said to be seen is seen: half of the pairs of that bias are above the limit, one of twelve surely.
    wrong = [synth.bias(_means(rng, 12, factor=1 + seen), _means(rng, 16)) for _ in range(50)]
    assert np.mean([row["z"] > row["limit"] for row in wrong]) > tolerance("bench.z.min_found")


def test_limit_of_z():
    assert synth.z_limit(0.05, 1) == pytest.approx(1.96, abs=tolerance("bench.z_limit.quantile"))
    draws = np.abs(np.random.default_rng(2).normal(size=(100_000, synth.PAIRS))).max(1)
    assert np.mean(draws > synth.z_limit()) == pytest.approx(
        synth.SIGNIFICANCE, rel=tolerance("bench.z_limit.share")
    )


def test_pairs_are_the_same_in_every_run():
    first, second = synth_methods.pairs(81, 81), synth_methods.pairs(81, 81)
    assert np.array_equal(first, second)
    assert len(np.unique(first, axis=0)) == synth.PAIRS
    assert first.max() < 81


def _result():
    """A result in which the classes' times and errors differ."""
    rng = np.random.default_rng(3)
    labels = synth.methods("checker")
    time = {"naive": 100.0, "path": 20.0, "surface": 4.0}
    raw = {label: [time[task] * (1 + 3 * level) * f for f in (1.0, 0.9, 1.2)]
           for label, (task, _, level) in labels.items()}  # fmt: skip
    raw["surface 10"] = [5.0, 4.0, 5.5]
    error = {label: 0.1 / (1 + level) for label, (_, _, level) in labels.items()}
    error["surface 28"] = 0.06
    errors = {label: [dict.fromkeys(("rmse", "trimmed", "mae"), e)] * 3 for label, e in error.items()}
    result = {
        "parameters": {"z_limit": synth.z_limit()},
        "raw": {"checker": raw},
        "errors": {"checker": errors},
        "means": {"checker": {label: _means(rng, 8).tolist() for label in labels}},
        "reference": {"checker": _means(rng, 16).tolist()},
        "peak_bytes": {"checker": dict.fromkeys(labels, 2**30)},
        "kernel_s": {"checker": {f"naive {n}": [0.8 * s for s in raw[f"naive {n}"]] for n in synth.SAMPLES}},
        "floor_s": {"checker": {"surface 10": [2.0, 2.0, 2.0], "surface 28": [4.0, 4.0, 8.0]}},
        "growth": [
            synth.BASE | {"varied": "texels", "seconds": 3.0, "peak_bytes": 2**31, "n_directions": 81}
        ],
    }
    return result | {"summary": synth.summary(result)}


def test_ratios_are_those_of_the_class_of_equal_error():
    rows = {row["method"]: row for row in _result()["summary"]}
    assert rows["surface 10"]["naive"] == pytest.approx([120 / 5.5, 100 / 5, 90 / 4])
    assert rows["surface 10"]["kernels"] == pytest.approx([80 * 1.2 / 5.5, 80 / 5, 72 / 4])
    assert rows["surface 10"]["path"] == pytest.approx([24 / 5.5, 20 / 5, 18 / 4])
    assert rows["surface 28"]["naive"] == pytest.approx([25.0] * 3)
    assert rows["path 64"]["naive"] == pytest.approx([5.0] * 3)
    assert rows["naive 64"]["naive"] == pytest.approx([1.0] * 3)
    assert rows["surface 10"]["floor"] == pytest.approx([2.5, 2.0, 2.75])
    assert rows["naive 64"]["floor"] == pytest.approx([90.0, 60.0, 100.0])
    assert rows["surface 10"]["equal_error"]
    assert not rows["surface 28"]["equal_error"]


def test_the_table_has_a_row_for_each_method_and_setting():
    header, rows = synth.table(_result())
    assert all(len(row) == len(header) for row in rows)
    assert rows[4][header.index("naive / it")] == "21.8 (20 … 22.5)"
    assert rows[4][header.index("it / floor")] == "2.5 (2 … 2.75)"
    assert rows[4][header.index("MiB")] == "1024"
    assert rows[-1][:3] == ["checker", "surface 10, 64², 81², depth 8", "3.0"]


def test_steps_add_up():
    calls = []
    counts = synth.RUNS
    steps = synth._Steps(lambda *call: calls.append(call), ["rings"], synth._growing(False), 3, counts)
    steps.add("reference", 0)
    for task, spp, _ in synth.methods("rings").values():
        for _ in range(counts[task]):
            steps.add(task, spp)
    for setting in synth._growing(False):
        steps.add("growth", setting)
    assert calls[0][0] == 0
    assert calls[-1][0] == calls[-1][1]


def test_a_process_that_fails_says_why():
    with synth._Process({"task": "growth", "directions": "nonsense"}) as process:
        with pytest.raises(RuntimeError, match="nonsense"):
            process.answer()


def test_the_growth_is_drawn_and_a_plot_without_it_refused(need, tmp_path, capsys):
    need("matplotlib")
    sizes = {"5x5": 25, "ubo81": 81, "ubo151": 151}
    rows = [
        row | {"seconds": 1.0 + k, "peak_bytes": 2**30, "n_directions": sizes[row["directions"]]}
        for k, row in enumerate(synth._growing(False))
    ]
    plot_growth(rows, tmp_path / "growth.png")
    image = np.asarray(Image.open(tmp_path / "growth.png").convert("RGB")) / 255
    # Three panels side by side, and in each of them a line of time and one of memory.
    for panel in np.array_split(image, 3, axis=1):
        colours = {tuple(colour) for colour in np.rint(10 * panel.reshape(-1, 3)).tolist()}
        assert {(1, 5, 7), (10, 5, 1)} <= colours
    arguments = ["bench", "synth", "--only", "checker", "--plot", str(tmp_path / "other.png")]
    assert main(arguments) == 2
    assert "growth" in capsys.readouterr().err
    assert not (tmp_path / "other.png").exists()


def test_the_floor_counts_what_is_summed_up(llvm):
    """Every value that the direct light of a flat tile is made of; its time grows with their number."""
    from btfref.bench import floor
    from btfref.mesostructure import build
    from btfref.numerics.sphere.directions import directions
    from btfref.sampling.surface.estimator import SurfaceEstimator

    vectors = directions("1x3").vectors
    made = SurfaceEstimator(
        build("flat"), vectors, views=vectors, texels=(4, 4), spp=64, seed=0, max_depth=2, variance=False
    )
    count, seen = floor.values_of(made)
    assert count == 3 * 3 * len(made.points.p)  # nothing of a plane is hidden
    assert set(seen) == set(made.scene.lobes.ids)
    one = floor.seconds(count, seen, vectors, lanes=64)
    assert one > 0
