"""Image comparison: metrics, statistics and gates."""

from btfref.compare.colour import Display
from btfref.compare.comparison import CLASSES, Comparison, agreement, compare, json_safe
from btfref.compare.gates import GateResult, Measured, judge, missing_reference
from btfref.compare.images import load_image, save_image
from btfref.compare.tolerances import gate_table, reason, tolerance

__all__ = [
    "CLASSES",
    "Comparison",
    "Display",
    "GateResult",
    "Measured",
    "agreement",
    "compare",
    "gate_table",
    "json_safe",
    "judge",
    "load_image",
    "missing_reference",
    "reason",
    "save_image",
    "tolerance",
]
