"""A process's own peak of memory, whoever started it."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np

from btfref.sampling import memory


def test_a_child_does_not_inherit_the_peak_of_a_large_parent():
    held = np.ones(400 << 17)  # 400 MiB, written to
    assert memory.peak() >= held.nbytes
    child = subprocess.run(
        [sys.executable, "-c", "from btfref.sampling.memory import peak; print(peak())"],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"PYTHONPATH": str(Path(memory.__file__).parents[2])},
    )
    assert 0 < int(child.stdout) < held.nbytes / 2


def test_the_peak_is_never_less_than_what_is_in_use():
    before = memory.peak()
    held = np.ones(64 << 17)
    in_use = memory.of_this_process("VmRSS")
    assert in_use is None or held.nbytes < in_use <= memory.peak()
    assert memory.peak() >= before


def test_without_proc_the_system_is_asked_otherwise(monkeypatch):
    with_proc = memory.peak()
    monkeypatch.setattr(memory, "of_this_process", lambda field: None)
    assert memory.peak() >= with_proc // 2


def test_what_the_system_does_not_tell_is_none():
    assert memory.of_this_process("VmNothing") is None
