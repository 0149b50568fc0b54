"""Make, check and describe the standard data sets: synthetic BTFs with known truth.

list names the materials, make makes their packages (one or all; a run that was interrupted goes on where it stopped),
verify checks every file against its SHA-256, the version and what was published, card describes them. Packages lie in
FOLDER/SET/TIER/MATERIAL. The toy tier (16 x 16 texels) takes minutes, standard (64 x 64) hours, large days.

  btfref dataset list
  btfref dataset make btf-1/knit --tier toy
  btfref dataset make all --tier toy --folder data --memory 2G
  btfref dataset verify all --folder data
  btfref dataset card knit --folder data
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

from btfref.commands.shared.options import add_data_folder, add_json, add_memory, add_tracing
from btfref.commands.shared.printing import Progress, bytes_text, emit, emit_json, number, table
from btfref.errors import InputError
from btfref.sampling.settings import SynthesisSettings
from btfref.types import Facts

ACTIONS = ("list", "make", "verify", "card")

#: Arguments that are written, and as what: :func:`btfref.commands.shared.paths.check_paths`.
OUTPUTS = {"folder": "folder"}

#: Numbers of a card: their names in a manifest and what they are.
_NUMBERS = {
    "rank_1_percent": "rank for 1 % error",
    "parallax": "parallax from 0 to 60 degrees, tiles",
    "dynamic_range": "99.9 % quantile of B over its mean",
    "indirect": "share of indirect light",
    "hidden": "share of the hemisphere that is hidden",
}


def add_arguments(parser: ArgumentParser) -> None:
    """Describe the command's arguments."""
    parser.add_argument("action", choices=ACTIONS, metavar="ACTION", help=", ".join(ACTIONS))
    parser.add_argument(
        "name",
        nargs="?",
        metavar="NAME",
        help="MATERIAL, SET/MATERIAL or all (needed to make; default all)",
    )
    add_data_folder(parser)
    parser.add_argument("--overwrite", action="store_true", help="replace packages of another version")
    add_memory(parser, "budget of the synthesis, e.g. 2G; without influence on any byte")
    add_tracing(parser, SynthesisSettings.variant)
    add_json(parser, "what was found")


def run(args: Namespace) -> int:
    """Carry the command out."""
    from btfref.datasets.sets import FOLDER, VARIANT

    args.folder = args.folder or FOLDER
    if args.variant != VARIANT:
        raise InputError(
            "bytes of sets are those of one variant", field="--variant", got=args.variant, expected=VARIANT
        )
    if args.action == "make" and args.name is None:
        raise InputError("what is made must be named", field="NAME", expected="a material, or all")
    return {"list": _list, "make": _make, "verify": _verify, "card": _card}[args.action](args)


def _list(args: Namespace) -> int:
    from dataclasses import asdict

    from btfref.datasets.sets import SETS, find

    chosen = SETS.values() if args.name is None else [find(args.name)[0]]
    if args.json:
        emit_json([asdict(one) for one in chosen])
        return 0
    for one in chosen:
        emit(f"{one.name} {one.version}, {len(one.materials)} materials, CC0; tiers: {', '.join(one.tiers)}")
        rows = [(m.name, m.kind, m.difficulty) for m in one.materials]
        for line in table(rows, header=("material", "kind", "difficulty")):
            emit(line)
    return 0


def _make(args: Namespace) -> int:
    from btfref.datasets.making import make
    from btfref.datasets.manifest import read_manifest

    with Progress() as progress:
        made = make(
            args.name,
            args.folder,
            tier=args.tier,
            overwrite=args.overwrite,
            progress=progress,
            memory=args.memory,
            scheduler=args.scheduler,
            workers=args.workers,
        )
    manifests = [read_manifest(where) for where in made]
    if args.json:
        keys = ("set", "set_version", "tier", "material", "bytes", "digest", "noise", "difficulty")
        emit_json(
            [
                {"folder": str(where)} | {key: found[key] for key in keys}
                for where, found in zip(made, manifests, strict=True)
            ]
        )
        return 0
    for where, found in zip(made, manifests, strict=True):
        emit(f"{where}: {bytes_text(found['bytes'])}, {_noise(found)}")
    if len(made) > 1:
        emit(f"together: {bytes_text(sum(found['bytes'] for found in manifests))}")
    return 0


def _noise(manifest: Facts) -> str:
    parts = (f"{100 * value:.2g} % ({name})" for name, value in manifest["noise"].items())
    return f"noise of the grids {', '.join(parts)}"


def _verify(args: Namespace) -> int:
    from btfref.datasets.verifying import verify

    with Progress() as progress:
        found = verify(args.name or "all", args.folder, tier=args.tier, progress=progress)
    if args.json:
        emit_json(found)
    else:
        for one in found:
            emit(
                f"{one['name']} ({one['tier']}): {'sound' if one['passed'] else 'NOT SOUND'}, {one['published']}"
            )
            for line in (*one["problems"], *one["notes"]):
                emit(f"  {line}")
    return 0 if all(one["passed"] for one in found) else 1


def _card(args: Namespace) -> int:
    from btfref.datasets.making import place
    from btfref.datasets.manifest import MANIFEST, read_manifest
    from btfref.datasets.sets import find

    chosen, materials = find(args.name or "all")
    folders = [place(args.folder, chosen, args.tier, one) for one in materials]
    there = {
        one.name: read_manifest(where)
        for one, where in zip(materials, folders, strict=True)
        if len(materials) == 1 or (where / MANIFEST).is_file()
    }
    if not there:
        raise InputError("no packages there", file=args.folder, expected="btfref dataset make all")
    if args.json:
        emit_json(list(there.values()))
        return 0
    for name, found in there.items():
        emit(f"# {found['set']}/{name}, {found['tier']} tier, version {found['set_version']}")
        emit()
        emit(f"{found['family']}: {found['difficulty_in_words']}")
        emit()
        for key, label in _NUMBERS.items():
            emit(f"- {label}: {number(found['difficulty'][key])}")
        emit(f"- {_noise(found)}")
        emit(
            f"- {bytes_text(found['bytes'])}, SHA-256 of all files {found['digest'][:16]}…, {found['licence']}"
        )
        parameters = ", ".join(f"{key} {value}" for key, value in found["parameters"].items())
        emit(f"- mesostructure {found['mesostructure']}: {parameters}")
        emit()
    return 0
