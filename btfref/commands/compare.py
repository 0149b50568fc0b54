"""Compare an image with its reference: errors by pixel class, and gates; exit status 1 when a gate fails.

Errors are taken on linear radiance. --gate names an entry of btfref/compare/tolerances.toml, e.g.
image.noise_free; without it the errors are reported only. --classes is a file that `btfref render --classes`
wrote.
"""

from __future__ import annotations

from pathlib import Path

from btfref.commands._shared import emit, emit_json, load_classes, number, output_file, table


def add_arguments(parser):
    """Describe the command's arguments."""
    parser.add_argument("test", metavar="TEST", help="image (EXR or PNG)")
    parser.add_argument("reference", metavar="REFERENCE", help="image of the same size")
    parser.add_argument("--classes", metavar="C.png", help="pixel classes")
    parser.add_argument("--gate", metavar="KEY", help="gate to apply")
    parser.add_argument("--json", action="store_true", help="print metrics and gates as JSON")
    parser.add_argument("--report", metavar="OUT.html", help="also write a report")


def run(args):
    """Carry the command out."""
    report = output_file(args.report, ".html") if args.report else None

    from btfref.compare import compare, load_image

    test, reference = load_image(args.test), load_image(args.reference)
    classes = load_classes(args.classes) if args.classes else None
    comparison = compare(test, reference, classes=classes, gate=args.gate)
    if report:
        from btfref.report import Cell, write_report
        from btfref.versions import versions

        images = {"reference": reference, "test": test}
        cell = Cell(f"{Path(args.test).stem} against {Path(args.reference).stem}", images, comparison, "")
        facts = {"test": args.test, "reference": args.reference, "versions": versions()}
        write_report(report, title="Comparison", cells=[cell], facts=facts)
    if args.json:
        emit_json(comparison.to_dict())
    else:
        for line in lines(comparison):
            emit(line)
    return 0 if comparison.passed else 1


def lines(comparison):
    """Metrics and gates of a comparison for a reader."""
    classes = [name for name, metrics in comparison.metrics.items() if metrics]
    names = list(dict.fromkeys(name for key in classes for name in comparison.metrics[key]))
    rows = [[name, *(number(comparison.metrics[key].get(name)) for key in classes)] for name in names]
    yield from table(rows, header=["", *classes])
    if comparison.gates:
        yield ""
    for gate in comparison.gates:
        verdict = "pass" if gate.passed else "FAIL"
        yield f"{verdict}  {gate.name}: {number(gate.value)}, limit {number(gate.limit)}"
        if not gate.passed:
            yield f"      {gate.reason}"
