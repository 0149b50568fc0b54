"""The commands of the command line, one module each.

A module has a docstring (its first line is the help line), ``add_arguments(parser)`` and ``run(args)``, which
returns the exit status; ``help_text(parser, args)``, where it has one, is what ``--help`` prints. Modules import the
library inside ``run``, so that ``btfref --help`` stays quick.
"""

COMMANDS = (
    "doctor",
    "demo",
    "synth",
    "import",
    "export",
    "fit",
    "refine",
    "info",
    "view",
    "render",
    "realtime",
    "compare",
    "demand",
    "query",
    "evaluate",
    "dataset",
    "validate",
    "bench",
    "board",
    "stress",
)

#: Modules that do not stand in this folder under the command's name.
ELSEWHERE = {
    "board": "datasets.board",
    "dataset": "datasets.dataset",
    "evaluate": "queries.evaluate",
    "fit": "fitting.fit",
    "import": "import_",  # a module cannot carry the name of a keyword
    "query": "queries.query",
    "refine": "fitting.refine",
}


def module_of(command: str) -> str:
    """Full name of a command's module."""
    return f"{__name__}.{ELSEWHERE.get(command, command)}"
