"""Materials of mesostructure: BSDFs as plain JSON types with their textures as arrays beside them.

Textures are read when the mesostructure is built: what is traced later, in whatever process, is what was
fingerprinted then. In a BSDF's dict ``{"type": "bitmap", "array": NAME}`` stands for the texture ``NAME`` of
the part, and ``{"type": "transform", "matrix": rows}`` for a transformation.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

from btfref.errors import BtfrefError, InputError, MissingDependencyError
from btfref.mesostructure.vertex_texture import PLUGIN, register

if TYPE_CHECKING:
    from btfref.mesostructure.base import Part
    from btfref.types import Facts, JitArray, PathLike

#: Images that are read by way of Pillow.
_IMAGES = (".png", ".jpg", ".jpeg", ".tga", ".bmp", ".tif", ".tiff")

#: Modes of Pillow that are read as another one.
_PLAIN = {"P": "RGB", "CMYK": "RGB", "YCbCr": "RGB", "LAB": "RGB", "1": "L", "LA": "RGBA", "PA": "RGBA"}

#: How far normals of a map may point into the surface, and what share of them may do so: resampling does that to edges.
MOST_BELOW = 0.01


def load_bsdf(part: Part) -> JitArray:
    """The Mitsuba BSDF of a part; set a variant first.

    Parameters
    ----------
    part : Part

    Returns
    -------
    mitsuba.BSDF

    Raises
    ------
    InputError
        Mitsuba's reason, when it refuses the material.
    """
    import mitsuba as mi

    try:
        return mi.load_dict(_ready(part.bsdf, part.textures, mi))
    except (RuntimeError, ValueError, TypeError) as error:
        # The last line is the reason, those before it say where in Mitsuba's own source.
        reason = " ".join(str(error).split())
        raise InputError("material that Mitsuba refuses", field="bsdf", got=reason) from error


def _ready(value: Any, textures: dict[str, np.ndarray], mi: ModuleType) -> Any:
    """A BSDF's dict with its arrays and transformations as Mitsuba takes them."""
    if not isinstance(value, dict):
        return value
    if value.get("type") == "transform":
        return mi.ScalarTransform4f(np.asarray(value["matrix"], np.float64))
    if value.get("type") == PLUGIN:
        register(mi)
    result = {key: _ready(entry, textures, mi) for key, entry in value.items() if key != "array"}
    if "array" in value:
        array = np.array(textures[value["array"]], order="C")  # a copy: Mitsuba wants it writable
        result["bitmap"] = mi.Bitmap(array)
        # As when Mitsuba reads the file: whole numbers are sRGB (where the texture is not raw).
        result["bitmap"].set_srgb_gamma(array.dtype.kind == "u")
    return result


def read_image(path: PathLike, *, field: str = "file") -> np.ndarray:
    """An image as an array, row 0 first.

    Parameters
    ----------
    path : path-like
        PNG or TIFF (8 or 16 bits), JPEG, TGA, BMP or OpenEXR.
    field : str
        Name of the parameter, for messages.

    Returns
    -------
    ndarray (rows, columns, channels)
        uint8 or uint16 as stored, or float32; one channel (grey) or three (an opacity is dropped).

    Raises
    ------
    InputError
        A file that is missing, cannot be read, or holds values that are not finite.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError("no such file", file=path, field=field)
    image = _read_exr(path, field) if path.suffix.lower() == ".exr" else _read_pillow(path, field)
    image = image[..., None] if image.ndim == 2 else image
    image = image[..., :1] if image.shape[2] < 3 else image[..., :3]
    if not np.isfinite(image).all():
        raise InputError("image holds a value that is not finite", file=path, field=field)
    return np.ascontiguousarray(image)


def _read_exr(path: Path, field: str) -> np.ndarray:
    from btfref.images.openexr import opened

    try:
        with opened(path) as file:
            channels = {name: np.array(c.pixels, np.float32) for name, c in file.channels().items()}
    except (RuntimeError, OSError, ValueError) as error:
        raise InputError("cannot read the image", file=path, field=field, got=error) from None
    for names in (("RGB",), ("RGBA",), ("R", "G", "B"), ("Y",)):
        if all(name in channels for name in names):
            planes = [channels[name] for name in names]
            return planes[0] if len(planes) == 1 else np.stack(planes, -1)
    return next(iter(channels.values()))


def _read_pillow(path: Path, field: str) -> np.ndarray:
    if path.suffix.lower() not in _IMAGES:
        raise InputError(
            "kind of image", file=path, field=field, expected=f"one of {', '.join((*_IMAGES, '.exr'))}"
        )
    try:
        return decode_pixels(path.read_bytes(), path, field)
    except OSError as error:
        raise InputError("cannot read the image", file=path, field=field, got=error) from None


def decode_pixels(data: bytes, path: PathLike, field: str) -> np.ndarray:
    """Pixels of an image in memory, with its opacity.

    Parameters
    ----------
    data : bytes
        PNG, JPEG or TIFF of 8 or 16 bits, TGA, BMP or WebP.
    path : path-like
        For errors.
    field : str

    Returns
    -------
    ndarray (rows, columns, 1, 3 or 4)
        uint8 or uint16 as stored, or float32; row 0 first.

    Raises
    ------
    InputError
    """
    from PIL import Image

    try:
        with Image.open(io.BytesIO(data)) as image:
            if _deep_colours(image, data):
                array = _deep(data, image.format or "", path, field)
            elif "transparency" in image.info:
                array = np.asarray(image.convert("RGBA"))
            else:
                array = np.asarray(image.convert(_PLAIN[image.mode]) if image.mode in _PLAIN else image)
    except BtfrefError:
        raise
    except Exception as error:  # Pillow's decoders raise many kinds
        raise InputError("cannot read the image", file=path, field=field, got=error) from None
    # Pillow hands 16-bit grey out as 32-bit whole numbers in some versions.
    array = array.astype(np.uint16) if array.dtype == np.int32 else array
    array = array[..., None] if array.ndim == 2 else array
    return array[..., :1] if array.shape[2] == 2 else array


def _deep_colours(image: Any, data: bytes) -> bool:
    """Whether an image has 16-bit colours, which Pillow would cut to 8 bits."""
    if image.format == "PNG":  # bit depth and colour type of the header
        return len(data) > 26 and data[24] == 16 and data[25] != 0
    return image.format == "TIFF" and image.mode.startswith("RGB") and 16 in image.tag_v2.get(258, ())


def _deep(data: bytes, kind: str, path: PathLike, field: str) -> np.ndarray:
    """Pixels of a PNG by way of Mitsuba, of a TIFF by way of tifffile; uint16."""
    if kind == "TIFF":
        try:
            import tifffile
        except ImportError:
            raise MissingDependencyError(
                f"{path}: TIFF with 16-bit colours needs tifffile", "pip install tifffile, or save it as PNG"
            ) from None
        return np.asarray(tifffile.imread(io.BytesIO(data)))
    import mitsuba as mi

    previous = mi.variant()
    if previous is None:
        mi.set_variant("scalar_rgb")
    try:
        stream = mi.MemoryStream(len(data))
        stream.write(data)
        stream.seek(0)
        return np.array(mi.Bitmap(stream))
    except RuntimeError as error:
        raise InputError("cannot read the image", file=path, field=field, got=error) from None


def as_numbers(image: np.ndarray) -> np.ndarray:
    """Values of an image as float64: whole numbers as shares of their range, floats as they are."""
    if image.dtype.kind == "f":
        return image.astype(np.float64)
    return image / float(np.iinfo(image.dtype).max)


def linear_colours(image: np.ndarray) -> np.ndarray:
    """Colours of an image, linear RGB float32 (rows, columns, 3): 8- and 16-bit images hold sRGB."""
    from btfref.numerics.colour import decode_srgb

    values = as_numbers(image) if image.dtype.kind == "f" else decode_srgb(as_numbers(image))
    return np.broadcast_to(values, (*values.shape[:2], 3)).astype(np.float32)


def check_normals(codes: np.ndarray, path: PathLike, field: str) -> None:
    """InputError for an image that is no normal map.

    Parameters
    ----------
    codes : ndarray (rows, columns, 3)
        Shares of their range: a normal is twice that less 1.
    path : path-like
    field : str
    """
    below = float((2 * codes[..., 2] - 1 < -MOST_BELOW).mean())
    if below > MOST_BELOW:
        raise InputError(
            "no normal map: normals point into the surface",
            file=path,
            field=field,
            got=f"{below:.3g} of the texels with a blue below one half",
            expected="blue of at least one half",
        )


def texture(name: str) -> Facts:
    """A texture of plain numbers (linear colours) for a BSDF's dict; the array is the part's."""
    return {"type": "bitmap", "array": name, "raw": True, "format": "variant"}


def bsdf_from_xml(path: PathLike) -> tuple[Facts, dict[str, np.ndarray]]:
    """The BSDF of a Mitsuba XML file, with its textures.

    Parameters
    ----------
    path : path-like
        A file whose root is one ``<bsdf>``, or a ``<scene>`` with one BSDF that no other holds.

    Returns
    -------
    bsdf : dict
    textures : dict of str to ndarray

    Raises
    ------
    InputError
        A file that is missing or malformed, that holds no BSDF or several, or a texture that cannot be read.
    """
    import mitsuba as mi

    path = Path(path)
    if not path.is_file():
        raise InputError("no such file", file=path, field="bsdf")
    previous = mi.variant()
    mi.set_variant("scalar_rgb")  # parsing needs types; nothing is instantiated
    try:
        config = mi.parser.ParserConfig("scalar_rgb")
        config.merge_equivalent = config.merge_meshes = False
        state = mi.parser.parse_file(config, str(path))
        mi.parser.transform_all(config, state)
        return _described(state.nodes, path, mi)
    except (RuntimeError, ValueError, TypeError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError("cannot read the material", file=path, field="bsdf", got=error) from None
    finally:
        if previous is not None:
            mi.set_variant(previous)


def _described(nodes: Sequence[Any], path: Path, mi: ModuleType) -> tuple[Facts, dict[str, np.ndarray]]:
    materials = {k for k, node in enumerate(nodes) if str(node.type) == "ObjectType.BSDF"}
    inner = {index for k in materials for index in _references(nodes[k].props)}
    outer = sorted(materials - inner)
    if len(outer) != 1:
        raise InputError(
            "materials in the file", file=path, field="bsdf", got=len(outer), expected="one <bsdf>"
        )
    textures: dict[str, np.ndarray] = {}
    return _node(nodes, outer[0], path, textures, mi), textures


def _references(props: Any) -> list[int]:
    return [props[key].index() for key in props.keys() if type(props[key]).__name__ == "ResolvedReference"]


def _node(
    nodes: Sequence[Any], index: int, path: Path, textures: dict[str, np.ndarray], mi: ModuleType
) -> Facts:
    """One plugin of a parsed file as a dict of JSON types; images and data files become textures."""
    props = nodes[index].props
    result = {"type": props.plugin_name()}
    for key in props.keys():
        value = props[key]
        kind = type(value).__name__
        if kind == "ResolvedReference":
            result[key] = _node(nodes, value.index(), path, textures, mi)
        elif kind.startswith("ScalarColor") or kind.startswith("Color"):
            result[key] = {"type": "rgb", "value": [float(x) for x in value]}
        elif "Transform" in kind:
            result[key] = {"type": "transform", "matrix": np.array(value.matrix, np.float64).tolist()}
        elif isinstance(value, bool | int | float | str):
            result[key] = value
        else:
            raise InputError(
                "kind of value in a material", file=path, field=key, got=kind, expected="number, text, colour"
            )
    if isinstance(result.get("filename"), str):
        _take_file(result, path, textures)
    return result


def _take_file(plugin: Facts, path: Path, textures: dict[str, np.ndarray]) -> None:
    """Read a plugin's file, looked up beside the XML file first, as Mitsuba does."""
    name = plugin["filename"]
    found = next((p for p in (path.parent / name, Path(name)) if p.is_file()), None)
    if found is None:
        raise InputError("no such file", file=path, field="filename", got=name)
    if plugin["type"] == "bitmap":
        key = f"texture_{len(textures)}"
        textures[key] = read_image(found, field="filename")
        del plugin["filename"]
        plugin["array"] = key
    else:
        # Only Mitsuba can read it: the path goes on, the bytes are fingerprinted.
        plugin["filename"] = str(found.resolve())
        textures[f"file_{len(textures)}"] = np.frombuffer(found.read_bytes(), np.uint8)
