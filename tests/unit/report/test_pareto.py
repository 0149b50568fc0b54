"""Diagrams of two costs: who is dominated, tables, pictures."""

import io
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from PIL import Image

from btfref.errors import InputError
from btfref.report.pareto import Panel, Point, draw_pareto, front, pareto_svg, pareto_table

POINTS = [
    Point("cheap", 1, 9, "a"),
    Point("middle", 3, 3, "b", low=2.5, high=4),
    Point("dear", 9, 1, "a"),
    Point("worse", 4, 4, "b"),
    Point("as dear", 9, 2, "b"),
]


def test_dominated_points():
    np.testing.assert_array_equal(front(POINTS), [True, True, True, False, False])
    # Equal points stand side by side; one equal in one cost and better in the other wins.
    np.testing.assert_array_equal(front([Point("p", 1, 1), Point("q", 1, 1), Point("r", 1, 2)]), [1, 1, 0])
    assert front([]).shape == (0,)


def test_front_against_its_definition(rng):
    x, y = np.round(rng.uniform(1, 3, (2, 200)), 1)
    best = front([Point(str(i), a, b) for i, (a, b) in enumerate(zip(x, y, strict=True))])
    for i in range(len(x)):
        beaten = ((x <= x[i]) & (y <= y[i]) & ((x < x[i]) | (y < y[i]))).any()
        assert best[i] == (not beaten)


@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, np.inf])
def test_costs_must_be_positive(bad):
    with pytest.raises(InputError, match="not a cost"):
        front([Point("good", 1, 1), Point("bad", 1, bad)])


def test_table_names_what_dominates():
    lines = pareto_table(Panel("t", "time (s)", "error", POINTS))
    assert lines[0] == "|  | of | time (s) | error | dominated by |"
    assert [line.split(" | ")[0] for line in lines[2:]] == [
        "| **cheap**",
        "| **middle**",
        "| worse",
        "| **dear**",
        "| as dear",
    ]
    assert lines[4].endswith("| middle |")
    assert "3 (2.5 … 4)" in lines[3]


def test_pictures():
    panels = [Panel("one", "x", "y", POINTS), Panel("two", "x", "y", POINTS[:2])]
    png = io.BytesIO()
    draw_pareto(panels, png)
    with Image.open(png) as image:
        assert image.width > 2 * image.height
    svg = pareto_svg(panels)
    root = ET.fromstring(svg)
    assert root.tag.endswith("svg")
    texts = {"".join(t.itertext()).strip() for t in root.iter("{http://www.w3.org/2000/svg}text")}
    assert {"cheap", "worse", "one", "two"} <= texts
    assert svg == pareto_svg(panels)
