"""What a worker is told of code: it runs the same, or refuses in one line."""

import os
import sys

import pytest

from btfref.errors import InputError
from btfref.provenance import code
from btfref.provenance.told import accepted, order, refuse_changed_code, refuse_other_code, told

#: A module of btfref that needs little, and a package of somebody else's, which is read from its folder.
ROOT, GUEST = "btfref.outputs", "toldguest.method:fit"


@pytest.fixture
def guest(tmp_path, monkeypatch):
    """A file of a package that brings a method, whose text may change."""
    package = tmp_path / "toldguest"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "method.py").write_text("def fit():\n    return 1\n")
    monkeypatch.syspath_prepend(tmp_path)
    # As if this process had begun when the last of the files came.
    monkeypatch.setattr(code, "_BEGAN", (package / "method.py").stat().st_mtime_ns)
    code.forget()
    yield package / "method.py"
    sys.modules.pop("toldguest", None)
    code.forget()


def test_a_process_accepts_its_own_code(tmp_path, guest, monkeypatch):
    began = guest.stat().st_ctime_ns
    monkeypatch.setattr("btfref.provenance.told._began", lambda: began)
    with order(tmp_path / "shared", [ROOT], [], [GUEST], more=3) as path:
        assert accepted(path)["more"] == 3
        assert set(accepted(path)["told"]["files"]) >= {"btfref/outputs.py", "toldguest/method.py"}
        assert path.parent == tmp_path / "shared"
    assert not path.exists()


def test_other_code_of_a_package_is_named(guest):
    asked = told([ROOT], [], [GUEST])
    guest.write_text("def fit():\n    return 2\n")
    code.forget()
    own = told([ROOT], [], [GUEST])
    with pytest.raises(InputError, match=r"code of its own; field 'toldguest/method\.py'; got [0-9a-f]{12};"):
        refuse_other_code(asked, own)
    refuse_other_code(own, own)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"versions": {"numpy": "1.0"}}, r"a version of its own; field 'numpy'; got .*; expected 1\.0"),
        ({"files": {"btfref/outputs.py": "0" * 64}}, r"field 'btfref/outputs\.py'; .*expected 0{12}$"),
        ({"files": {"btfref/gone.py": "0" * 64}}, r"field 'btfref/gone\.py'; got nothing"),
    ],
)
def test_what_differs_is_named(change, said):
    own = told([ROOT], [])
    asked = {kind: {**own[kind], **change.get(kind, {})} for kind in own}
    with pytest.raises(InputError, match=said):
        refuse_other_code(asked, own)


def test_a_process_that_began_before_its_code_changed_refuses(guest):
    """Its modules may be the old ones, though the files that it reads now are those of who asks."""
    told([ROOT], [], [GUEST])
    refuse_changed_code(guest.stat().st_ctime_ns)
    with pytest.raises(InputError, match=r"toldguest/method\.py: a worker began before its code changed"):
        refuse_changed_code(guest.stat().st_ctime_ns - 1)
    # A copy that keeps an old time of change is seen by when it came.
    os.utime(guest, (1, 1))
    code.forget()
    told([ROOT], [], [GUEST])
    with pytest.raises(InputError, match="began before"):
        refuse_changed_code(guest.stat().st_ctime_ns - 1)


def test_a_worker_without_a_method_says_so(tmp_path):
    path = tmp_path / "x.job.partial"
    path.write_text('{"roots": ["btfref.outputs"], "methods": ["elsewhere"], "places": [], "told": {}}')
    with pytest.raises(InputError, match=r"a worker lacks code; got .*elsewhere"):
        accepted(path)


def test_a_folder_that_is_not_seen_is_named(tmp_path):
    with pytest.raises(InputError, match="a worker does not see the folder"):
        accepted(tmp_path / "x.job.partial")
