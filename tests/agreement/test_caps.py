"""Inside the first ring of sets without a pole: the ports' stencils against the definition, on rough data."""

from dataclasses import replace

import numpy as np
import pytest
from oracle import oracle_btf
from probes import hemisphere

from btfref.numerics.sphere.directions import directions, spherical
from btfref.registry import methods
from btfref.representations import save
from btfref.stress.evaluators import PORTS
from btfref.stress.judging import port_agreement

#: Odd and even numbers of azimuths, few and many; a wide cap.
SETS = ("10x5", "16x8", "1x4", "2x60")


def inside(rng, spec, n):
    """Directions in the cap and on its border, where the ring ends."""
    edge = directions(spec).rings[0, 0]
    theta = edge * np.where(rng.random(n) < 0.1, 1, np.sqrt(rng.random(n)))
    # Azimuths of the samples and of chords through them, as well as others.
    phi = np.where(rng.random(n) < 0.3, rng.integers(0, 96, n) * np.pi / 48, 2 * np.pi * rng.random(n))
    return spherical(theta, phi).astype(np.float32)


@pytest.mark.parametrize("port", PORTS)
@pytest.mark.parametrize("spec", SETS)
def test_ports_agree_in_the_cap(evaluator, rng, tmp_path, spec, port):
    btf = oracle_btf((2, 3), spec, spec)
    rough = (0.1 + rng.random(btf.values.shape)).astype(np.float16)
    representation = methods()["raw"].fit(replace(btf, values=rough))
    save(representation, tmp_path / "rough.raw.exr")
    n = 4000
    uv = rng.random((n, 2)).astype(np.float32)
    for w_light, w_view in (
        (inside(rng, spec, n), hemisphere(rng, n)),
        (hemisphere(rng, n), inside(rng, spec, n)),
    ):
        value = evaluator(port, representation, tmp_path / "rough.raw.exr").evaluate(uv, w_light, w_view)
        for result in port_agreement(value, representation, (uv, w_light, w_view)).gates:
            assert result.passed, result.line
