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
    "info",
    "view",
    "render",
    "realtime",
    "compare",
    "demand",
    "validate",
    "bench",
    "stress",
)
