"""Every form and storage of the factored methods: all ports against the float64 definition."""

import numpy as np
import pytest
from oracle import oracle_btf
from probes import probe_points

from btfref.registry import methods
from btfref.representations import save
from btfref.stress.evaluators import PORTS
from btfref.stress.judging import port_agreement

FORMS = {
    "cmf-float": ("cmf", {"storage": "float"}),
    "cmf-byte": ("cmf", {"storage": "byte"}),
    "cmf-byte-half": ("cmf", {"storage": "byte", "scale_storage": "half"}),
    "cmf-linear-bytes": ("cmf", {"storage": "byte", "code": "linear"}),
    "cmf-four": ("cmf", {"difference": True}),
    "cmf-four-terms-byte": ("cmf", {"difference": True, "terms": 2, "storage": "byte"}),
    "cmf-terms": ("cmf", {"terms": 3}),
    "hf-byte": ("hf", {"storage": "byte", "smoothness": 1.0}),
    "hf-float": ("hf", {"storage": "float", "smoothness": 1.0}),
}


@pytest.mark.parametrize("form", FORMS)
def test_every_form_agrees(form, evaluator, tmp_path):
    key, parameters = FORMS[form]
    representation = methods()[key].fit(oracle_btf((7, 6)), map_size=16, clusters=10, **parameters)
    points = probe_points(np.random.default_rng(5), 6000, representation)
    reference = representation.evaluate(*points)
    save(representation, tmp_path / "a.exr")
    for port in PORTS:
        value = evaluator(port, representation, tmp_path / "a.exr").evaluate(*points)
        assert port_agreement(value, representation, points, reference=reference).passed
