"""A sampled BTF with a known formula: the tests' quick, noise-free stand-in for a synthesized one."""

from __future__ import annotations

import fcntl
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np

from btfref.registry import method
from btfref.representations import save
from btfref.stress.data import bumpy
from btfref.stress.lookups import hemisphere


def oracle_btf(shape=(16, 12), views="ubo81", lights="ubo81", dtype="float16", seed=0):
    """The bumpy BTF of the stress suite, named so that a file says where it is from."""
    return replace(bumpy(seed, shape, views, lights, dtype), attributes={"mesostructure": "oracle"})


def scattered(n=81, seed=3):
    """Directions without rings: `n` unit vectors of the upper hemisphere, shape (n, 3)."""
    return hemisphere(np.random.default_rng(seed), n, float)


#: Sets of (views, lights): rings, rings with shifted azimuths, rings without a pole, no rings.
KINDS = {
    "ubo81": ("ubo81", "ubo81"),
    "shifted": ("ubo151", "ubo81"),
    "capped": ("10x5", "16x8"),
    "scattered": (scattered(seed=3), scattered(seed=4)),
}

#: Texels of the tables that all registered methods are fitted to: on rings; on other sets, which texels do not know of.
SHAPE, FEW = (16, 12), (8, 6)


class Fits:
    """Every method fitted once to each kind of table, with its defaults or, where it has one, its preset "quick".

    Shared by all tests and workers of a run.

    Parameters
    ----------
    directory : Path
        For the files; the same for all workers of a run, which wait for each other's fits.
    """

    def __init__(self, directory):
        self._directory, self._btfs, self._made = Path(directory), {}, {}

    def btf(self, kind="ubo81"):
        """The table; see KINDS."""
        if kind not in self._btfs:
            self._btfs[kind] = oracle_btf(SHAPE if kind == "ubo81" else FEW, *KINDS[kind])
        return self._btfs[kind]

    def __call__(self, key, kind="ubo81"):
        """The representation; not to be changed."""
        if (key, kind) not in self._made:
            self._made[key, kind] = self._shared(key, kind)
        return self._made[key, kind]

    def path(self, key, kind="ubo81"):
        """The representation's file; not to be changed."""
        self(key, kind)
        return self._directory / f"{kind}.{key}.exr"

    def _shared(self, key, kind):
        """The fit of whichever worker came first, as it was in that worker's memory."""
        kept = self._directory / f"{kind}.{key}.pickle"
        with open(self._directory / f"{kind}.{key}.lock", "w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # released when the file is closed
            if not kept.exists():
                made = method(key).quick_fit(self.btf(kind))
                save(made, self._directory / f"{kind}.{key}.exr")
                kept.write_bytes(pickle.dumps(made))
                return made
        return pickle.loads(kept.read_bytes())
