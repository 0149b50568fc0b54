"""Arguments of the commands that trace geometry: what of it is a user's own, and its parameters."""

from __future__ import annotations

from argparse import Namespace, _ActionsContainer
from collections.abc import Collection

from btfref.commands.shared.reading import assignments, numbers_or_file
from btfref.errors import InputError
from btfref.types import Facts

#: Options that are parameters of a user's mesh or height map.
OWN = ("bsdf", "albedo", "roughness", "amplitude", "tile", "up", "allow_seams")


def add_own_geometry(parser: _ActionsContainer) -> None:
    """``--set``, and the options of a mesh or a height map."""
    parser.add_argument(
        "--set", nargs="+", action="extend", metavar="KEY=VALUE", help="parameters of the mesostructure"
    )
    own = parser.add_argument_group("a mesh or a height map of your own")
    own.add_argument("--bsdf", metavar="FILE.xml", help="a Mitsuba BSDF, with its textures")
    own.add_argument(
        "--albedo", type=numbers_or_file, metavar="IMAGE|R,G,B", help="of a height map (default 0.5,0.5,0.5)"
    )
    own.add_argument(
        "--roughness", type=numbers_or_file, metavar="IMAGE|X", help="of a height map (default: Lambertian)"
    )
    own.add_argument(
        "--amplitude", type=float, metavar="A", help="tile units that a height of 1 stands for (default 0.1)"
    )
    own.add_argument(
        "--tile",
        type=numbers_or_file,
        metavar="X0,Y0,X1,Y1",
        help="where one tile lies in the mesh, in its units, or: bounds (default 0,0,1,1)",
    )
    own.add_argument(
        "--up", choices=("y", "z"), help="axis of the mesh that points up (default: glTF y, else z)"
    )
    own.add_argument("--allow-seams", action="store_true", default=None, help="take input that does not tile")


def own_parameters(args: Namespace, settings: Collection[str]) -> Facts:
    """Parameters of the mesostructure.

    Parameters
    ----------
    args : argparse.Namespace
    settings : collection of str
        Names that are options of the command and no parameters.

    Raises
    ------
    InputError
        ``--set`` of such an option.
    """
    parameters = assignments(args.set)
    for name in OWN:
        if getattr(args, name) is not None:
            parameters[name] = getattr(args, name)
    for key in parameters:
        if key in settings:
            option = f"--{key.replace('_', '-')}"
            raise InputError("not a parameter of the mesostructure", field="--set", got=key, expected=option)
    return parameters
