"""Image comparison: metrics, statistics, and the error waterfall."""

from btfref.comparison.comparison import Comparison, agreement, compare, json_safe
from btfref.images.display import Display

__all__ = ["Comparison", "Display", "agreement", "compare", "json_safe"]
