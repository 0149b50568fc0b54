"""Judge methods on a standard data set and write the board: a static page, sortable and filterable.

RESULTS are files *.row.json, or folders of them: those that btfref bench methods --dataset btf-1 -o FOLDER writes,
and any that others hand in with their answers to the test queries beside (the guide says how).

  btfref bench methods --dataset btf-1 --folder data -o results
  btfref board results outsider.row.json --folder data -o site
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

from btfref.commands.shared.options import add_data_folder, add_json
from btfref.commands.shared.printing import Progress, bytes_text, emit, emit_json, number, table

#: Arguments that are written, and as what: :func:`btfref.commands.shared.paths.check_paths`.
OUTPUTS = {"output": "folder"}


def add_arguments(parser: ArgumentParser) -> None:
    """Describe the command's arguments."""
    parser.add_argument("results", nargs="+", metavar="RESULTS", help="files *.row.json, or folders of them")
    add_data_folder(parser, tier=False)
    parser.add_argument("-o", "--output", required=True, metavar="FOLDER", help="of the site")
    add_json(parser, "what the page holds")


def run(args: Namespace) -> int:
    """Carry the command out."""
    from btfref.board.site import write_site
    from btfref.datasets.sets import FOLDER

    with Progress() as progress:
        found = write_site(args.results, args.output, folder=args.folder or FOLDER, progress=progress)
    if args.json:
        emit_json(found)
        return 0
    emit(
        f"{found['file']}: {found['rows']} rows, {found['materials']} materials, {bytes_text(found['bytes'])}"
    )
    rows = sorted(
        found["board"]["rows"], key=lambda row: (row["rank"]["point"]["place"] or 10**6, row["name"])
    )
    lines = [
        (
            "–"
            if (rank := row["rank"]["point"])["place"] is None
            else f"{rank['place']} ({rank['from']} to {rank['to']})",
            row["name"],
            number(rank["score"]),
            len(row["materials"]),
        )
        for row in rows
    ]
    for line in table(lines, header=("rank", "method", "score", "materials")):
        emit(line)
    return 0
