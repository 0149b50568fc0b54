"""The limits of gates and tests, read from ``tolerances.toml``, where each has its reason.

The file beside this module holds the gates that methods share; ``limits/`` holds a file per wing with what only the
tests of that wing ask for. A method brings what concerns it alone in a ``tolerances.toml`` beside its own module
(`btfref.registry.Method.tolerances`): gates of its own, and ``[GATE.METHOD]`` with limits that it has instead of those
of a shared gate (`tolerance_of`).
"""

from __future__ import annotations

import copy
import difflib
import functools
import tomllib
import warnings
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

from btfref.errors import InputError
from btfref.registry import methods
from btfref.types import PathLike

#: Entries of a gate that steer its test and are no limits.
PARAMETERS = (
    "reason",
    "class",
    "may_be_empty",
    "floor",
    "argument_ulps",
    "beyond_rounding",
    "failing_above",
    "significance",
    "power",
    "atol",
    "rtol",
)

#: Entries of a gate: limits and settings by name, and the ``reason``.
Gate = dict[str, Any]


def parse(text: str, *, file: PathLike = "tolerances.toml") -> dict[str, Gate]:
    """Gates of a TOML text, flattened to dotted keys.

    Parameters
    ----------
    text : str
        TOML; a table with entries of its own is a gate and must hold a non-empty ``reason``.
    file : path-like, optional
        Named in errors.

    Returns
    -------
    dict of str to dict
        Gate key → entries.

    Raises
    ------
    InputError
        Broken TOML, a gate without a reason, or an entry that is neither number, text nor truth value.
    """
    try:
        tree = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(str(error), file=file) from error
    gates: dict[str, Gate] = {}

    def walk(prefix: str, table: dict[str, Any]) -> None:
        leaves = {name: value for name, value in table.items() if not isinstance(value, dict)}
        if leaves:
            if not str(leaves.get("reason", "")).strip():
                raise InputError("gate without a reason", file=file, field=prefix)
            for name, value in leaves.items():
                if not isinstance(value, (bool, int, float, str)):
                    raise InputError(
                        "not a limit", file=file, field=f"{prefix}.{name}", got=value, expected="a number"
                    )
            gates[prefix] = leaves | {"reason": " ".join(leaves["reason"].split())}
        for name, value in table.items():
            if isinstance(value, dict):
                walk(f"{prefix}.{name}" if prefix else name, value)

    walk("", tree)
    return gates


@functools.cache
def _gates() -> dict[str, Gate]:
    """All gates: the shared ones, then those of the wings and of the methods."""
    folder = resources.files("btfref.gates")
    gates = parse(folder.joinpath("tolerances.toml").read_text("utf-8"))
    wings = sorted(folder.joinpath("limits").iterdir(), key=lambda wing: wing.name)
    # A dict, since methods that share a folder share its file.
    files = dict.fromkeys(row.tolerances for row in methods().values())
    shipped = Path(str(resources.files("btfref"))).resolve()
    for file in (*wings, *files):
        if file is None or not file.is_file():
            continue
        try:
            own = parse(file.read_text("utf-8"), file=str(file))
            if twice := sorted(own.keys() & gates.keys()):
                raise InputError("gates that are there already", file=str(file), got=", ".join(twice))
        except (InputError, OSError, ValueError) as error:
            # A package's own limits that cannot be used are missed by its method, and by no other.
            if shipped in Path(str(file)).resolve().parents:
                raise
            warnings.warn(f"limits of another package are left out: {error}", stacklevel=2)
            continue
        gates |= own
    return gates


def gate_keys() -> tuple[str, ...]:
    """Keys of all gates, the shared ones first, in the order of the files."""
    return tuple(_gates())


def gate_table(key: str) -> Gate:
    """A copy of the entries of one gate.

    Parameters
    ----------
    key : str
        Dotted name such as ``"image.noise_free"``.

    Returns
    -------
    dict

    Raises
    ------
    InputError
        Unknown key.
    """
    gates = _gates()
    if key not in gates:
        # Not all of them: the message stays a line.
        like = difflib.get_close_matches(key, gates, n=5, cutoff=0.4) or [
            k for k in gates if k.startswith("image.")
        ]
        raise InputError(
            "unknown gate", file="tolerances.toml", got=repr(key), expected=f"such as {', '.join(like)}"
        )
    return copy.deepcopy(gates[key])


def limits(table: Mapping[str, object]) -> dict[str, float]:
    """The upper and lower limits among the entries of a gate, in their order.

    Parameters
    ----------
    table : dict
        Entries of a gate.

    Returns
    -------
    dict of str to float
        Without settings such as ``floor``; names that begin with ``min_`` are lower limits.
    """
    return {
        name: float(value)
        for name, value in table.items()
        if name not in PARAMETERS
        and not name.endswith("_parameter")
        and isinstance(value, (int, float))
        and not isinstance(value, bool)
    }


def tolerance(key: str) -> float:
    """One number of ``tolerances.toml``.

    Parameters
    ----------
    key : str
        ``"gate.entry"``, for example ``"image.noise_free.p999"``; or the gate alone when it holds one number.

    Returns
    -------
    float

    Raises
    ------
    InputError
        Unknown key, an entry that is not a number, or a gate alone with several numbers.
    """
    gates = _gates()
    if key in gates:
        numbers = {
            name: value
            for name, value in gates[key].items()
            if isinstance(value, (int, float)) and not isinstance(value, bool)
        }
        if len(numbers) != 1:
            raise InputError(
                "several numbers", file="tolerances.toml", field=key, expected=f"one of {list(numbers)}"
            )
        return float(next(iter(numbers.values())))
    gate, _, entry = key.rpartition(".")
    value = gate_table(gate).get(entry)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InputError(
            "no such number", file="tolerances.toml", field=key, expected=f"one of {list(gates[gate])}"
        )
    return float(value)


def tolerance_of(method: str, key: str) -> float:
    """One number as it holds for a method: its own where it brings one, else the shared one.

    Parameters
    ----------
    method : str
        Key of the method.
    key : str
        ``"gate.entry"`` of a shared gate; the method's own limit is ``entry`` of the gate ``gate.method``.

    Returns
    -------
    float

    Raises
    ------
    InputError
        As `tolerance`.
    """
    gate, _, entry = key.rpartition(".")
    own = f"{gate}.{method}"
    return tolerance(f"{own}.{entry}" if entry in _gates().get(own, {}) else key)


def reason(key: str) -> str:
    """Why the limits of a gate are what they are.

    Parameters
    ----------
    key : str
        A gate or ``"gate.entry"``.

    Returns
    -------
    str
    """
    gates = _gates()
    return str((gates[key] if key in gates else gate_table(key.rpartition(".")[0]))["reason"])
