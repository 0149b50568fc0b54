"""A port package: the composed shader of a representation, its textures and constants, for any OpenGL 3.3 or WebGL 2.

Everything is what the real-time renderer itself compiles and uploads (:mod:`btfref.rendering.gl.device`).
"""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from btfref import conventions
from btfref.errors import InputError
from btfref.outputs import new_folder
from btfref.registry import method
from btfref.rendering.gl import composer, device
from btfref.representations.protocol import max_lod
from btfref.types import Facts, PathLike

if TYPE_CHECKING:
    from btfref.rendering.environment_light.prepared import Prepared
    from btfref.representations.protocol import Representation

#: What layout files call themselves, and the version of their fields.
FORMAT, VERSION = "btfref port package", 1

#: Samplers that a fragment stage of OpenGL ES 3.0 has at least (table 6.33), and so WebGL 2; OpenGL 3.3 has as many.
MOST_SAMPLERS = 16

#: Layers that an array texture of OpenGL ES 3.0 and of OpenGL 3.3 has at least.
MOST_LAYERS = 256

#: Type of a table -> internal format, format, type and kind of sampler: names without "GL_", as WebGL has them.
_FORMATS = {
    "float16": ("RGBA16F", "RGBA", "HALF_FLOAT", "sampler2DArray"),
    "float32": ("RGBA32F", "RGBA", "FLOAT", "sampler2DArray"),
    "uint32": ("RGBA32UI", "RGBA_INTEGER", "UNSIGNED_INT", "usampler2DArray"),
    "uint8": ("RGBA8", "RGBA", "UNSIGNED_BYTE", "sampler2DArray"),
}

#: Functions of the shader that a host calls.
ENTRY = {
    "vec3 btf_eval(vec2 uv, vec3 w_light, vec3 w_view, float lod)": "B in 1/sr, linear Rec. 709, the cosine of the"
    " light included; directions are unit vectors of the local frame, away from the surface; 0 below the horizon."
    " lod: 0 is the finest level; methods without levels ignore it",
    "float btf_lod(vec2 uv_dx, vec2 uv_dy)": "level of detail of a pixel from dFdx(uv) and dFdy(uv) (fragment stage,"
    " outside of branches); the next btf_eval spreads its lookups along the pixel's footprint",
    "mat3 shading_frame(vec3 normal, vec3 dp_du, vec3 side)": "takes world vectors to the local frame: z is the unit"
    " normal, x is dp/du at a right angle to it; side is the unit normal of the side that dp/du x dp/dv points to",
    "vec2 malformed(vec2 uv, vec3 w_light, vec3 w_view)": "for hosts that count: (1, .) for a direction that is not"
    " finite or far from unit length, (., 1) for a coordinate that is not finite",
}

#: The conventions that a host must keep, for people.
CONVENTIONS = {
    "value": conventions.COSINE_CONVENTION
    + "; multiply by the light's irradiance perpendicular to it, and by nothing else",
    "unit": conventions.UNITS,
    "colour": conventions.COLOUR_SPACE,
    "directions": "w_light, w_view: unit vectors away from the surface in the local frame; a BTF is not reciprocal:"
    " exchanged directions give a wrong picture",
    "frame": "z: normal of the surface; x: dp/du at a right angle to z; y = z x x, or the negative of that where the"
    " texture is mirrored; right-handed where it is not",
    "uv": "any finite numbers, the texture repeats; row 0 at v = 0, texel centres at (i + 1/2)/n",
    "texture rows": "the first byte is texel (0, 0) of layer 0: upload as it is, never flipped",
    "byte order": "little-endian",
    "negative values": "lossy methods may return small negative values; they belong to the sum over lights",
    "sampling": "texelFetch alone: filter NEAREST, one level, no extension",
}

_UNIFORM = re.compile(r"^uniform\s+(?:highp\s+)?(\w+)\s+(\w+)\s*;", re.MULTILINE)
_COMMENT = re.compile(r"//.*")


@dataclass(frozen=True)
class PortTexture:
    """A texture of a package.

    Attributes
    ----------
    name : str
        Of the sampler.
    table : btfref.rendering.gl.device.FoldedTable
        Its texels.
    shape : tuple of int
        Of the table before it is folded; the last axis counts channels, padded to a multiple of 4.
    """

    name: str
    table: device.FoldedTable
    shape: tuple[int, ...]

    @property
    def data(self) -> bytes:
        """The texels, little-endian, layer by layer, row by row."""
        values = self.table.values
        return values.astype(values.dtype.newbyteorder("<"), copy=False).tobytes()

    def to_dict(self) -> Facts:
        """JSON-able form, without the texels."""
        internal, layout, kind, sampler = _FORMATS[self.table.values.dtype.name]
        return {
            "name": self.name,
            "sampler": sampler,
            "target": "TEXTURE_2D_ARRAY",
            "width": self.table.width,
            "height": self.table.height,
            "layers": self.table.layers,
            "internal_format": internal,
            "format": layout,
            "type": kind,
            "filter": "NEAREST",
            "wrap": "CLAMP_TO_EDGE",
            "levels": 1,
            "bytes": self.table.values.nbytes,
            "table_shape": list(self.shape),
        }


@dataclass(frozen=True)
class PortPackage:
    """What another renderer needs to show a representation.

    Attributes
    ----------
    shader : str
        One text without version line, for both of :data:`btfref.rendering.gl.composer.VERSIONS`; no stage of its own.
    textures : tuple of PortTexture
        Those that the text declares, by name.
    defines : dict
        Constants that stand at the head of the text.
    uniforms : dict of str to list
        Values that are no textures, by name; empty without an environment.
    passes : tuple of dict
        Uniforms of pictures that add up, where an environment needs several; one, empty, elsewhere.
    facts : dict
        JSON-able: the method and the file.
    """

    shader: str
    textures: tuple[PortTexture, ...]
    defines: Facts
    passes: tuple[Facts, ...]
    facts: Facts

    def source(self, version: str, main: str = "") -> str:
        """The text with its version line and a host's own, ready to compile.

        Parameters
        ----------
        version : {"330 core", "300 es"}
        main : str
            GLSL that calls the entry functions.

        Raises
        ------
        InputError
            For another version.
        """
        if version not in composer.VERSIONS:
            expected = " or ".join(composer.VERSIONS)
            raise InputError("unknown GLSL target", got=version, expected=expected)
        return composer.VERSIONS[version] + self.shader + main

    @property
    def nbytes(self) -> int:
        """Bytes of the textures on the GPU."""
        return sum(texture.table.values.nbytes for texture in self.textures)

    @property
    def needs(self) -> str:
        """What a device must have, in one line."""
        tables = [texture.table for texture in self.textures]
        width, height = max(t.width for t in tables), max(t.height for t in tables)
        return (
            f"OpenGL 3.3 or WebGL 2 without extensions; array textures of {width} × {height} texels"
            f" × {max(t.layers for t in tables)} layers; {len(tables)} samplers in one stage;"
            f" {self.nbytes} bytes of textures"
        )

    def layout(self) -> Facts:
        """The package without shader and texels, JSON-able."""
        return {
            "format": FORMAT,
            "version": VERSION,
            **self.facts,
            "shader": {
                "file": "btf.glsl",
                "versions": {name: line.strip() for name, line in composer.VERSIONS.items()},
                "order": "version line, btf.glsl, the host's own text",
                "entry": ENTRY,
            },
            "needs": self.needs,
            "limits": {"samplers": len(self.textures), "bytes": self.nbytes},
            "defines": self.defines,
            "uniforms": {},
            "passes": [_listed(values) for values in self.passes],
            "textures": [
                {**texture.to_dict(), "file": f"textures/{texture.name}.bin"} for texture in self.textures
            ],
            "conventions": CONVENTIONS,
        }

    def embedded(self, *, data: bool = True) -> Facts:
        """The whole package as one JSON-able dict, for a page that stands alone.

        Parameters
        ----------
        data : bool
            Whether the textures' bytes are there.

        Returns
        -------
        dict
            :meth:`layout`, with ``shader["text"]`` and, in each of ``textures``, ``base64`` in place of ``file``.
        """
        layout = self.layout()
        layout["shader"]["text"] = self.shader
        for entry, texture in zip(layout["textures"], self.textures, strict=True):
            del entry["file"]
            if data:
                entry["base64"] = base64.b64encode(texture.data).decode("ascii")
        return layout

    def write(self, folder: PathLike) -> None:
        """Write ``btf.glsl``, ``layout.json`` and ``textures/NAME.bin`` into a new folder.

        Raises
        ------
        InputError
            For a folder that is there already, or none to make it in.
        """
        with new_folder(folder) as draft:
            self.write_into(draft)

    def write_into(self, folder: Path) -> None:
        """The same into a folder that is there."""
        (folder / "textures").mkdir()
        for texture in self.textures:
            (folder / "textures" / f"{texture.name}.bin").write_bytes(texture.data)
        (folder / "btf.glsl").write_text(self.shader, encoding="utf-8")
        text = json.dumps(self.layout(), indent=2, ensure_ascii=False)
        (folder / "layout.json").write_text(text + "\n", encoding="utf-8")


def port_package(
    rep: Representation, *, filter_type: str | None = None, light: Prepared | None = None
) -> PortPackage:
    """The port package of a representation.

    Parameters
    ----------
    rep : Representation
    filter_type : {"nearest", "bilinear"}, optional
        Overrides the file's texel filter.
    light : btfref.rendering.environment_light.prepared.Prepared, optional
        How an environment lights it: ``btf_environment``, its tables and its passes come along.

    Returns
    -------
    PortPackage

    Raises
    ------
    InputError
        For tables that devices of OpenGL 3.3 and WebGL 2 need not be able to hold, and for radiance transfer.
    """
    if light is not None and light.transfer is not None:
        raise InputError(
            "radiance transfer belongs to the mesh of a scene",
            field="environment",
            expected="another way to light",
        )
    arrays, defines = device.shader_tables(rep, filter_type=filter_type, light=light)
    rows, columns = rep.meta["texels"]
    defines |= {"LEVEL_0_ROWS": int(rows), "LEVEL_0_COLUMNS": int(columns)}
    # The same text whatever order a file has its maps in.
    defines = dict(sorted(defines.items()))
    shader, directories = device.shader_file(rep)
    source = composer.compose(
        "hosts/library.glsl",
        defines,
        representation=shader,
        environment=light.shader if light is not None else None,
        directories=directories,
    )
    text = composer.portable(source)
    textures = tuple(_textures(text, arrays))
    row = method(rep.meta["method"])
    facts = {
        "method": row.key,
        "title": row.title,
        "paper": row.paper,
        "texels": [int(rows), int(columns)],
        "filter_type": filter_type or rep.meta["filter_type"],
        "max_lod": float(max_lod(rep)),
        "views": rep.meta.get("views"),
        "lights": rep.meta.get("lights"),
    }
    return PortPackage(
        text,
        textures,
        {name.upper(): _plain(value) for name, value in defines.items()},
        light.passes if light is not None else ({},),
        facts,
    )


def _textures(text: str, arrays: dict[str, np.ndarray]) -> Iterator[PortTexture]:
    """The tables that a shader declares and reads; InputError for what devices need not have."""
    code = _COMMENT.sub("", text)
    declared = {name: kind for kind, name in _UNIFORM.findall(code)}
    found = []
    for name in sorted(declared.keys() & arrays.keys()):
        # Once is the declaration: most methods have no use for all direction tables.
        if len(re.findall(rf"\b{name}\b", code)) == 1:
            continue
        texture = PortTexture(name, device.folded(arrays[name], name), arrays[name].shape)
        if texture.table.layers > MOST_LAYERS:
            raise InputError(
                "a table is too large for a port",
                field=name,
                got=f"{texture.table.layers} layers of 4096 × 4096 texels",
                expected=f"at most {MOST_LAYERS}, which every OpenGL 3.3 and WebGL 2 has",
            )
        found.append(texture)
    if len(found) > MOST_SAMPLERS:
        raise InputError(
            "a method reads more textures than a stage of a port can",
            got=len(found),
            expected=f"at most {MOST_SAMPLERS}, which every OpenGL 3.3 and WebGL 2 has",
        )
    return iter(found)


def _plain(value: Any) -> Any:
    """A constant as JSON has it."""
    return value.item() if hasattr(value, "item") else value


def _listed(values: Facts) -> Facts:
    return {name: np.asarray(value).tolist() for name, value in values.items()}
