"""Numbers and tables as HTML."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from html import escape
from typing import TYPE_CHECKING, Any

from btfref.conventions import PixelClass
from btfref.gates.verdicts import GateResult, limit_name
from btfref.types import Facts

if TYPE_CHECKING:
    from btfref.comparison import Comparison


OUTCOME = {
    "pass": ("✓", "pass"),
    "fail": ("✗", "fail"),
    "inconclusive": ("?", "inconclusive"),
    "empty": ("–", "no pixels"),
}

#: Metric → its row in the table of classes: label, explanation.
ROWS = {
    "count": ("pixels", "pixels of the class in which both pictures are finite"),
    "mean_reference": ("mean reference", "mean radiance of the reference over pixels and channels"),
    "rel_p50": (
        "relative error, median",
        "per pixel the largest |test − reference| / max(|reference|, floor) of its channels",
    ),
    "rel_p99": ("relative error, 99 %", "99 % of the pixels have at most this relative error"),
    "rel_p999": ("relative error, 99.9 %", "99.9 % of the pixels have at most this relative error"),
    "rel_max": ("relative error, largest", "the worst pixel"),
    "rmse": ("RMSE", "root of the mean squared error of linear radiance"),
    "nrmse": ("RMSE / mean", "RMSE divided by the mean radiance of the reference"),
    "relative_l2": ("RMSE / RMS", "RMSE divided by the root mean square radiance of the reference"),
    "bias": ("bias", "mean of test − reference"),
    "mae": ("MAE", "mean absolute error"),
    "relmse": ("relMSE", "mean of (test − reference)² / (reference² + ε)"),
    "smape": ("SMAPE", "mean of 2|test − reference| / (|test| + |reference|), 0 to 2"),
    "psnr": ("PSNR, dB", "20 log10(peak / RMSE), peak = largest radiance of the reference picture"),
    "ssim": ("SSIM", "structural similarity of the displayed pictures, 1 is equal"),
    "delta_e00_mean": ("ΔE00, mean", "CIEDE2000 of the displayed pictures; about 1 is just noticeable"),
    "delta_e00_p99": ("ΔE00, 99 %", "99 % of the pixels differ by at most this"),
    "delta_e00_max": ("ΔE00, largest", "the worst pixel"),
    "flip_mean": ("HDR-FLIP, mean", "error seen when flipping between the pictures, 0 to 1, worst exposure"),
    "flip_max": ("HDR-FLIP, largest", "the worst pixel"),
}


def number(value: float | str | None, digits: int = 3) -> str:
    """A number for a reader: three significant digits, exponents without padding; text and None pass.

    Parameters
    ----------
    value : float, int, str or None
    digits : int, optional

    Returns
    -------
    str
    """
    if value is None:
        return "–"
    if isinstance(value, str):
        return value
    if isinstance(value, int):
        return f"{value:,}".replace(",", "\u202f")
    if math.isnan(value):
        return "NaN"
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    if value == 0:
        return "0"
    if 1e-3 <= abs(value) < 10**5:
        decimals = max(digits - 1 - math.floor(math.log10(abs(value))), 0)
        text = f"{value:.{decimals}f}"
        return (text.rstrip("0").rstrip(".") if "." in text else text).replace("-", "−")
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    mantissa = mantissa.rstrip("0").rstrip(".") if "." in mantissa else mantissa
    return f"{mantissa}e{int(exponent)}".replace("-", "−")


def badge(outcome: str, text: str | None = None) -> str:
    """A coloured word with a sign, so that colour is not needed to read it."""
    sign, word = OUTCOME[outcome]
    return (
        f'<span class="badge {outcome}"><span aria-hidden="true">{sign}</span> {escape(text or word)}</span>'
    )


def class_table(comparison: Comparison, pictures: str = "") -> str:
    """Metrics by pixel class.

    Parameters
    ----------
    comparison : Comparison
    pictures : str
        Which picture was compared with which, for the caption.

    Returns
    -------
    str
        A ``<table>``.
    """
    # What is judged comes first.
    shown = sorted(PixelClass, key=lambda kind: kind == PixelClass.BACKGROUND)
    order = [name for name in (*(kind.label for kind in shown), "all") if name in comparison.metrics]
    epsilon = comparison.settings.get("relmse_epsilon")
    head = "".join(f'<th scope="col">{escape(name)}</th>' for name in order)
    body = []
    for key, (label, explanation) in ROWS.items():
        if not any(key in comparison.metrics[name] for name in order):
            continue
        if key == "relmse" and epsilon is not None:
            label += f", ε = {number(epsilon)}"
        digits = 7 if key == "ssim" else 3
        cells = "".join(f"<td>{number(comparison.metrics[name].get(key), digits)}</td>" for name in order)
        body.append(f'<tr><th scope="row" title="{escape(explanation)}">{escape(label)}</th>{cells}</tr>')
    for key, label, explanation in (
        ("bias", "bias, 99 % interval", "contains the true mean difference with the stated confidence"),
        (
            "rmse_without_noise",
            "RMSE without noise",
            "Monte Carlo noise of both pictures taken out, with its interval",
        ),
    ):
        if comparison.statistics:
            cells = "".join(_interval(comparison.statistics.get(name, {}).get(key)) for name in order)
            body.append(f'<tr><th scope="row" title="{escape(explanation)}">{label}</th>{cells}</tr>')
    if comparison.statistics:
        found_cells = []
        for name in order:
            found = comparison.statistics.get(name, {}).get("difference")
            found_cells.append(
                f"<td>{number(found['rejected'])} of {number(found['n_tests'])}</td>"
                if found
                else "<td>–</td>"
            )
        title = "channels whose equality the z-test rejects after Šidák's correction"
        body.append(
            f'<tr><th scope="row" title="{title}">significant differences</th>{"".join(found_cells)}</tr>'
        )
    return (
        '<div class="scroll"><table class="metrics">'
        f"<caption>Errors of linear radiance by pixel class{': ' if pictures else ''}{escape(pictures)}</caption>"
        f'<thead><tr><th scope="col">metric</th>{head}</tr></thead>'
        f"<tbody>{''.join(body)}</tbody></table></div>"
    )


def _interval(found: Facts | None) -> str:
    if not found:
        return "<td>–</td>"
    return f"<td>{number(found['low'], 2)} to {number(found['high'], 2)}</td>"


def gate_list(gates: Iterable[GateResult]) -> str:
    """Gates with value, limit and outcome, grouped, each group with its reason.

    Parameters
    ----------
    gates : sequence of GateResult

    Returns
    -------
    str
    """
    groups: dict[str, list[GateResult]] = {}
    for gate in gates:
        groups.setdefault(gate.gate, []).append(gate)
    parts = []
    for key, members in groups.items():
        rows = "".join(
            f'<tr class="{gate.outcome}"><th scope="row">{escape(limit_name(gate.entry))}</th>'
            f"<td>{escape(gate.pixels or '–')}</td><td>{escape(number(gate.value))}</td>"
            f"<td>{gate.sign} {number(gate.limit)}</td>"
            f"<td>{badge(gate.outcome)}</td></tr>"
            + (
                f'<tr class="detail"><td colspan="5">{escape(gate.detail)}</td></tr>'
                if gate.detail and gate.outcome != "empty"
                else ""
            )
            for gate in members
        )
        parts.append(
            f'<div class="gate"><h4><code>{escape(key)}</code></h4><div class="scroll"><table class="gates">'
            '<thead><tr><th scope="col">limit on</th><th scope="col">pixels</th><th scope="col">value</th>'
            f'<th scope="col">limit</th><th scope="col">outcome</th></tr></thead><tbody>{rows}</tbody></table></div>'
            f"<details><summary>why these limits</summary><p>{escape(members[0].reason)}</p></details></div>"
        )
    return "".join(parts) or '<p class="muted">No gate was applied.</p>'


def facts_list(facts: Facts) -> str:
    """Nested facts as definition lists; lists of text as preformatted lines.

    Parameters
    ----------
    facts : dict
        Values are dicts, lists, text, numbers, truth values or None.

    Returns
    -------
    str
    """
    plain = {k: v for k, v in facts.items() if not isinstance(v, (dict, list, tuple))}
    parts = [f'<section class="fact"><h3>run</h3>{_definitions(plain)}</section>'] if plain else []
    for key, value in facts.items():
        if isinstance(value, dict):
            parts.append(
                f'<section class="fact"><h3>{escape(_words(key))}</h3>{_definitions(value)}</section>'
            )
        elif isinstance(value, (list, tuple)):
            lines = "\n".join(escape(str(line)) for line in value)
            parts.append(
                f'<section class="fact wide"><h3>{escape(_words(key))}</h3><pre>{lines}</pre></section>'
            )
    return "".join(parts)


def _definitions(table: Mapping[str, Any]) -> str:
    rows = []
    for key, value in table.items():
        if isinstance(value, dict):
            value = _definitions(value)
        elif isinstance(value, (list, tuple)):
            value = escape(", ".join(str(entry) for entry in value))
        else:
            value = escape(_plain(value))
        rows.append(f"<dt>{escape(_words(key))}</dt><dd>{value}</dd>")
    return f"<dl>{''.join(rows)}</dl>"


def _plain(value: object) -> str:
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _words(key: object) -> str:
    return str(key).replace("_", " ")
