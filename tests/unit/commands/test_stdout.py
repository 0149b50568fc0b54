"""Standard output is the command's: what libraries print, in Python or below it, never gets there."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

import btfref.commands
from btfref.cli import main

#: A command whose libraries print while it works, as soon as it is done, and at the end of the process.
NOISY = """
import atexit, ctypes, os, sys
import btfref.commands.info as command
from btfref.cli import main

libc = ctypes.CDLL(None)

def noise():
    os.write(1, b"noise\\n")
    libc.printf(b"buffered noise\\n")
    print("noise of Python")
    sys.stdout.flush()
    os.system("echo noise of a child")

def read(path):
    noise()
    return {"kind": "image", "size": [1, 2]}

command.read = read
atexit.register(noise)
sys.argv = ["btfref", "info", "x", *ARGUMENTS]
status = main()
libc.printf(b"late noise\\n")
sys.exit(status)
"""


@pytest.mark.parametrize("arguments", [["--json"], []])
def test_noise_goes_to_standard_error(arguments):
    code = f"ARGUMENTS = {arguments!r}\n{NOISY}"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True
    )
    assert "noise" not in done.stdout
    for words in ("noise", "buffered noise", "noise of Python", "noise of a child", "late noise"):
        assert words in done.stderr
    if arguments:
        assert json.loads(done.stdout) == {"kind": "image", "size": [1, 2]}
    else:
        assert done.stdout.splitlines() == ["kind  image", "size  1 × 2"]


def test_standard_output_is_given_back(monkeypatch, capfd):
    """A program that calls a command goes on printing as before."""

    def read(path):
        sys.stdout.write("noise\n")
        return {"kind": "image"}

    monkeypatch.setattr("btfref.commands.info.read", read)
    before = sys.stdout
    assert main(["info", "x", "--json"]) == 0
    assert sys.stdout is before
    sys.stdout.write("after\n")
    out, err = capfd.readouterr()
    assert out.endswith("}\nafter\n")
    assert json.loads(out.removesuffix("after\n")) == {"kind": "image"}
    assert err == "noise\n"


def test_real_messages_of_openexr_and_mitsuba(tmp_path):
    """A file that OpenEXR and Mitsuba both complain about, and a log of Mitsuba's at its most talkative."""
    code = (
        "import sys, mitsuba as mi\n"
        "import btfref.commands.info as command\n"
        "from btfref.cli import main\n"
        "def read(path):\n"
        "    mi.set_variant('scalar_rgb'); mi.set_log_level(mi.LogLevel.Trace)\n"
        "    mi.Log(mi.LogLevel.Warn, 'a warning'); mi.load_dict({'type': 'scene'})\n"
        "    return {'kind': 'image'}\n"
        "command.read = read\n"
        "sys.argv = ['btfref', 'info', 'x', '--json']\n"
        "sys.exit(main())\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True
    )
    assert json.loads(done.stdout) == {"kind": "image"}
    assert "a warning" in done.stderr


def test_every_command_writes_through_one_door():
    """What a command wrote by itself would go astray."""
    modules = sorted(Path(btfref.commands.__file__).parent.rglob("*.py"))
    assert len(modules) > 10
    writing = [path.name for path in modules if "sys.stdout" in path.read_text("utf-8")]
    assert writing == ["stdout.py"]
