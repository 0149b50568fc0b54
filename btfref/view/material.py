"""What the page shows of a file: the composed shaders and tables of its representation, and words about it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from btfref.rendering.gl import composer, device
from btfref.rendering.ports.package import port_package
from btfref.types import Facts
from btfref.view.packing import Packed

if TYPE_CHECKING:
    from btfref.representations.protocol import Representation

#: Of WebGL 2.
TARGET = "300 es"

#: Lights of the page; ``btfref/view/assets/lights.js`` has as many.
N_LIGHTS = 2


@dataclass(frozen=True)
class Material:
    """A representation for the page.

    Parameters
    ----------
    name : str
        What the page calls it.
    representation : Representation
    facts : sequence of str
        Lines about the file.
    note : str
        What a viewer must know, such as that a quick fit is shown in place of the file.
    """

    name: str
    representation: Representation
    facts: Sequence[str] = ()
    note: str = ""


def material_data(material: Material, packed: Packed) -> Facts:
    """A material as the page reads it; its tables go to ``packed``.

    Parameters
    ----------
    material : Material
    packed : btfref.view.packing.Packed

    Returns
    -------
    dict
        JSON-able.

    Raises
    ------
    InputError
        For tables that WebGL 2 or a page cannot hold.
    """
    rep = material.representation
    package = port_package(rep)
    shader, directories = device.shader_file(rep)
    defines = {**package.defines, "N_LIGHTS": N_LIGHTS}

    def composed(host: str) -> str:
        return composer.compose(host, defines, representation=shader, directories=directories, target=TARGET)

    return {
        "name": material.name,
        "note": material.note,
        "facts": list(material.facts),
        "texels": package.facts["texels"],
        "shaders": {
            "vertex": composed("hosts/mesh.vert"),
            "fragment": composed("hosts/mesh.frag"),
            "hemisphere": composed("viewer/hemisphere.frag"),
        },
        "textures": [
            {"name": texture.name, **packed.add(texture.table.values)} for texture in package.textures
        ],
    }


def shared_shaders() -> Facts:
    """Shaders of the page that know no material, by name."""
    names = {
        "mesh": "hosts/mesh.vert",
        "screen": "hosts/screen.vert",
        "point": "viewer/point.frag",
        "display": "viewer/display.frag",
        "add": "viewer/add.frag",
    }
    return {name: composer.compose(file, target=TARGET) for name, file in names.items()}
