"""The command line: a thin skin over the library.

Exit status: 0 fine, 1 a gate failed (for doctor: something needed is missing), 2 bad input or usage, or something that
the machine lacks, 70 an error of btfref itself, 130 interrupted, 141 the reader of the output left, 143 terminated.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import importlib
import io
import os
import signal
import sys
import tempfile
import traceback
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

from btfref.commands import COMMANDS, module_of
from btfref.commands.shared.paths import check_paths
from btfref.commands.shared.printing import printable
from btfref.commands.shared.stdout import own_stdout
from btfref.errors import BtfrefError, InputError
from btfref.provenance import __version__

#: Exit status of an error of btfref itself (EX_SOFTWARE of sysexits.h).
INTERNAL = 70

#: Letters of a line on standard error.
LONGEST = 2000

DESCRIPTION = """\
Bidirectional texture functions from geometry to pixels: synthesize or import a BTF, compress it, render the
same file with a path tracer and in real time, and compare the images.
"""

EPILOG = """\
exit status: 0 fine, 1 a gate failed, 2 bad input or usage, 70 an error of btfref itself, 130 interrupted
a first look: btfref doctor; btfref demo
"""


class _Parser(argparse.ArgumentParser):
    """Argument parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        text = printable(" ".join(message.split()))
        self.exit(2, f"{self.prog.split()[0]}: error: {text} (see `{self.prog} --help`)\n")


class _Help(argparse.Action):
    """``--help`` of a command: what its module's ``help_text(parser, args)`` makes of the arguments before it."""

    def __init__(
        self, option_strings: Sequence[str], dest: str, *, text: Callable[..., str] | None, help: str
    ) -> None:
        super().__init__(option_strings, dest, nargs=0, default=argparse.SUPPRESS, help=help)
        self.text = text

    def __call__(self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, *_: Any) -> NoReturn:
        sys.stdout.write(self.text(parser, namespace) if self.text else parser.format_help())
        parser.exit()


def build_parser() -> argparse.ArgumentParser:
    """The argument parser of ``btfref`` with all its commands.

    Returns
    -------
    argparse.ArgumentParser
        ``parse_args`` gives a namespace whose ``run(namespace)`` carries the command out and returns the exit
        status.
    """
    parser = _Parser(
        prog="btfref",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"btfref {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for name in COMMANDS:
        module = importlib.import_module(module_of(name))
        # Without docstrings (python -OO) the name has to do.
        summary = (module.__doc__ or name).splitlines()[0].rstrip(".")
        command = commands.add_parser(
            name,
            help=summary[0].lower() + summary[1:],
            description=module.__doc__,
            formatter_class=argparse.RawDescriptionHelpFormatter,
            add_help=False,
        )
        text = getattr(module, "help_text", None)
        command.add_argument("-h", "--help", action=_Help, text=text, help="show this help message and exit")
        module.add_arguments(command)
        command.set_defaults(run=module.run, outputs=getattr(module, "OUTPUTS", {}))
    return parser


def _complain(message: object) -> int:
    text = printable(" ".join(str(message).split()))
    with contextlib.suppress(OSError, ValueError, AttributeError):  # nobody to complain to
        sys.stderr.write(f"btfref: error: {text[:LONGEST]}{'…' if len(text) > LONGEST else ''}\n")
    return 2


def _os_error(error: OSError) -> str:
    where = f"{error.filename}: " if error.filename is not None else ""
    return where + (error.strerror or str(error))


def _internal(error: BaseException) -> int:
    """One line for what nobody has thought of, and where the rest of it is."""
    told = "".join(traceback.format_exception(error))
    versions = f"btfref {__version__}, Python {sys.version.split()[0]}, arguments {sys.argv[1:]!r}\n"
    try:
        with tempfile.NamedTemporaryFile(
            "w", prefix="btfref-error-", suffix=".txt", delete=False, encoding="utf-8", errors="replace"
        ) as stream:
            stream.write(versions + told)
            place = f"details: {stream.name}"
    except OSError as trouble:
        last = traceback.extract_tb(error.__traceback__)[-1]
        place = f"no place for details ({trouble.strerror}); at {last.filename}:{last.lineno}"
    _complain(f"internal error, please report it: {type(error).__name__}: {error}; {place}")
    return INTERNAL


def _out_of_memory(error: BaseException) -> bool:
    return isinstance(error, MemoryError) or (
        isinstance(error, RuntimeError) and "out of memory" in str(error)
    )


class _Terminated(BaseException):
    """SIGTERM, as an exception: what is held is given back on the way out."""


def _terminate(*_: object) -> NoReturn:
    raise _Terminated


def _say_no_more(argv: Sequence[str] | None) -> None:
    """Threads of libraries that are ended in the middle complain on their way out: in a process of ours, to nobody."""
    if argv is None:
        with contextlib.suppress(OSError, ValueError):
            sys.stderr.flush()
            os.dup2(os.open(os.devnull, os.O_WRONLY), 2)


def ready_streams() -> None:
    """Standard streams as they must be: there, and able to say whatever a file holds.

    A stream that whoever started us has closed would otherwise give its number to the next file that is opened.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.dup2(os.open(os.devnull, os.O_RDWR), number)
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, _Closed() if name == "stdout" else open(os.devnull, "r+"))
        elif hasattr(stream, "reconfigure") and name != "stdin":
            stream.reconfigure(errors="backslashreplace")


class _Closed(io.TextIOBase):
    """Standard output where there is none: writing says so."""

    def write(self, _: str) -> int:
        raise OSError(errno.EBADF, "standard output is closed")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Parameters
    ----------
    argv : list of str, optional
        Arguments after the program name; those of the process by default.

    Returns
    -------
    int
        Exit status.
    """
    if argv is None:
        # The process is ours: its streams, and SIGTERM, which ends it as an interrupt does.
        ready_streams()
        signal.signal(signal.SIGTERM, _terminate)
    try:
        given = list(sys.argv[1:] if argv is None else argv)
        for text in given:
            if any(0xD800 <= ord(letter) <= 0xDFFF for letter in text):
                raise InputError(
                    "a name that is not UTF-8", got=text.encode("utf-8", "backslashreplace").decode()
                )
        args = build_parser().parse_args(given)
        check_paths(args, args.outputs)
        with own_stdout(restore=argv is not None):
            status = args.run(args)
    except SystemExit as stop:  # argparse: 0 after --help, 2 after a usage error
        return int(stop.code or 0)
    except BtfrefError as error:
        return _complain(error)
    except BrokenPipeError:
        return 141
    except OSError as error:
        return _complain(_os_error(error))
    except KeyboardInterrupt:
        sys.stderr.write("\nbtfref: interrupted\n")
        _say_no_more(argv)
        return 130
    except _Terminated:
        _complain("terminated")
        _say_no_more(argv)
        return 143
    except ImportError as error:
        if error.name is None or error.name.split(".")[0] in ("btfref", "mitsuba_plugins"):
            return _internal(error)
        return _complain(f"a library that btfref needs cannot be loaded: {error}; run btfref doctor")
    except Exception as error:
        if _out_of_memory(error):
            return _complain(f"not enough memory: {error or 'for what was asked'}")
        return _internal(error)
    return status
