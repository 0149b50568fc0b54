"""Parts of charts as SVG, short: a report has thousands of charts."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape


def short(value: float) -> str:
    """A coordinate with at most one decimal."""
    return f"{value:.1f}".removesuffix(".0")


def lines(kind: str, ends: Iterable[Sequence[float]]) -> str:
    """Horizontal and vertical lines ``(x1, y1, x2, y2)`` of one class, as a path."""
    d = (
        f"M{short(x1)} {short(y1)}" + (f"V{short(y2)}" if x1 == x2 else f"H{short(x2)}")
        for x1, y1, x2, y2 in ends
    )
    return f'<path class="{kind}" d="{"".join(d)}"/>'


def steps(kind: str, edges: Sequence[float], tops: Iterable[float], base: float) -> str:
    """A histogram's outline, closed along its base; bins of equal height are one step."""
    d, height = [f"M{short(edges[0])} {short(base)}"], short(base)
    for edge, top in zip(edges, map(short, tops), strict=False):
        if top != height:
            d.append((f"H{short(edge)}" if edge > edges[0] else "") + f"V{top}")
            height = top
    return f'<path class="{kind}" d="{"".join(d)}H{short(edges[-1])}V{short(base)}Z"/>'


def bars(kind: str, places: Iterable[tuple[float, float, float]], base: float) -> str:
    """Bars ``(left, top, width)`` that stand on a base, as one path."""
    d = (f"M{short(x)} {short(base)}V{short(y)}h{short(width)}V{short(base)}" for x, y, width in places)
    return f'<path class="{kind}" d="{"".join(d)}"/>'


def text(x: float, y: float, words: str, anchor: str, kind: str = "tick") -> str:
    """Words at a place; ``anchor`` is SVG's ``text-anchor``."""
    return f'<text class="{kind}" x="{short(x)}" y="{short(y)}" text-anchor="{anchor}">{escape(words)}</text>'


def texts(kind: str, anchor: str, places: Iterable[tuple[float, float, str]]) -> str:
    """Words ``(x, y, words)`` of one class and anchor."""
    inner = "".join(f'<text x="{short(x)}" y="{short(y)}">{escape(words)}</text>' for x, y, words in places)
    return f'<g class="{kind}" text-anchor="{anchor}">{inner}</g>'
