"""Random lookups for the tests: those that stress, validation and benchmarks draw."""

from btfref.stress.lookups import USUAL, hard_lookups, hemisphere, unit

__all__ = ["hemisphere", "probe_points", "unit"]


def probe_points(rng, n, representation):
    """``(uv, w_light, w_view)`` in float32 at the hard places of a representation that any port must get right."""
    return hard_lookups(rng, representation, n, USUAL).points
