"""Known answers: lookups, what the definition in float64 says to them, and how far a port may be off."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from btfref.gates.tolerances import tolerance_of
from btfref.types import Facts

#: Columns of a lookup, in this order.
COLUMNS = ("u", "v", "light_x", "light_y", "light_z", "view_x", "view_y", "view_z", "lod")


@dataclass(frozen=True)
class KnownAnswers:
    """Lookups of a representation and their answers.

    Attributes
    ----------
    method : str
    rows : ndarray of float32, shape (N, 9)
        In the order of :data:`COLUMNS`.
    values : ndarray of float64, shape (N, 3)
        B in 1/sr.
    gate : str
        Key of ``tolerances.toml`` with the limits.
    """

    method: str
    rows: np.ndarray
    values: np.ndarray
    gate: str = "probe.agreement"

    def to_dict(self) -> Facts:
        """JSON-able; the numbers of the lookups are float32, so that a port reads them as they are."""
        limits = {name: tolerance_of(self.method, f"{self.gate}.{name}") for name in ("floor", "p999", "max")}
        return {
            "columns": list(COLUMNS),
            "lookups": np.asarray(self.rows, float).tolist(),
            "values": self.values.tolist(),
            "unit": "1/sr, linear Rec. 709, the cosine of the light included",
            "evaluator": "NumPy, float64",
            "tolerance": {
                **limits,
                "error": "of a lookup: the largest |value - answer| of a channel, over the larger of the answer's"
                " largest |channel| and floor times the largest |channel| of all answers; max bounds the largest,"
                " p999 the 99.9th percentile",
            },
        }
