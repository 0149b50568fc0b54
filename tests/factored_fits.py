"""Quick fits of the factored methods for their tests."""

from btfref.registry import methods

KEYS = ("cmf", "hf")

#: Small maps make a quick test.
QUICK = {"cmf": {"map_size": 16, "half_step": 10.0}, "hf": {"map_size": 16, "smoothness": 0.3}}


def fit(key, btf, **parameters):
    """A fit with the method's quick settings, and others in their place."""
    return methods()[key].fit(btf, **{**QUICK[key], **parameters})
