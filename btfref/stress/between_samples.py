"""Verdict on a fit between its samples: apart from what measures it, so that no fit depends on limits."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from btfref.gates.tolerances import gate_keys, gate_table, limits
from btfref.gates.verdicts import GateResult, judge

#: The gate that judges these figures.
GATE = "fit.between_samples"


def between_gates(method: str, facts: Mapping[str, float]) -> list[GateResult]:
    """The limits of ``fit.between_samples``, and in their place those that a method brings, applied to the figures.

    Parameters
    ----------
    method : str
        Registry key.
    facts : dict
        Of `btfref.representations.between.measure`; what the gate does not limit is left out.

    Returns
    -------
    list of GateResult
    """
    own = f"{GATE}.{method}"
    key = own if own in gate_keys() else GATE
    names = {entry.removeprefix("min_") for entry in limits(gate_table(key))}
    found = judge(key, {name: facts[name] for name in facts.keys() & names})
    # One name whoever's limits they are.
    return [replace(gate, name=f"{GATE}.{gate.entry}") for gate in found]
