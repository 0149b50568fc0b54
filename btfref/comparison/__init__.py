"""Image comparison: metrics, statistics, and the error waterfall."""

from btfref.comparison.comparison import CLASSES, Comparison, agreement, compare, json_safe
from btfref.images.display import Display

__all__ = ["CLASSES", "Comparison", "Display", "agreement", "compare", "json_safe"]
