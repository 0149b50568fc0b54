"""Hostile contents and changed bytes of representations: refused in one line, or harmless; never a signal or a hang.

The cases and their verdicts are in ``tests/contents.py``.
"""

import contents
import pytest

from btfref.registry import methods

#: Cases of the default run, and of the long one.
FEW, MANY = 120, 10_000
FEW_BYTES = 440


@pytest.fixture(scope="module")
def bases(tmp_path_factory, renderers):
    """A folder with a small fit of every method."""
    folder = tmp_path_factory.mktemp("contents")
    contents.write_bases(folder, methods())
    return folder


def check(folder, cases, mode):
    counts, failures = contents.children(folder, 21, cases, mode=mode)
    print(counts)  # noqa: T201
    assert not failures, "\n".join(failures[:20])
    # Neither verdict proves anything where the other one never comes.
    assert counts["refused"] > cases // 4
    assert counts["taken"] > 0


def test_hostile_contents(bases):
    check(bases, FEW, "contents")


def test_changed_bytes(bases):
    check(bases, FEW_BYTES, "bytes")


@pytest.mark.long
def test_many_hostile_contents(bases):
    check(bases, MANY, "contents")


@pytest.mark.long
def test_many_changed_bytes(bases):
    check(bases, MANY, "bytes")
