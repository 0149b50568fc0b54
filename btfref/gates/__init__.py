"""Tolerances, each with its reason, and verdicts by them."""

from btfref.gates.tolerances import gate_table, reason, tolerance, tolerance_of
from btfref.gates.verdicts import GateResult, Measured, judge, missing_reference

__all__ = [
    "GateResult",
    "Measured",
    "gate_table",
    "judge",
    "missing_reference",
    "reason",
    "tolerance",
    "tolerance_of",
]
