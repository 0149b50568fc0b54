"""Gates: measured numbers against the limits of ``tolerances.toml``."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace

from btfref.errors import InputError
from btfref.gates.tolerances import gate_table, limits
from btfref.types import Facts

#: Entries of ``tolerances.toml`` in words, and in short ones for the head of a narrow column.
_WORDS = {
    "p50": ("median relative error", "rel. error median"),
    "p99": ("99 % relative error", "rel. error 99 %"),
    "p999": ("99.9 % relative error", "rel. error 99.9 %"),
    "max": ("largest relative error", "rel. error largest"),
    "nonfinite": ("pixels not finite", "pixels"),
    "max_abs": ("largest error", "largest error"),
    "nrmse": ("RMSE / mean", "RMSE / mean"),
    "relative_l2": ("RMSE / root mean square", "RMSE / RMS"),
    "failing_fraction": ("share of failing pixels", "failing share"),
    "rejected_fraction": ("share of significant differences", "rejected share"),
    "relative_rmse": ("RMSE / mean without noise", "RMSE / mean"),
    "bias_fraction": ("bias / mean", "bias / mean"),
    "min_judged_share": ("share of covered pixels judged", "judged share"),
}


def limit_name(entry: str, *, short: bool = False) -> str:
    """An entry of ``tolerances.toml`` in words; `short` for the head of a narrow column."""
    plain = entry.removeprefix("min_").replace("_", " ")
    return _WORDS.get(entry, (plain, plain))[short]


@dataclass(frozen=True)
class GateResult:
    """One limit applied to one number.

    Parameters
    ----------
    name : str
        Gate and entry, ``"image.noise_free.p999"``.
    passed : bool
    value : float or None
        None when nothing was measured.
    limit : float
        Upper limit, or lower limit when the entry begins with ``min_``.
    reason : str
        Why the limit is what it is.
    outcome : {"pass", "fail", "inconclusive", "empty"}
        ``empty``: no pixel of the class, and the gate says that this may be.
    pixel_class : str
        Class judged, empty for gates that are not about pixels.
    detail : str
        What a failure, or an undecided test, needs as explanation.
    measured : Measured or None
        What the outcome was judged from; None for a result that nobody measured.
    judged : float or None
        Share of the covered pixels that the gate looked at; None for gates that are not about those.
    """

    name: str
    passed: bool
    value: float | None
    limit: float
    reason: str
    outcome: str = "pass"
    pixel_class: str = ""
    detail: str = ""
    measured: Measured | None = None
    judged: float | None = None

    @property
    def gate(self) -> str:
        """The gate's key, ``"image.noise_free"``."""
        return self.name.rpartition(".")[0]

    @property
    def entry(self) -> str:
        """The entry within the gate, ``"p999"``."""
        return self.name.rpartition(".")[2]

    @property
    def pixels(self) -> str:
        """The class judged and its share of the covered pixels, ``"interior+edge, 97.2 %"``; empty without a class."""
        return self.pixel_class + ("" if self.judged is None else f", {100 * self.judged:.1f} %")

    @property
    def sign(self) -> str:
        """Relation that the value must have to the limit."""
        return "≥" if self.entry.startswith("min_") else "≤"

    @property
    def share(self) -> float:
        """How much of its limit the value takes: above 1 it fails, infinite where nothing was measured."""
        if self.outcome == "empty":
            return 0.0
        if self.value is None or math.isnan(self.value):
            return math.inf
        part, whole = (self.limit, self.value) if self.sign == "≥" else (self.value, self.limit)
        return part / whole if whole > 0 else math.inf if part > whole else 0.0

    @property
    def line(self) -> str:
        """The result in one line, for a terminal or a test's message."""
        where = f" [{self.pixels}]" if self.pixel_class else ""
        value = "no value" if self.value is None else f"{self.value:.4g}"
        detail = f" ({self.detail})" if self.detail else ""
        return f"{self.outcome}: {self.name}{where} {value}, wanted {self.sign} {self.limit:g}{detail}"

    def to_dict(self) -> Facts:
        """JSON-able form."""
        return {
            "name": self.name,
            "passed": self.passed,
            "outcome": self.outcome,
            "value": self.value,
            "limit": self.limit,
            "class": self.pixel_class,
            "reason": self.reason,
            "detail": self.detail,
            "judged": self.judged,
        }

    def named(self, whose: str) -> GateResult:
        """The same with a name before its detail: of what it is, where several are judged alike."""
        return replace(self, detail=f"{whose}{': ' if self.detail else ''}{self.detail}")

    def measurement(self) -> Facts:
        """What was measured, JSON-able, without any verdict: `judged` finds that anew."""
        found = self.measured or Measured(self.value)
        value = found.value if found.value is None or math.isfinite(found.value) else str(found.value)
        return {
            "name": self.name,
            "value": value,
            "lacks": found.outcome,
            "bounds": None if found.bounds is None else list(found.bounds),
            "class": self.pixel_class,
            "detail": self.detail,
            "beside": {f.name: getattr(self, f.name) for f in fields(self) if f.name not in _JUDGED},
        }


#: What a verdict consists of; what else a result carries is told beside it, whatever the verdict.
_JUDGED = ("name", "passed", "value", "limit", "reason", "outcome", "pixel_class", "detail", "measured")


@dataclass(frozen=True)
class Measured:
    """A number, or the reason why there is none.

    Parameters
    ----------
    value : float or None
    outcome : {"fail", "empty"} or None
        What it means that something is not there: a reference, a variance, pixels of the class. None where the limit
        decides.
    detail : str
    bounds : (float, float), optional
        Between which the value surely lies: it passes where both are within the limit on either side of zero, fails
        where both are beyond it on one, and is else inconclusive.
    """

    value: float | None
    outcome: str | None = None
    detail: str = ""
    bounds: tuple[float, float] | None = None


def judge(
    key: str, measured: Mapping[str, float | Measured | None], *, pixel_class: str = ""
) -> list[GateResult]:
    """Apply every limit of a gate.

    Parameters
    ----------
    key : str
        Gate in ``tolerances.toml``.
    measured : dict of str to float, Measured or None
        One number for every limit, under the limit's name without ``min_``. A number that is missing, None or
        NaN fails its gate: what was not measured is not right.
    pixel_class : str, optional
        Recorded in the results.

    Returns
    -------
    list of GateResult
        In the order of the file, at least one.

    Raises
    ------
    InputError
        Unknown gate, a gate without limits, or a measured name that the gate does not know.
    """
    table = gate_table(key)
    wanted = limits(table)
    if not wanted:
        raise InputError("gate holds no limit", file="tolerances.toml", field=key)
    names = {entry: entry.removeprefix("min_") for entry in wanted}
    unknown = sorted(set(measured) - set(names.values()))
    if unknown:
        raise InputError(
            "measured what the gate does not limit", field=key, got=unknown, expected=list(names.values())
        )
    return [
        _apply(f"{key}.{entry}", measured.get(names[entry]), limit, table["reason"], pixel_class)
        for entry, limit in wanted.items()
    ]


def judged(facts: Facts) -> GateResult:
    """The verdict on a stored measurement, by the limit as it is now.

    Parameters
    ----------
    facts : dict
        As `GateResult.measurement` gives it.

    Returns
    -------
    GateResult

    Raises
    ------
    InputError
        For a gate that there is no more.
    """
    gate, _, entry = facts["name"].rpartition(".")
    table = gate_table(gate)
    wanted = limits(table)
    if entry not in wanted:
        raise InputError(
            "no such limit", file="tolerances.toml", field=gate, got=entry, expected=list(wanted)
        )
    value, bounds = facts["value"], facts["bounds"]
    measured = Measured(
        None if value is None else float(value),
        facts["lacks"],
        facts["detail"],
        None if bounds is None else (float(bounds[0]), float(bounds[1])),
    )
    found = _apply(facts["name"], measured, wanted[entry], table["reason"], facts["class"])
    return replace(found, **facts["beside"])


def deciding(gates: Iterable[GateResult]) -> GateResult | None:
    """The result that says most of a cell: what failed or is not decided, else what is nearest to its limit."""
    return max(gates, key=lambda gate: (not gate.passed, gate.outcome == "fail", gate.share), default=None)


def with_class(name: str) -> str:
    """The name of a limit, and the class of pixels that its gate judges: ``image.noise_free.p999 [interior]``."""
    judged = gate_table(name.rpartition(".")[0]).get("class")
    return f"{name} [{judged}]" if judged else name


def missing_reference(key: str, what: str) -> list[GateResult]:
    """The results of a gate whose reference is not there: failures.

    Parameters
    ----------
    key : str
        Gate in ``tolerances.toml``.
    what : str
        What is missing, for the reader.

    Returns
    -------
    list of GateResult
    """
    names = [entry.removeprefix("min_") for entry in limits(gate_table(key))]
    return judge(key, dict.fromkeys(names, Measured(None, "fail", f"missing reference: {what}")))


def _apply(
    name: str, measured: float | Measured | None, limit: float, reason: str, pixel_class: str
) -> GateResult:
    if not isinstance(measured, Measured):
        measured = Measured(measured)
    value = None if measured.value is None else float(measured.value)
    outcome, detail = measured.outcome, measured.detail
    lower = name.rpartition(".")[2].startswith("min_")
    if outcome is None:
        if value is None or math.isnan(value):
            outcome, detail = "fail", detail or "not measured"
        elif measured.bounds is not None:
            outcome = _surely(*measured.bounds, limit)
        else:
            outcome = "pass" if (value >= limit if lower else value <= limit) else "fail"
    passed = outcome in ("pass", "empty")
    return GateResult(name, passed, value, limit, reason, outcome, pixel_class, detail, measured)


def _surely(low: float, high: float, limit: float) -> str:
    """Two one-sided tests (Schuirmann 1987) by an interval."""
    if -limit < low and high < limit:
        return "pass"
    return "fail" if low > limit or high < -limit else "inconclusive"
