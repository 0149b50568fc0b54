"""Compare an image with its reference: errors by pixel class, and gates; exit status 1 when a gate fails.

Errors are taken on linear radiance. --gate names entries of btfref/gates/tolerances.toml, e.g.
image.noise_free; without it the errors are reported only. --classes is a file that `btfref render --classes`
wrote.

With a scene in place of the reference (a Mitsuba scene file, or plane, sphere, cloth) the matching reference is
rendered, once, and the picture is judged by the gates that fit it: `btfref compare my.exr sphere --method
checker.lpca.exr -D lights=points2`. A PNG is judged as what 8 bits can show.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from btfref.commands.shared.images import load_classes
from btfref.commands.shared.options import (
    add_define,
    add_grid,
    add_json,
    add_overwrite,
    add_shadows,
    add_size,
    words,
)
from btfref.commands.shared.printing import GATE_HEADER, Progress, emit, emit_json, gate_cells, number, table
from btfref.commands.shared.reading import assignments, output_file
from btfref.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from btfref.comparison import Comparison
    from btfref.types import Facts

#: Arguments that are written, and as what: :func:`btfref.commands.shared.paths.check_paths`.
OUTPUTS = {"report": "page"}


def add_arguments(parser: ArgumentParser) -> None:
    """Describe the command's arguments."""
    parser.add_argument("test", metavar="TEST", help="image (EXR or PNG)")
    parser.add_argument("reference", metavar="REFERENCE", help="image of the same size, or a scene")
    parser.add_argument("--classes", metavar="C.png", help="pixel classes")
    parser.add_argument("--gate", metavar="KEY[,KEY]", help="gates to apply")
    scene = parser.add_argument_group("when REFERENCE is a scene")
    scene.add_argument("--method", metavar="FILE|KEY", help="the representation, or a method to fit to --btf")
    scene.add_argument("--btf", metavar="BTF", help="sampled BTF (.btf.zarr) for --method KEY")
    add_define(scene)
    add_size(scene, "of the film, in pixels (default: the picture's)")
    add_grid(scene)
    add_shadows(scene, "of the reference (default: as the picture's file says, or none)")
    scene.add_argument("--cache", metavar="FOLDER", help="of references (default: the user's cache)")
    add_json(parser, "metrics and gates")
    add_overwrite(parser)
    parser.add_argument("--report", metavar="OUT.html", help="also write a report")


def run(args: Namespace) -> int:
    """Carry the command out."""
    report = output_file(args.report, ".html") if args.report else None

    import numpy as np

    from btfref.comparison import compare
    from btfref.images import load_image
    from btfref.rendering.picture import differences, read_picture_facts

    test = load_image(args.test)
    if Path(args.reference).suffix.lower() in (".exr", ".png"):
        for name in ("method", "btf", "define"):
            if getattr(args, name):
                raise InputError(
                    "only scenes are rendered", field=f"--{name}", got=args.reference, expected="a scene"
                )
        reference = load_image(args.reference)
        classes = load_classes(args.classes) if args.classes else None
        other = read_picture_facts(args.reference)
        comparison = compare(test, reference, classes=classes, gate=words(args.gate))
    else:
        comparison, other = _against_scene(args, test)
        reference = np.asarray(comparison.reference, np.float32)
    own = read_picture_facts(args.test)
    found = differences(own, other) if own and other else []
    if report:
        from btfref.provenance import versions
        from btfref.report import Cell, write_report

        images = {"reference": reference, "test": test}
        cell = Cell(f"{Path(args.test).stem} against {Path(args.reference).stem}", images, comparison, "")
        facts = {"test": args.test, "reference": args.reference, "versions": versions()}
        write_report(report, title="Comparison", cells=[cell], facts=facts)
    if args.json:
        emit_json({**comparison.to_dict(), "differs": found})
    else:
        if found:
            emit(f"differs: {'; '.join(found)}")
        for line in lines(comparison):
            emit(line)
    return 0 if comparison.passed else 1


def _against_scene(args: Namespace, test: np.ndarray) -> tuple[Comparison, Facts]:
    """The comparison with the reference of a scene, and what that shows."""
    from btfref.rendering.picture import read_picture_facts
    from btfref.scene.facts import scene_content
    from btfref.validate.own_renderer import judge_image, reference_of, representation_for

    if args.classes:
        raise InputError("a scene has its own pixel classes", field="--classes", got=args.classes)
    parameters = assignments(args.define, convert=str, option="-D")
    if args.method:
        parameters["btf"] = str(representation_for(args.method, args.btf, cache=args.cache))
    size = args.size or (test.shape[1], test.shape[0])
    shadows = args.shadows
    if shadows is None:
        shadows = bool((read_picture_facts(args.test) or {}).get("shadows"))
    with Progress() as progress:
        found = reference_of(
            args.reference,
            parameters=parameters,
            size=size,
            grid=args.grid,
            shadows=shadows,
            cache=args.cache,
            progress=progress,
        )
    # With shadows under an environment the reference is a plain rendering of the scene.
    noisy = shadows and found.variance is not None
    facts = {
        **scene_content(args.reference, parameters, size=size),
        "grid": None if noisy else args.grid,
        "shadows": shadows,
    }
    return judge_image(args.test, found, gates=words(args.gate)), facts


def lines(comparison: Comparison) -> Iterator[str]:
    """Metrics and gates of a comparison for a reader."""
    classes = [name for name, metrics in comparison.metrics.items() if metrics]
    names = list(dict.fromkeys(name for key in classes for name in comparison.metrics[key]))
    rows = [[name, *(number(comparison.metrics[key].get(name)) for key in classes)] for name in names]
    yield from table(rows, header=["", *classes])
    if comparison.gates:
        yield ""
        yield from table(map(gate_cells, comparison.gates), header=GATE_HEADER)
    for gate in comparison.gates:
        if not gate.passed:
            yield f"FAIL  {gate.name}{f' ({gate.detail})' if gate.detail else ''}: {gate.reason}"
