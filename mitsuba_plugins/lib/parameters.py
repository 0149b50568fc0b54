"""Names of the parameters of the plugin ``btf``: what is none of them is a slip, and would say nothing."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from btfref.errors import InputError

if TYPE_CHECKING:
    from btfref.types import PathLike

#: As the plugin's own documentation in ``mitsuba_plugins/base.py`` explains them.
PARAMETERS = (
    "filename",
    "filter_type",
    "interpolation",
    "scale",
    "to_uv",
    "sampling",
    "views",
    "lights",
    "entries",
    "levels",
    "lod",
    "lod_bias",
    "lod_unit",
    "pixel_angle",
    "camera",
)


def refuse_unknown(names: Iterable[str], *, file: PathLike | None = None) -> None:
    """Refuse a parameter that the plugin does not have.

    Parameters
    ----------
    names : iterable of str
        Of the parameters that are given.
    file : str, optional
        Scene and line, for the message.

    Raises
    ------
    InputError
        That names the parameter and those that exist.
    """
    for name in names:
        if name not in PARAMETERS:
            # What is nested without a name is named by Mitsuba.
            field = "a nested object" if name.startswith("_arg_") else name
            raise InputError(
                "a btf material has no such property", file=file, field=field, expected=", ".join(PARAMETERS)
            )
