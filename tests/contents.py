"""Well-formed files with wrong contents: what a validator must refuse before an evaluator sees it.

A case takes a small representation of one method, changes one number of its facts, one of its tables or one of its
shapes to something hostile, saves it through `btfref.save` and, where it is taken, evaluates it everywhere. Cases run
in child processes, since what they look for ends a process: ``python tests/contents.py contents|bytes FOLDER SEED
FIRST LAST``, where "bytes" changes bytes of good files instead.
"""

from __future__ import annotations

import copy
import json
import pickle
import select
import subprocess
import sys
from pathlib import Path

import numpy as np

#: Seconds without a word after which a case hangs; the first one compiles.
LONGEST = 90

#: What numbers of JSON become.
HOSTILE = [
    *(
        -1,
        0,
        1,
        2,
        3,
        7,
        127,
        255,
        256,
        1000,
        65535,
        2**31 - 1,
        2**31,
        2**32 - 1,
        4_000_000_000,
        2**63,
        10**30,
    ),
    *(
        0.5,
        -0.5,
        1e9,
        1e308,
        float("nan"),
        float("inf"),
        True,
        False,
        None,
        "7",
        "cubic",
        "",
        [],
        {},
        [1, 2, 3],
    ),
    "1); while (true) {} //",
]

#: What values of tables become.
FLOATS = [np.nan, np.inf, -np.inf, 3e38, -3e38, 1e30, 65504, -65504, 1e9, 4e9, -1, 0, 0.5, 1, 2, 7, 1e-45]
CODES = [0, 1, 2, 3, 7, 255, 256, 65535, 2**31 - 1, 2**31, 4_000_000_000, 2**32 - 1]

#: Facts that are records alone: no evaluator reads them, and whatever they say is taken.
RECORDS = ("parameters", "parent", "versions", "fit", "published_layout", "index_bytes")

#: Settings under which fits of a few texels are quick.
SETTINGS = {
    "svd": {"components": 2},
    "lpca": {"clusters": 3, "components": 2},
    "laplacian": {"components": (2, 1, 1), "mean": "stored"},
    "cmf": {
        "map_size": 6,
        "clusters": 3,
        "half_step": 30.0,
        "sweeps": 2,
        "terms": 2,
        "difference": True,
        "storage": "byte",
    },
    "hf": {"map_size": 6, "clusters": 3},
    "gbrdf": {"ndf_size": 8},
    "neural": {"hidden": 4, "passes": 1.0},
    "rf_lobes": {"lobes": 1},
    "lafortune": {"lobes": 1},
    "lafortune_lut": {"lobes": 1},
}


def small_btf():
    """A BTF of 6 × 4 texels: views on rings, lights without; noise-free and not constant."""
    from btfref.numerics.sphere.directions import ring_directions
    from btfref.sampling import SampledBTF
    from btfref.stress.data import bumpy
    from btfref.stress.lookups import hemisphere

    views = ring_directions([(0, 1, 0), (30, 5, 10), (70, 8, 0)])
    lights = hemisphere(np.random.default_rng(5), 11, float)
    made = bumpy(3, (6, 4), views, lights, "float16")
    return SampledBTF(made.values, made.views, made.lights, None, {})


def write_bases(folder, keys):
    """Fit the methods and keep their maps and facts in a folder, for the child processes."""
    from btfref.registry import method

    btf = small_btf()
    for key in keys:
        row = method(key)
        known = {name: value for name, value in SETTINGS.get(key, {}).items() if name in row.parameters}
        made = row.fit(btf, **known)
        (folder / f"{key}.pickle").write_bytes(pickle.dumps((key, dict(made.arrays()), made.meta)))


def numbers_in(data, path=()):
    """Paths to all values of nested facts, and to what holds them, but for records."""
    for key, value in data.items() if isinstance(data, dict) else enumerate(data):
        if not path and key in RECORDS:
            continue
        yield (*path, key)
        if isinstance(value, dict | list):
            yield from numbers_in(value, (*path, key))


def with_hostile_fact(arrays, meta, rng):
    """One fact replaced, removed or misspelt; what it was."""
    meta = copy.deepcopy(meta)
    paths = list(numbers_in(meta))
    path = paths[rng.integers(len(paths))]
    holder = meta
    for key in path[:-1]:
        holder = holder[key]
    old, kind = holder[path[-1]], rng.integers(8)
    if kind == 0:
        del holder[path[-1]]
        return arrays, meta, f"without {path}", path[-1] in DERIVED
    if kind == 1 and isinstance(holder, dict):
        holder[f"{path[-1]}_"] = holder.pop(path[-1])
        return arrays, meta, f"misspelt {path}", False
    new = HOSTILE[rng.integers(len(HOSTILE))]
    holder[path[-1]] = new
    # Names of sets are records; a surface may lie at any height.
    free = (path[-1] == "name" and isinstance(new, str)) or (path[-1] == "filter_type" and new == old)
    # Choices of the fit: the file is a sound one of another material.
    free = free or (isinstance(old, bool) and isinstance(new, bool))
    free = free or (path[-1] in POWERS and type(new) is int and new in POWERS[path[-1]])
    height = path[-1] in ("height_min", "height_max", *DERIVED)
    return arrays, meta, f"{path} = {new!r}", free or height or _same(old, new)


#: Powers that codes may be raised to.
POWERS = {"map_power": (1, 4), "scale_power": (1, 4)}

#: Constants of height fields that are made anew of the heights.
DERIVED = ("top", "bottom", "tangent_limit", "lift", "maximum_steps")


def _same(old, new):
    return type(old) is type(new) and old == new


def with_hostile_table(arrays, meta, rng):
    """Some values of one table replaced."""
    name = sorted(arrays)[rng.integers(len(arrays))]
    array = arrays[name].copy()
    codes = array.dtype.kind == "u"
    value = CODES[rng.integers(len(CODES))] if codes else FLOATS[rng.integers(len(FLOATS))]
    with np.errstate(all="ignore"):
        value = np.array(
            value % (np.iinfo(array.dtype).max + 1) if codes else value, float if not codes else None
        )
        value = value.astype(array.dtype)
    many = [slice(rng.integers(n), None) if rng.random() < 0.3 else rng.integers(n) for n in array.shape]
    array[tuple(many)] = value
    tables = name.startswith(("view_", "light_"))
    # A float32 that is rounded to its neighbour, or a 0 that is nearly one, is the same direction.
    with np.errstate(invalid="ignore", over="ignore"):
        step = np.abs(array.astype(float) - arrays[name].astype(float)).max()
    moved = not step <= np.finfo(np.float32).eps
    # Colours may be any; a direction may not, and an index only one that is there.
    free = not moved or (not tables and bool(np.isfinite(value)) if not codes else not tables)
    return {**arrays, name: array}, meta, f"{name}{many} = {value}", free


def with_hostile_shape(arrays, meta, rng):
    """One table of another shape, type or name, or none."""
    name = sorted(arrays)[rng.integers(len(arrays))]
    array, kind = arrays[name], rng.integers(7)
    rest = {key: value for key, value in arrays.items() if key != name}
    axis = int(rng.integers(array.ndim))
    if kind == 0:
        return rest, meta, f"without {name}", False
    if kind == 1:
        return {**rest, f"{name}_": array}, meta, f"misspelt {name}", False
    if kind == 2:
        other = array.astype(np.uint32 if array.dtype.kind == "f" else np.float32)
        return {**rest, name: other}, meta, f"{name} as {other.dtype}", False
    if kind == 3:
        return {**arrays, "foreign": array}, meta, f"a copy of {name}", False
    if kind == 4:
        other = np.concatenate([array, np.take(array, [0], axis)], axis)
    elif kind == 5 and array.shape[axis] > 1:
        other = np.take(array, range(array.shape[axis] - 1), axis)
    else:
        other = np.ascontiguousarray(np.moveaxis(array, axis, 0))
    # A codebook may have an entry that nobody names; tables of direction pairs may be square.
    free = other.shape == array.shape or (
        axis == 0 and name.startswith("factor_") and len(other) > len(array)
    )
    return {**rest, name: other}, meta, f"{name} {array.shape} as {other.shape}", free


CHANGES = (with_hostile_fact, with_hostile_table, with_hostile_shape)


def hostile(bases, seed, case):
    """A method, hostile arrays and facts, what was done, and whether that may be taken."""
    rng = np.random.default_rng([seed, case])
    key, arrays, meta = bases[case % len(bases)]
    change = CHANGES[rng.choice(3, p=[0.45, 0.45, 0.1])]
    return (key, *change(arrays, meta, rng))


class Everywhere:
    """A file through load, the definition, the plugin and the shader."""

    def __init__(self):
        from btfref.stress.lookups import hemisphere

        rng = np.random.default_rng(1)
        uv = rng.uniform(-1, 2, (64, 2))
        uv[:4] = [[0, 0], [1, 1], [0.5, 1e6], [-1e-9, 1]]
        self.points = [uv, hemisphere(rng, 64, float), hemisphere(rng, 64, float)]

    def __call__(self, path):
        from btfref.representations import load
        from btfref.stress.evaluators import DEFINITION, PORTS, evaluator

        loaded = load(path)
        return {
            name: np.asarray(evaluator(name, loaded, path).evaluate(*self.points))
            for name in (DEFINITION, *PORTS)
        }


def run(folder, seed, first, last):
    """A child's cases, a line of JSON for each: its number before, what came of it after."""
    import warnings

    from btfref.errors import InputError
    from btfref.registry import method
    from btfref.representations import save

    warnings.simplefilter("ignore")
    folder = Path(folder)
    bases = [pickle.loads(path.read_bytes()) for path in sorted(folder.glob("*.pickle"))]
    everywhere, out = Everywhere(), folder / f"case{first}.exr"
    for case in range(first, last):
        key, arrays, meta, what, free = hostile(bases, seed, case)
        say({"case": case, "what": f"{key}: {what}"})
        verdict = "refused"
        try:
            with np.errstate(all="ignore"):
                save(method(key).representation(arrays, meta), out)
                values = everywhere(out)
            finite = all(np.isfinite(v).all() for v in values.values())
            verdict = "taken" if free and finite else "not finite" if free else "silently accepted"
        except InputError as error:
            message = str(error)
            if "\n" in message or len(message) > 1500:
                verdict = f"a refusal of several lines: {message}"
        except (ValueError, TypeError, IndexError, AttributeError) as error:
            # What cannot even be saved: nothing reaches a file.
            verdict = "not saved" if not out.exists() else f"{type(error).__name__}: {error}"
        except Exception as error:
            verdict = f"{type(error).__name__}: {error}"
        out.unlink(missing_ok=True)
        say({"case": case, "verdict": verdict})


def run_bytes(folder, seed, first, last):
    """A child's cases of changed bytes: refused, or taken with the values and facts of the good file."""
    from btfref.errors import InputError
    from btfref.registry import method
    from btfref.representations import load, save

    folder = Path(folder)
    good, out = [], folder / f"bytes{first}.exr"
    for path in sorted(folder.glob("*.pickle")):
        key, arrays, meta = pickle.loads(path.read_bytes())
        save(method(key).representation(arrays, meta), out)
        good.append((key, out.read_bytes(), load(out)))
    for case in range(first, last):
        rng = np.random.default_rng([seed, case])
        key, data, whole = good[case % len(good)]
        changed = bytearray(data)
        # Half of the cases in the headers, which are a tenth of the file.
        reach = len(data) if rng.random() < 0.5 else len(data) // 10
        places = rng.integers(0, reach, rng.integers(1, 5))
        for at in places:
            changed[at] = rng.integers(256) if rng.random() < 0.5 else changed[at] ^ 1 << int(rng.integers(8))
        say({"case": case, "what": f"{key}: bytes {places.tolist()}"})
        out.write_bytes(changed)
        try:
            found = load(out)
            same = found.arrays().keys() == whole.arrays().keys() and found.meta == whole.meta
            same = same and all(np.array_equal(a, whole.arrays()[n]) for n, a in found.arrays().items())
            verdict = "taken" if same else "accepted with other values"
        except InputError as error:
            verdict = "refused" if "\n" not in str(error) else f"several lines: {error}"
        except Exception as error:
            verdict = f"{type(error).__name__}: {error}"
        say({"case": case, "verdict": verdict})
    out.unlink()


def say(line):
    """A line to the parent, at once."""
    sys.__stdout__.write(json.dumps(line) + "\n")
    sys.__stdout__.flush()


def children(folder, seed, cases, *, mode="contents", each=1000):
    """Run cases in child processes, one after the other.

    Returns
    -------
    counts : dict of str to int
        By verdict.
    failures : list of str
        A line for each case that is neither refused nor, where it may be, taken.
    """
    counts, failures = {}, []
    first = 0
    while first < cases:
        last = min(first + each, cases)
        command = [sys.executable, __file__, mode, str(folder), str(seed), str(first), str(last)]
        at, what = first - 1, "before its first case"
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as child:
            while True:
                if not select.select([child.stdout], [], [], LONGEST)[0]:
                    child.kill()
                    failures.append(f"case {at} hangs: {what}")
                    break
                line = child.stdout.readline()
                if not line:
                    break
                word = json.loads(line)
                if "what" in word:
                    at, what = word["case"], word["what"]
                    continue
                counts[word["verdict"]] = counts.get(word["verdict"], 0) + 1
                if word["verdict"] not in ("refused", "taken", "not saved"):
                    failures.append(f"case {at}: {word['verdict']}: {what}")
            _, said = child.communicate()
        if child.returncode:
            failures.append(f"case {at}: status {child.returncode}: {what} {said[-300:]}")
            first = at + 1
        else:
            first = last
    return counts, failures


if __name__ == "__main__":
    {"contents": run, "bytes": run_bytes}[sys.argv[1]](sys.argv[2], *map(int, sys.argv[3:6]))
