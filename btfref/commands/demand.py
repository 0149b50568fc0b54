"""Say what scenes need of a BTF: views, lights, texels, levels of detail, entries of its maps.

One pass over the first hits of the camera's rays. Several scenes, and several values of a parameter (--sweep), need
what any of them needs. With --views, --lights and --texels the BTF need not be there yet; `btfref synth --for` then
traces what is needed alone.

  btfref demand plane -D btf=checker.raw.exr
  btfref demand turning --sweep turn=0,5,10,15 --views ubo81 --lights ubo81 --texels 64
"""

from __future__ import annotations

import math
from argparse import ArgumentParser, Namespace, _ActionsContainer
from collections.abc import Sequence
from typing import TYPE_CHECKING

from btfref.commands.shared.options import add_define, add_grid, add_json, add_size, help_with_scenes
from btfref.commands.shared.printing import Progress, emit, emit_json, table
from btfref.commands.shared.reading import assignments, count, direction_set, number_above
from btfref.errors import TEXELS, InputError

if TYPE_CHECKING:
    from btfref.numerics.sphere.directions import DirectionSet
    from btfref.scene.demand import Demand

    #: Views, lights and texels of a BTF that is not there yet.
    Shape = tuple[DirectionSet, DirectionSet, tuple[int, int]]


def add_arguments(parser: ArgumentParser) -> None:
    """Describe the command's arguments."""
    parser.add_argument("scene", nargs="+", metavar="SCENE", help="scene files, or names of shipped scenes")
    add_scene_arguments(parser)
    parser.add_argument("--views", metavar="SET", help="of a BTF that is not there yet, as for synth")
    parser.add_argument("--lights", metavar="SET", help="likewise (default: as the views)")
    parser.add_argument(
        "--texels", type=count(1, TEXELS), metavar="N", help="likewise, per side (default 64)"
    )
    add_json(parser, "numbers and indices")


def help_text(parser: ArgumentParser, args: Namespace) -> str:
    """Help of the command, with what ships."""
    return help_with_scenes(parser)


def add_scene_arguments(parser: _ActionsContainer) -> None:
    """What says how scenes are looked at: `synth --for` shares it."""
    add_define(parser, of="the scenes")
    parser.add_argument(
        "--sweep",
        action="append",
        metavar="KEY=A,B,…",
        help="parameter of the scenes, one picture for each value",
    )
    add_grid(parser, text="N × N rays a pixel (default 4)")
    add_size(parser, "of the images, in pixels (default: the scenes')")
    parser.add_argument(
        "--margin",
        type=number_above(0),
        metavar="DEGREES",
        help="by which directions may be off (default: by what they change between samples)",
    )
    parser.add_argument(
        "--indirect", action="store_true", help="count what light may need that was reflected more than once"
    )


def run(args: Namespace) -> int:
    """Carry the command out."""
    import numpy as np

    from btfref.scene.demand import maps_needed

    shape = None
    if args.views or args.lights or args.texels:
        shape = whole_shape(args.views or "ubo81", args.lights or args.views or "ubo81", args.texels or 64)
    found = union(args, args.scene, shape)
    if shape is None:
        from btfref.representations import load

        found = {name: maps_needed(one, load(name)) for name, one in found.items()}
    if args.json:
        emit_json(
            {
                name: {
                    "shares": {what: {"needed": n, "of": m} for what, (n, m) in one.shares().items()},
                    **{what: getattr(one, what).nonzero()[0].tolist() for what in ("views", "lights")},
                    "pairs": np.argwhere(one.pairs).tolist(),
                    "least_lod": one.least_lod,
                    "lookups": one.lookups,
                }
                for name, one in found.items()
            }
        )
        return 0
    for name, one in found.items():
        emit(name)
        rows = [(what, n, m, f"{100 * n / m:.3g} %") for what, (n, m) in one.shares().items()]
        for line in table(rows, header=("what", "needed", "of", "share")):
            emit(line)
    return 0


def whole_shape(views: str, lights: str, texels: int) -> Shape:
    """Shape of a BTF that is not there yet, for :func:`btfref.scene.demand.demand`."""
    from btfref.numerics.sphere.directions import directions

    return directions(direction_set(views)), directions(direction_set(lights)), (texels, texels)


def union(args: Namespace, scenes: Sequence[str], shape: Shape | None) -> dict[str, Demand]:
    """What all scenes and all values of swept parameters need, by BTF file.

    Raises
    ------
    InputError
        For scenes without a BTF, or parameters that cannot be read.
    """
    import itertools

    from btfref.scene.demand import demand

    fixed = assignments(args.define, convert=str, option="-D")
    swept = assignments(args.sweep, convert=lambda text: text.split(","), option="--sweep")
    frames = [dict(zip(swept, values, strict=True)) for values in itertools.product(*swept.values())]
    found: dict[str, Demand] = {}
    with Progress() as progress:
        for scene, frame in itertools.product(scenes, frames):
            one = demand(
                scene,
                parameters=fixed | frame,
                grid=args.grid,
                size=args.size,
                margin=None if args.margin is None else math.radians(args.margin),
                shape=shape,
                indirect=args.indirect,
                progress=progress,
            )
            for name, needed in one.items():
                found[name] = found[name] | needed if name in found else needed
    if not found:
        raise InputError("no shape shows a BTF", file=" ".join(scenes), field="bsdf")
    return found
