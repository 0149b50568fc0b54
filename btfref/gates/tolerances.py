"""The limits of gates and tests, read from ``tolerances.toml``, where each has its reason."""

from __future__ import annotations

import copy
import difflib
import functools
import tomllib
from importlib import resources

from btfref.errors import InputError

#: Entries of a gate that steer its test and are no limits.
PARAMETERS = (
    "reason",
    "class",
    "may_be_empty",
    "floor",
    "failing_above",
    "significance",
    "power",
    "atol",
    "rtol",
)


def parse(text, *, file="tolerances.toml"):
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
    gates = {}

    def walk(prefix, table):
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
def _shipped():
    return parse(resources.files("btfref.gates").joinpath("tolerances.toml").read_text("utf-8"))


def gate_keys():
    """Keys of all gates, in the order of the file."""
    return tuple(_shipped())


def gate_table(key):
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
    gates = _shipped()
    if key not in gates:
        # Not all of them: the message stays a line.
        like = difflib.get_close_matches(key, gates, n=5, cutoff=0.4) or [
            k for k in gates if k.startswith("image.")
        ]
        raise InputError(
            "unknown gate", file="tolerances.toml", got=repr(key), expected=f"such as {', '.join(like)}"
        )
    return copy.deepcopy(gates[key])


def limits(table):
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


def tolerance(key):
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
    gates = _shipped()
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


def reason(key):
    """Why the limits of a gate are what they are.

    Parameters
    ----------
    key : str
        A gate or ``"gate.entry"``.

    Returns
    -------
    str
    """
    gates = _shipped()
    return gates[key]["reason"] if key in gates else gate_table(key.rpartition(".")[0])["reason"]
