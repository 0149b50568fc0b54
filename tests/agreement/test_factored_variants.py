"""Every form and storage of the factored methods: Dr.Jit and GLSL against the float64 definition."""

import numpy as np
import pytest
from oracle import oracle_btf
from probes import probe_points

from btfref.comparison.comparison import agreement
from btfref.registry import methods
from btfref.representations import save

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
def test_every_form_agrees(form, llvm, need, tmp_path):
    import drjit as dr

    import mitsuba_plugins
    from btfref.rendering.gl.probe import probe

    need("gl")
    key, parameters = FORMS[form]
    btf = oracle_btf((7, 6))
    representation = methods()[key].fit(btf, map_size=16, clusters=10, **parameters)
    points = probe_points(np.random.default_rng(5), 6000, btf.views, btf.lights)
    expected = representation.evaluate(*points)
    assert agreement(probe(representation, *points), expected).passed
    save(representation, tmp_path / "a.exr")
    mitsuba_plugins.register()
    bsdf = llvm.load_dict({"type": "btf", "filename": str(tmp_path / "a.exr")})
    uv, w_light, w_view = points
    si = dr.zeros(llvm.SurfaceInteraction3f, len(uv))
    si.uv, si.wi = llvm.Point2f(uv.T), llvm.Vector3f(w_view.T)
    value = np.array(bsdf.eval(llvm.BSDFContext(), si, llvm.Vector3f(w_light.T))).T
    assert agreement(value, expected).passed
