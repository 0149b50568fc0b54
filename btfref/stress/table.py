"""What a stress run found, as tables in Markdown."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from btfref.stress.judging import Finding


def evaluator_table(findings: Sequence[Finding]) -> list[str]:
    """Method × evaluator: the worst error that rounded arguments do not explain, on which data, and the bound.

    Parameters
    ----------
    findings : list of Finding

    Returns
    -------
    list of str
        Lines of Markdown.
    """
    ports = [f for f in findings if f.check == "port"]
    names = list(dict.fromkeys(f.evaluator for f in ports))
    rows = [["method", *names, "bound", "lookups", "failures", "explained"], ["---"] * (len(names) + 5)]
    for key in dict.fromkeys(f.method for f in ports):
        own = [f for f in ports if f.method == key]
        cells = []
        for name in names:
            mine = [f for f in own if f.evaluator == name]
            if not mine:
                cells.append("–")
                continue
            worst = max(mine, key=lambda f: (f.failures > 0, f.worst))
            own_ulps = (f.detail["ulps"] for f in mine if f.detail and f.data == "bumpy")
            ulps = max((found.get("p99", 0) for found in own_ulps), default=0)
            cells.append(f"{worst.worst:.1e} ({worst.data}); p99 {ulps:.0f} ulp")
        rows.append(
            [
                f"`{key}`",
                *cells,
                f"{own[0].bound:.0e}",
                str(sum(f.cases for f in own)),
                str(sum(f.failures for f in own)),
                str(sum(f.explained for f in own)),
            ]
        )
    return _markdown(rows)


def check_table(findings: Sequence[Finding]) -> list[str]:
    """Method × check of definitions and fits, as lines of Markdown: the worst figure, where, and its bound."""
    rows = [["check", "method", "data", "worst", "bound", "failures", "what"], ["---"] * 7]
    others = [f for f in findings if f.check != "port"]
    for check in dict.fromkeys(f.check for f in others):
        for key in dict.fromkeys(f.method for f in others if f.check == check):
            own = [f for f in others if (f.check, f.method) == (check, key)]
            worst = max(own, key=lambda f: (f.failures, f.worst if f.worst == f.worst else float("inf")))
            data = worst.data if len(own) == 1 else f"{worst.data} (of {len(own)})"
            rows.append(
                [
                    check,
                    f"`{key}`",
                    data,
                    f"{worst.worst:.3g}",
                    f"{worst.bound:g}",
                    str(sum(f.failures for f in own)),
                    worst.where.replace("|", "/"),
                ]
            )
    return _markdown(rows)


def failure_lines(findings: Sequence[Finding]) -> Iterator[str]:
    """One line a failed finding, with the command that shows it."""
    for f in findings:
        if not f.passed:
            count = f"{f.failures} of {f.cases}" if f.cases > 1 else "failed"
            text = f"{f.method}, {f.evaluator}, {f.data}: {f.check}: {count}, worst {f.worst:.3g} (bound {f.bound:g})"
            yield f"{text}{'; ' + f.where if f.where else ''}{'; ' + f.reproducer if f.reproducer else ''}"


def _markdown(rows: Sequence[Sequence[str]]) -> list[str]:
    return ["| " + " | ".join(row) + " |" for row in rows]
