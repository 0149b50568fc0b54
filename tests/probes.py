"""The lookups that `btfref validate` probes with, for the tests."""

from btfref.validate.probes import hemisphere, hit_allowance, probe_points, unit

__all__ = ["hemisphere", "hit_allowance", "probe_points", "unit"]
