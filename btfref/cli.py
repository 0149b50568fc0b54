"""The command line: a thin skin over the library.

Exit status: 0 fine, 1 a gate failed or something needed is missing, 2 bad input or usage, 130 interrupted.
"""

from __future__ import annotations

import argparse
import importlib
import keyword
import sys
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

from btfref.commands import COMMANDS
from btfref.commands.shared.stdout import own_stdout
from btfref.errors import BtfrefError
from btfref.provenance import __version__

DESCRIPTION = """\
Bidirectional texture functions from geometry to pixels: synthesize or import a BTF, compress it, render the
same file with a path tracer and in real time, and compare the images.
"""

EPILOG = """\
exit status: 0 fine, 1 a gate failed, 2 bad input or usage
a first look: btfref doctor; btfref demo
"""


class _Parser(argparse.ArgumentParser):
    """Argument parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog.split()[0]}: error: {message} (see `{self.prog} --help`)\n")


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
        # A module cannot carry the name of a keyword: the command `import` is in import_.py.
        module = importlib.import_module(f"btfref.commands.{name}{'_' * keyword.iskeyword(name)}")
        summary = (module.__doc__ or "").splitlines()[0].rstrip(".")
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
        command.set_defaults(run=module.run)
    return parser


def _complain(message: object) -> int:
    sys.stderr.write(f"btfref: error: {' '.join(str(message).split())}\n")
    return 2


def _os_error(error: OSError) -> str:
    where = f"{error.filename}: " if error.filename is not None else ""
    return where + (error.strerror or str(error))


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
    try:
        args = build_parser().parse_args(argv)
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
        return 130
    return status
