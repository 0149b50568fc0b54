"""A cell of the report, and what its parts agree on: labels, display, scale of the difference."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from html import escape
from importlib import resources

import numpy as np

from btfref.comparison.comparison import Comparison, json_safe
from btfref.conventions import PixelClass
from btfref.errors import InputError
from btfref.gates.verdicts import GateResult
from btfref.images.display import Display, fit_display

#: Label of a picture → its name and what it shows.
LABELS = {
    "reference": ("Reference", "Mitsuba, the representation's plugin, from the same file and the same scene"),
    "realtime": ("Real-time", "GLSL on float32 targets, the same sub-pixel grid"),
    "browser": ("WebGL 2", "the same shaders in a headless Chromium, read back as floats"),
    "truth": ("Geometry truth", "the mesostructure itself, path traced"),
    "geometry": ("Geometry truth", "the mesostructure itself, path traced"),
    "representation": (
        "Representation",
        "the BTF on the flat shape, path traced by its plugin in the same scene",
    ),
    "definition": ("Definition", "the float64 evaluator in NumPy"),
    "test": ("Test", "the picture under test"),
}


@dataclass(frozen=True, eq=False)
class Cell:
    """One comparison of the report.

    Parameters
    ----------
    name : str
        Such as ``"lpca · sphere · 1 directional"``.
    images : dict of str to (H, W, 3) array
        Linear Rec. 709 by label: ``reference``, ``realtime``, ``truth``, or any other. All of one shape, or
        none.
    comparison : Comparison or None
        None is shown, and counts, as a failure.
    notes : str
        What a reader should know, plain text.
    gates : tuple of GateResult
        More gates than the comparison's own.
    """

    name: str
    images: dict[str, np.ndarray] = field(default_factory=dict)
    comparison: Comparison | None = None
    notes: str = ""
    gates: tuple[GateResult, ...] = ()

    @property
    def all_gates(self) -> tuple[GateResult, ...]:
        """Gates of the comparison and the cell's own."""
        return (*(self.comparison.gates if self.comparison else ()), *self.gates)

    @property
    def outcome(self) -> str:
        """``pass``, ``inconclusive`` or ``fail``; without any gate ``fail``."""
        outcomes = {gate.outcome for gate in self.all_gates}
        if not outcomes or "fail" in outcomes or (self.comparison is None and self.images):
            return "fail"
        return "inconclusive" if "inconclusive" in outcomes else "pass"

    @property
    def display(self) -> Display:
        """The comparison's display, or one made for the first picture."""
        if self.comparison is not None and "display" in self.comparison.settings:
            return Display(self.comparison.settings["display"]["stops"])
        return fit_display(next(iter(self.images.values())))

    @property
    def pair(self) -> tuple[str, str]:
        """Labels of the two pictures shown first: what the comparison took as reference (A), and as test (B)."""
        labels = list(self.images)
        first = self._label_of("reference") or ("reference" if "reference" in labels else labels[0])
        others = [label for label in labels if label != first]
        usual = [label for label in ("realtime", "test") if label in others]
        test = self._label_of("test")
        return first, test if test in others else [*usual, *others, first][0]

    @property
    def names(self) -> tuple[str, str]:
        """Names of the two pictures shown first: what was tested (B), and what it is compared with (A)."""
        first, second = self.pair
        return _name(second), _name(first)

    def _label_of(self, side: str) -> str | None:
        """The picture that is one side of the comparison."""
        picture = getattr(self.comparison, side, None)
        same = (k for k, v in self.images.items() if picture is not None and np.array_equal(v, picture, True))
        return next(same, None)

    def check(self) -> None:
        """Raise InputError when the pictures and the comparison are not of one shape."""
        shapes = {label: np.shape(image) for label, image in self.images.items()}
        if self.comparison is not None and "difference" in self.comparison.maps:
            shapes["comparison"] = self.comparison.maps["difference"].shape
        first = next(iter(shapes.values()), (1, 1, 3))
        for label, shape in shapes.items():
            if len(shape) != 3 or shape[-1] != 3 or shape != first:
                raise InputError(
                    f"picture of cell '{self.name}' does not fit",
                    field=label,
                    got=shape,
                    expected=(*first[:2], 3),
                )


def _name(key: str) -> str:
    return LABELS[key][0] if key in LABELS else key


def asset(name: str) -> str:
    """The text of a file of ``report/assets``."""
    return resources.files("btfref.report").joinpath("assets", name).read_text("utf-8")


def label_of(key: str) -> tuple[str, str]:
    """Name and meaning of a picture's label, for HTML."""
    name, meaning = LABELS.get(key, (key, ""))
    return escape(name), escape(meaning)


def signed_difference(comparison: Comparison) -> np.ndarray:
    """Per pixel the channel that differs most, with its sign, (H, W); 0 where a pixel is not finite."""
    clean = np.nan_to_num(comparison.maps["difference"].astype(np.float64))
    index = np.abs(clean).argmax(-1)[..., None]
    return np.take_along_axis(clean, index, -1)[..., 0]


def full_scale(signed: np.ndarray, classes: np.ndarray | None) -> float:
    """A round number that 99.9 % of the differences stay below, of the interior where there is one."""
    inside = np.abs(signed if classes is None else signed[classes == PixelClass.INTERIOR])
    size = inside[inside > 0] if inside.any() else np.abs(signed[signed != 0])
    if size.size == 0:
        return 1e-6
    wanted = float(np.percentile(size, 99.9))
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(power * next(step for step in (1, 2, 5, 10) if wanted <= step * power * (1 + 1e-9)))


def script_json(data: object) -> str:
    """JSON that may stand inside a ``<script>`` element; equal data give equal text."""
    text = json.dumps(json_safe(data), separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c")
