"""Factored BTFs as they are stored: byte counts, types, 8-bit codes, codebooks, files."""

import dataclasses

import numpy as np
import pytest
from factored_fits import KEYS, fit
from oracle import oracle_btf
from probes import hemisphere

from btfref.gates.tolerances import tolerance
from btfref.numerics.sphere.directions import directions
from btfref.representations import load, read_info, save
from btfref.representations.factored import cmf
from btfref.representations.factored import storage as factored_storage
from btfref.representations.factored.definition import decoded


def sparse_btf(shape, dtype="float16"):
    """Many texels, few directions."""
    w = directions("ubo81").vectors[[0, 1, 3, 5]]
    return oracle_btf(shape, w, w, dtype)


def test_byte_counts_are_those_of_the_paper(tmp_path):
    """2.25 MiB for three codebooks of 256 maps of 32² RGB bytes, 36 MiB unclustered for 64² texels."""
    btf = sparse_btf((64, 64))
    for clusters, mebibytes in ((256, 2.25), (None, 36)):
        fitted = cmf.fit(btf, clusters=clusters, storage="byte", scale_storage="byte", sweeps=0)
        path = tmp_path / f"{clusters}.cmf.exr"
        save(fitted, path)
        info = read_info(path)
        books = {name: m for name, m in info["maps"].items() if name.startswith("factor_")}
        assert sum(m["bytes"] for m in books.values()) == mebibytes * 2**20
        width = 1 if clusters else 2
        assert info["maps"]["index"]["bytes"] == 64 * 64 * 3 * width
        assert info["maps"]["scale_map"]["bytes"] == 64 * 64 * 3
        assert info["payload_bytes"] == mebibytes * 2**20 + 64 * 64 * 3 * (width + 1) + 12


@pytest.mark.parametrize("storage", ["float", "half", "byte"])
@pytest.mark.parametrize("key", KEYS)
def test_files_keep_every_value(key, storage, tmp_path):
    fitted = fit(key, sparse_btf((5, 6)), storage=storage, clusters=8)
    save(fitted, tmp_path / "a.exr")
    back = load(tmp_path / "a.exr")
    assert (
        fitted.maps["factor_q"].dtype == {"float": np.float32, "half": np.float16, "byte": np.uint8}[storage]
    )
    for name, array in fitted.arrays().items():
        assert back.maps[name].dtype == array.dtype
        np.testing.assert_array_equal(back.maps[name], array)
    assert back.meta == fitted.meta


def test_codebooks_are_bounded_and_deterministic():
    btf = oracle_btf((9, 8))
    a, b = (fit("cmf", btf, clusters=10, seed=3) for _ in range(2))
    for name in a.maps:
        np.testing.assert_array_equal(a.maps[name], b.maps[name])
    assert len(a.maps["factor_p"]) <= 10
    assert a.maps["index"].max() < 10
    every = fit("cmf", btf, clusters=None)
    assert every.meta["fit"]["error"] < a.meta["fit"]["error"]


def test_fourth_powers_spread_over_the_dark(rng):
    """Half a step of the fourth root everywhere: values of 1/1000 keep 5 % where linear codes keep none."""
    values = np.concatenate([rng.random(1000), 10 ** rng.uniform(-3, 0, 1000)])
    relative = {}
    for code, power in factored_storage.CODES.items():
        codes = factored_storage.stored_maps("m", values, "byte", power)
        back = decoded(codes, power)
        assert codes.dtype == np.uint8
        assert np.abs(back ** (1 / power) - values ** (1 / power)).max() <= tolerance("factored.codes.step")
        dark = values < 3e-3
        relative[code] = (np.abs(back - values) / values)[dark].max()
    assert relative["fourth"] < tolerance("factored.codes.fourth")
    assert relative["linear"] > tolerance("factored.codes.min_linear")


@pytest.mark.parametrize("code", factored_storage.CODES)
@pytest.mark.parametrize("key", KEYS)
def test_codes_are_decoded_before_anything_else(key, code, rng):
    """A fit in 8 bits is the one in floats whose maps are the decoded codes; only 8-bit maps have a power."""
    fitted = fit(key, oracle_btf((6, 5)), storage="byte", code=code)
    power = factored_storage.CODES[code]
    constants = fitted.meta["constants"]
    assert (constants["map_power"], constants["scale_power"]) == (power, power)
    maps = {n: decoded(m, power, np.float64) if m.dtype == np.uint8 else m for n, m in fitted.maps.items()}
    plain = dataclasses.replace(
        fitted, maps=maps, meta=fitted.meta | {"constants": constants | {"map_power": 1, "scale_power": 1}}
    )
    points = rng.random((4000, 2)), hemisphere(rng, 4000), hemisphere(rng, 4000)
    np.testing.assert_allclose(
        fitted.evaluate(*points), plain.evaluate(*points), rtol=tolerance("metric.library.atol")
    )


def test_mini_batches_make_codebooks_nearly_as_good(rng, monkeypatch):
    """Above a number of maps k-means passes over parts of them: no more prototypes, and little more error."""
    centres = rng.random((40, 48), dtype=np.float32)
    maps = centres[rng.integers(0, 40, 6000)] + 0.02 * rng.random((6000, 48), dtype=np.float32)
    error = {}
    for kind, above in (("passes", len(maps)), ("batches", len(maps) - 1)):
        monkeypatch.setattr(factored_storage, "MINI_BATCH_ABOVE", above)
        labels, prototypes = factored_storage.codebook(maps, 64, seed=1)
        assert len(prototypes) <= 64
        assert labels.max() == len(prototypes) - 1
        again, _ = factored_storage.codebook(maps, 64, seed=1)
        np.testing.assert_array_equal(labels, again)
        error[kind] = float(((maps - prototypes[labels]) ** 2).sum())
    spread = float(((maps - maps.mean(0)) ** 2).sum())
    assert error["passes"] != error["batches"]
    assert max(error.values()) <= tolerance("factored.mini_batch.share") * spread


@pytest.mark.parametrize(("key", "form"), [("cmf", {}), ("cmf", {"difference": True}), ("hf", {})])
def test_progress_ends_when_the_work_does(key, form):
    calls = []
    fit(key, oracle_btf((7, 6)), progress=lambda *call: calls.append(call), **form)
    done, total, _ = zip(*calls, strict=True)
    assert done == tuple(range(1, len(calls) + 1))
    assert set(total) == {len(calls)}


def test_info_reports_what_the_fit_measured(tmp_path):
    from btfref.commands import info

    fitted = fit("cmf", oracle_btf((4, 4)))
    save(fitted, tmp_path / "a.exr")
    facts = info.read(tmp_path / "a.exr")
    assert facts["fit"] == fitted.meta["fit"]
    assert set(facts["fit"]["resampling"]) == {
        "half_difference",
        "parabolic_p",
        "parabolic_q",
        "parabolic_r",
    }
    text = "\n".join(info.lines(facts))
    assert "half_difference" in text
