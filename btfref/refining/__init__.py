"""Fits that follow the gradient of a loss at true values: queries, a sampled BTF, pictures."""

from btfref.refining.refinement import Settings, refine

__all__ = ["Settings", "refine"]
