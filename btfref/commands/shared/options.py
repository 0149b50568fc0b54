"""Options that several commands have in common: one name, one meaning, one text."""

from __future__ import annotations

import textwrap
from argparse import ArgumentParser, BooleanOptionalAction, _ActionsContainer

from btfref.commands.shared.reading import count, memory_size, size
from btfref.errors import GRID, SEED, WORKERS
from btfref.numerics.interpolations import INTERPOLATIONS
from btfref.sampling.settings import DTYPES
from btfref.scene.shipped import ENVIRONMENTS, described, lights, names

#: Columns of what is added to a help text.
WIDTH = 100


def add_scene(parser: _ActionsContainer) -> None:
    """SCENE and ``-D``."""
    parser.add_argument("scene", metavar="SCENE", help=f"scene file, or {', '.join(names())}")
    add_define(parser)


def add_define(parser: _ActionsContainer, *, of: str = "the scene") -> None:
    """``-D KEY=VALUE``, as often as one likes."""
    parser.add_argument("-D", dest="define", action="append", metavar="KEY=VALUE", help=f"parameter of {of}")


def add_image(parser: _ActionsContainer) -> None:
    """Where an image goes, and how large it is."""
    parser.add_argument("-o", "--output", required=True, metavar="X.exr", help="the image to write")
    parser.add_argument("--png", action="store_true", help="also write X.png, for eyes")
    add_overwrite(parser)
    add_size(parser)


def add_tracing(parser: _ActionsContainer, variant: str) -> None:
    """Where rays are traced: ``--scheduler``, ``--workers``, ``--variant``."""
    add_scheduler(parser)
    parser.add_argument("--variant", default=variant, help="of Mitsuba (default %(default)s; cuda_ad_rgb)")


def add_scheduler(
    parser: _ActionsContainer,
    *,
    see: str = "whose workers see the same files",
    workers: str = "of the local cluster (default: one per two processors)",
) -> None:
    """Who works: ``--scheduler``, ``--workers``."""
    parser.add_argument(
        "--scheduler",
        metavar="dask|ADDRESS",
        help=f"workers of a local Dask cluster, or of the one at tcp://HOST:PORT, {see}",
    )
    parser.add_argument("--workers", type=count(1, WORKERS), metavar="N", help=workers)


def add_overwrite(parser: _ActionsContainer) -> None:
    """``--overwrite``: an output may take the place of a file of another kind."""
    parser.add_argument(
        "--overwrite", action="store_true", help="replace a file of another kind that has the output's name"
    )


def add_size(parser: _ActionsContainer, text: str = "of the image, in pixels (default: the scene's)") -> None:
    """``--size WxH``."""
    parser.add_argument("--size", type=size, metavar="WxH", help=text)


def add_grid(
    parser: _ActionsContainer, *, default: int | None = 4, text: str = "N × N sub-pixels (default 4)"
) -> None:
    """``--grid N``: the regular grid of samples in each pixel."""
    parser.add_argument("--grid", type=count(1, GRID), default=default, metavar="N", help=text)


def add_keep(parser: _ActionsContainer) -> None:
    """``--keep all|needed``: what of a file is loaded."""
    parser.add_argument(
        "--keep",
        choices=("all", "needed"),
        default="all",
        help="maps to load: all, or those that the camera's first hits need (default all)",
    )


def add_shadows(parser: _ActionsContainer, text: str) -> None:
    """``--shadows`` and ``--no-shadows``; without either the command decides."""
    parser.add_argument("--shadows", action=BooleanOptionalAction, default=None, help=text)


def add_interpolation(parser: _ActionsContainer, text: str) -> None:
    """``--interpolation blended|drawn``; without it the scene decides."""
    parser.add_argument("--interpolation", choices=INTERPOLATIONS, help=f"between measured views: {text}")


def add_only(parser: _ActionsContainer) -> None:
    """``--only METHOD[,METHOD]``."""
    parser.add_argument("--only", metavar="METHOD[,METHOD]", help="these methods instead of all")


def words(text: str | None) -> list[str] | None:
    """What stands between the commas of an option, or None where it was not given."""
    return text.split(",") if text else None


def add_seed(parser: _ActionsContainer) -> None:
    """``--seed N``."""
    parser.add_argument(
        "--seed", type=count(0, SEED), default=0, metavar="N", help="of all random numbers (default 0)"
    )


def add_dtype(parser: _ActionsContainer) -> None:
    """``--dtype`` of a store."""
    parser.add_argument(
        "--dtype",
        choices=DTYPES,
        default=DTYPES[0],
        help="of the stored values (default %(default)s)",
    )


def add_memory(
    parser: _ActionsContainer, text: str = "budget of the process, e.g. 2G (default: half of the machine's)"
) -> None:
    """``--memory SIZE``, in bytes; None where it was not given."""
    parser.add_argument("--memory", type=memory_size, metavar="SIZE", help=text)


def add_data_folder(parser: _ActionsContainer, *, tier: bool = True) -> None:
    """``--folder`` of a standard data set's packages, None for the default, and ``--tier``."""
    if tier:
        parser.add_argument(
            "--tier", default="toy", metavar="TIER", help="toy, standard or large (default %(default)s)"
        )
    parser.add_argument(
        "--folder",
        metavar="FOLDER",
        help="where packages of data sets lie (default btfref-data)",
    )


def add_json(parser: _ActionsContainer, what: str) -> None:
    """``--json``: print `what` for programs."""
    parser.add_argument("--json", action="store_true", help=f"print {what} as JSON")


def help_with_scenes(parser: ArgumentParser) -> str:
    """The help of a command that takes a scene, with the scenes, lights and environments that ship."""
    known = {name: described(name) for name in names()}
    own = {key for _, parameters in known.values() for key in parameters} - {"lights", "environment"}
    return "\n".join(
        [
            parser.format_help(),
            "scenes that ship:",
            *entries({name: summary for name, (summary, _) in known.items()}),
            "",
            "their parameters (-D KEY=VALUE):",
            *entries(
                {
                    "lights": ", ".join(lights()),
                    "environment": f"of lights=envmap: {', '.join(ENVIRONMENTS)}, or a picture.exr; "
                    "sky takes any elevation of the sun in degrees",
                }
                | {key: meaning(key, known) for key in sorted(own, key=lambda key: (key != "btf", key))}
            ),
            "",
        ]
    )


def meaning(key: str, known: dict[str, tuple[str, dict[str, str]]]) -> str:
    """What a parameter of the shipped scenes means, and which scenes have it where not all do."""
    having = [name for name, (_, parameters) in known.items() if key in parameters]
    text = known[having[0]][1][key]
    return text if len(having) == len(known) else f"{text} ({', '.join(having)})"


def entries(items: dict[str, str], *, indent: int = 2) -> list[str]:
    """Names and what they mean as lines of a help text, the latter in a column of its own."""
    column = indent + 2 + min(max(map(len, items)), 22)
    lines: list[str] = []
    for name, text in items.items():
        wrapped = textwrap.wrap(text, WIDTH - column) or [""]
        head = f"{'':{indent}}{name}"
        if len(head) + 2 > column:
            lines.append(head)
            head = ""
        lines.append(f"{head:{column}}{wrapped[0]}".rstrip())
        lines.extend(f"{'':{column}}{line}" for line in wrapped[1:])
    return lines
