"""The command line: a thin skin over the library.

Exit status: 0 fine, 1 a gate failed or something needed is missing, 2 bad input or usage, 130 interrupted.
"""

from __future__ import annotations

import argparse
import importlib
import keyword
import os
import sys

from btfref.commands import COMMANDS
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

    def error(self, message):
        self.exit(2, f"{self.prog.split()[0]}: error: {message} (see `{self.prog} --help`)\n")


def build_parser():
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
        summary = module.__doc__.splitlines()[0].rstrip(".")
        command = commands.add_parser(
            name,
            help=summary[0].lower() + summary[1:],
            description=module.__doc__,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        module.add_arguments(command)
        command.set_defaults(run=module.run)
    return parser


def _complain(message):
    sys.stderr.write(f"btfref: error: {' '.join(str(message).split())}\n")
    return 2


def _os_error(error):
    where = f"{error.filename}: " if error.filename is not None else ""
    return where + (error.strerror or str(error))


def main(argv=None):
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
        status = args.run(args)
        sys.stdout.flush()
    except SystemExit as stop:  # argparse: 0 after --help, 2 after a usage error
        return stop.code or 0
    except BtfrefError as error:
        return _complain(error)
    except BrokenPipeError:
        # The reader (head, less) has left. Point stdout away so that the interpreter's last flush is quiet.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except OSError as error:
        return _complain(_os_error(error))
    except KeyboardInterrupt:
        sys.stderr.write("\nbtfref: interrupted\n")
        return 130
    return status
