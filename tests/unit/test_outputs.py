"""Files and folders appear when they are complete, and nothing is left behind otherwise."""

import os
import stat

import pytest

from btfref.errors import InputError
from btfref.outputs import new_file, new_folder


@pytest.fixture(params=[0o022, 0o077])
def umask(request):
    """The umask that new files get."""
    before = os.umask(request.param)
    yield request.param
    os.umask(before)


def test_a_file_appears_when_it_is_complete(tmp_path):
    path = tmp_path / "a.json"
    path.write_text("old")
    with new_file(path) as draft:
        draft.write_text("new")
        assert draft.name == path.name
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert os.listdir(tmp_path) == ["a.json"]


def test_a_folder_appears_when_it_is_complete(tmp_path):
    with new_folder(tmp_path / "maps") as draft:
        (draft / "a.exr").write_text("a")
        assert not (tmp_path / "maps").exists()
    assert os.listdir(tmp_path) == ["maps"]
    assert os.listdir(tmp_path / "maps") == ["a.exr"]


def test_a_name_without_folder_is_of_the_working_directory(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with new_file("a") as draft:
        draft.write_text("a")
    assert os.listdir(tmp_path) == ["a"]


def test_permissions_are_those_of_new_files(tmp_path, umask):
    with new_file(tmp_path / "file") as draft:
        draft.write_text("")
    with new_folder(tmp_path / "folder") as draft:
        (draft / "file").write_text("")
    modes = {
        name: stat.S_IMODE((tmp_path / name).stat().st_mode) for name in ("file", "folder", "folder/file")
    }
    assert modes == {"file": 0o666 & ~umask, "folder": 0o777 & ~umask, "folder/file": 0o666 & ~umask}


@pytest.mark.parametrize("new", [new_file, new_folder])
def test_a_failure_leaves_nothing(tmp_path, new):
    def fail():
        with new(tmp_path / "out") as draft:
            (draft / "part" if draft.is_dir() else draft).write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert os.listdir(tmp_path) == []


def test_a_failure_keeps_the_older_file(tmp_path):
    path = tmp_path / "a"
    path.write_text("old")
    with pytest.raises(ZeroDivisionError), new_file(path) as draft:
        draft.write_text(str(1 // 0))
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["a"]


@pytest.mark.parametrize("new", [new_file, new_folder])
def test_no_folder_to_stand_in(tmp_path, new):
    with pytest.raises(InputError, match="no such folder"), new(tmp_path / "none" / "out"):
        pass


def test_a_folder_that_exists_is_refused(tmp_path):
    (tmp_path / "a").mkdir()
    with pytest.raises(InputError, match="exists already"), new_folder(tmp_path / "a"):
        pass
    assert os.listdir(tmp_path) == ["a"]
