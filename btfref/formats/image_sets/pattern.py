"""A lab's own names of images: a pattern says where the angles stand in them."""

from __future__ import annotations

import re
import string
from collections.abc import Callable
from pathlib import PurePosixPath

from btfref.errors import InputError
from btfref.formats.image_sets.angles import Angles, in_order

#: Fields of a pattern: polar angle and azimuth of the camera, and of the light, in degrees.
FIELDS = ("tv", "pv", "tl", "pl")

_NUMBER = r"(-?\d{1,4}(?:\.\d{1,9})?)"


def angles_by(pattern: str) -> Callable[[str], Angles | None]:
    """A function that finds the angles in names of a pattern.

    Parameters
    ----------
    pattern : str
        Such as ``cam_{tv}_{pv}_light_{tl}_{pl}.jpg``: each of the four fields once; ``*`` stands for any letters. With
        a ``/`` it is compared with the last folders of a name too.

    Returns
    -------
    callable
        ``angles_in(name)``: (θ_l, φ_l, θ_v, φ_v) in degrees, or None for names of another kind.

    Raises
    ------
    InputError
        A field that is unknown, missing or there twice.
    """
    try:
        parts = list(string.Formatter().parse(pattern))
    except (ValueError, TypeError) as error:
        raise InputError(
            "pattern of names", field="pattern", got=error, expected="{tv}, {pv}, {tl}, {pl}"
        ) from None
    fields, text = [], ""
    for literal, field, spec, conversion in parts:
        text += re.escape(literal).replace(r"\*", "[^/]*")
        if field is None:
            continue
        if field not in FIELDS or spec or conversion:
            written = field + (f"!{conversion}" if conversion else "") + (f":{spec}" if spec else "")
            raise InputError(
                "unknown field of a pattern",
                field="pattern",
                got=f"{{{written}}}",
                expected="{tv}, {pv} (camera), {tl}, {pl} (light): polar angle and azimuth in degrees",
            )
        fields.append(field)
        text += _NUMBER
    if sorted(fields) != sorted(FIELDS):
        raise InputError(
            "fields of a pattern",
            field="pattern",
            got=pattern,
            expected="{tv}, {pv}, {tl} and {pl}, each once",
        )
    depth = pattern.count("/") + 1
    compiled = re.compile(text)

    def angles_in(name: str) -> Angles | None:
        found = compiled.fullmatch("/".join(PurePosixPath(name).parts[-depth:]))
        if found is None:
            return None
        return in_order(dict(zip(fields, map(float, found.groups()), strict=True)))

    return angles_in
