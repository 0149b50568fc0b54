"""Materials of glTF 2.0 (sec. 3.9) as Mitsuba BSDFs: metallic-roughness as ``principled``, two-sided."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from btfref.errors import InputError
from btfref.mesostructure.materials import as_numbers, check_normals, linear_colours, texture
from btfref.mesostructure.readers.container import GltfFile
from btfref.mesostructure.readers.notes import Notes
from btfref.mesostructure.readers.pieces import Look, Piece, mirrored
from btfref.mesostructure.vertex_texture import ATTRIBUTES, vertex_texture
from btfref.types import Facts

_WRAPS = {10497: "repeat", 33071: "clamp", 33648: "mirror"}

_NEAREST = 9728

#: Copies of an image that are laid side by side where its two axes wrap differently.
_MOST_COPIES = 64


@dataclass
class _Use:
    """How a material looks a texture up.

    Attributes
    ----------
    image : int
    set : int
        Of texture coordinates.
    matrix : ndarray (3, 3)
        From those coordinates to the image's.
    wraps : (str, str)
        Along u and v.
    filter : {"bilinear", "nearest"}
    scale : float
        Of a normal texture.
    """

    image: int
    set: int
    matrix: np.ndarray
    wraps: tuple[str, str]
    filter: str
    scale: float


class Material:
    """A material of a primitive, read when it is asked for.

    Parameters
    ----------
    file : GltfFile
    index : int or None
        None is the standard's default material.
    sets : dict of int to ndarray (V, 2)
        Texture coordinates.
    colours : ndarray (V, 3 or 4) or None
        Linear colours of the vertices, with opacity.
    notes : Notes
        Takes what is ignored.
    """

    def __init__(
        self,
        file: GltfFile,
        index: int | None,
        sets: dict[int, np.ndarray],
        colours: np.ndarray | None,
        notes: Notes,
    ) -> None:
        self.file, self.sets, self.colours, self.notes = file, sets, colours, notes
        self.facts: Facts = {} if index is None else file.entry("materials", index)
        self.name = str(self.facts.get("name") or f"material {index}")
        self.default = index is None
        self.factors: Facts = self.facts.get("pbrMetallicRoughness", {})

    @property
    def has_normals(self) -> bool:
        """Whether there is a normal texture."""
        return "normalTexture" in self.facts

    def looks(self, piece: Piece) -> list[Look]:
        """The BSDF; two where a normal map is seen mirrored on some faces."""
        try:
            return self._looks(piece)
        except InputError:
            raise
        except (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise self.file.refusal("cannot read the material", self.name, got=repr(error)) from None

    def _looks(self, piece: Piece) -> list[Look]:
        self._refuse_and_note()
        colour, packed = (
            self._use(self.factors, name) for name in ("baseColorTexture", "metallicRoughnessTexture")
        )
        normal = self._use(self.facts, "normalTexture")
        main = normal or colour or packed
        look = Look({}, uv=None if main is None else self.sets[main.set])
        if main is not None and normal is not None:
            # x of the normal map follows u of its own coordinates, which are what Mitsuba sees.
            look.uv = _moved(self.sets[main.set], main.matrix)
        inner: Facts = {"type": "principled", "specular": 0.5}
        lookups = _Lookups(self, piece, look, main, follows=normal is not None)
        inner["base_color"] = self._base_colour(lookups, colour)
        # Green is roughness, blue metallic, both plain numbers; principled's α is the square of its roughness too.
        for name, key, channel in (("roughness", "roughnessFactor", 1), ("metallic", "metallicFactor", 2)):
            factor = self._number(self.factors, key, 1.0)
            inner[name] = factor
            if packed is not None:
                image = self._channels(packed, name)[..., channel : channel + 1]
                inner[name] = lookups.image(name, packed, as_numbers(image) * factor)
        opacity = self._opacity(lookups, colour)
        if normal is None:
            look.bsdf = _finished(inner, opacity)
            return [look]
        flat = as_numbers(self._channels(normal, "normal"))
        check_normals(flat, self.file.path, f"{self.name}: normalTexture")
        flat = flat * 2 - 1
        flat *= [normal.scale, normal.scale, 1.0]
        turned = mirrored(piece, self.sets[normal.set] if look.uv is None else look.uv)
        looks = []
        # Green points up in the image, y of the frame is n × x: they are opposed where the image is mirrored.
        for faces, sign in ((~turned, 1.0), (turned, -1.0)):
            if faces.any():
                one = Look({}, dict(look.textures), look.uv, look.attributes, faces)
                own = _Lookups(self, piece, one, main, follows=True)
                bumped = {
                    "type": "normalmap",
                    "use_shadowing_function": False,
                    "normalmap": own.image("normal", normal, (flat * [1.0, sign, 1.0] + 1) / 2),
                    "bsdf": inner,
                }
                one.bsdf = _finished(bumped, opacity)
                looks.append(one)
        return looks

    def _refuse_and_note(self) -> None:
        """What a BTF cannot show is refused, what has no part in light is noted."""
        emission = np.asarray(self.facts.get("emissiveFactor", (0, 0, 0)), np.float64)
        if emission.any() and "emissiveTexture" in self.facts:
            use = self._use(self.facts, "emissiveTexture")
            if use is not None and not self.file.image(use.image)[..., :3].any():
                emission[:] = 0
        if emission.any():
            raise self.file.refusal(
                "material that emits light: a BTF tells what is reflected",
                self.name,
                got=f"emissiveFactor {emission.tolist()}",
                expected="a material without emission, or --bsdf",
            )
        if "occlusionTexture" in self.facts:
            self.notes.add("ambient occlusion: paths find it themselves", self.name)
        if self.default:
            self.notes.add("no material: the standard's own is taken, white metal of roughness 1")

    def _number(self, facts: Facts, key: str, default: float) -> float:
        value = float(facts.get(key, default))
        if not 0 <= value <= 1:
            raise self.file.refusal(
                "factor of a material", f"{self.name}: {key}", got=value, expected="0 … 1"
            )
        return value

    def _use(self, facts: Facts, key: str) -> _Use | None:
        """How a texture is looked up; None where there is none."""
        if key not in facts:
            return None
        info: Facts = facts[key]
        image, sampler = self.file.texture(info["index"])
        transform: Facts = info.get("extensions", {}).get("KHR_texture_transform", {})
        number: Any = transform.get("texCoord", info.get("texCoord", 0))
        if number not in self.sets:
            raise self.file.refusal(
                "texture without coordinates",
                f"{self.name}: {key}",
                expected=f"vertices with TEXCOORD_{number}",
            )
        wraps = tuple(_WRAPS[sampler.get(axis, 10497)] for axis in ("wrapS", "wrapT"))
        kind = "nearest" if sampler.get("magFilter") == _NEAREST else "bilinear"
        return _Use(
            image, number, _transform(transform), (wraps[0], wraps[1]), kind, float(info.get("scale", 1.0))
        )

    def _channels(self, use: _Use, what: str) -> np.ndarray:
        """Red, green and blue of a texture."""
        image = self.file.image(use.image)
        if what == "normal" and image.shape[2] < 3:
            raise self.file.refusal("normal texture without colours", self.name, got=image.shape)
        return image[..., :3] if image.shape[2] >= 3 else np.repeat(image[..., :1], 3, 2)

    def _base_colour(self, lookups: _Lookups, use: _Use | None) -> Facts:
        """Factor times sRGB texture times the vertices' colours."""
        factor = self._base_factor()[:3]
        if use is None and self.colours is None:
            return {"type": "rgb", "value": factor.tolist()}
        if use is None or self.colours is None:
            if use is not None:
                return lookups.image(
                    "base_color", use, linear_colours(self._channels(use, "colour")) * factor
                )
            return lookups.attribute("colour", self.colours_of_vertices()[:, :3] * factor)
        lookups.attribute("colour", self.colours_of_vertices()[:, :3])
        image = linear_colours(self._channels(use, "colour")) * factor
        return vertex_texture(lookups.image("base_color", use, image), values="colour")

    def colours_of_vertices(self) -> np.ndarray:
        """(V, 4), opacity 1 where there is none."""
        assert self.colours is not None
        return np.concatenate([self.colours, np.ones((len(self.colours), 1))], 1)[:, :4]

    def _base_factor(self) -> np.ndarray:
        factor = np.asarray(self.factors.get("baseColorFactor", (1, 1, 1, 1)), np.float64)
        if factor.shape != (4,) or not ((factor >= 0) & (factor <= 1)).all():
            raise self.file.refusal(
                "factor of a material", self.name, got=factor.tolist(), expected="4 in [0, 1]"
            )
        return factor

    def _opacity(self, lookups: _Lookups, use: _Use | None) -> Facts | float | None:
        """Opacity by the material's alpha mode; None where all is opaque, as OPAQUE says."""
        mode = self.facts.get("alphaMode", "OPAQUE")
        if mode not in ("OPAQUE", "MASK", "BLEND"):
            raise self.file.refusal("alpha mode", self.name, got=mode, expected="OPAQUE, MASK or BLEND")
        if mode == "OPAQUE":
            return None
        cutoff = float(self.facts.get("alphaCutoff", 0.5)) if mode == "MASK" else None
        factor = float(self._base_factor()[3])
        own = None if self.colours is None else self.colours_of_vertices()[:, 3:]
        own = None if own is None or (own == 1).all() else own
        image = None if use is None else self.file.image(use.image)
        if (
            use is None
            or image is None
            or image.shape[2] != 4
            or image[..., 3].min() == np.iinfo(image.dtype).max
        ):
            found = None
        else:
            found = lookups.image("opacity", use, as_numbers(image[..., 3:]) * factor)
        if found is None and own is None:
            opacity = factor if cutoff is None else float(factor >= cutoff)
            return None if opacity == 1 else opacity
        if own is not None:
            lookups.attribute("opacity", own * (factor if found is None else 1.0))
        if found is not None and own is None and cutoff is None:
            return found
        return vertex_texture(found, values=None if own is None else "opacity", cutoff=cutoff)


class _Lookups:
    """Textures of one look."""

    def __init__(
        self, material: Material, piece: Piece, look: Look, main: _Use | None, *, follows: bool
    ) -> None:
        self.material, self.piece, self.look, self.main, self.follows = material, piece, look, main, follows

    def attribute(self, name: str, values: np.ndarray) -> Facts:
        """Numbers of the vertices, and the texture that shows them."""
        self.look.attributes[name] = values
        return {"type": "mesh_attribute", "name": ATTRIBUTES + name}

    def image(self, name: str, use: _Use, values: np.ndarray) -> Facts:
        """A texture of plain numbers (rows, columns, channels), looked up as ``use`` says."""
        uv = self.material.sets[use.set]
        matrix, wraps = use.matrix, use.wraps
        if wraps[0] != wraps[1]:
            there = _moved(uv, matrix)[np.unique(self.piece.faces)]
            values, matrix = self._side_by_side(values, matrix, wraps, there, name)
            wraps = ("clamp", "clamp")
        self.look.textures[name] = np.ascontiguousarray(values, np.float32)
        found = {**texture(name), "wrap_mode": wraps[0], "filter_type": use.filter}
        other = None
        if self.main is not None and use.set == self.main.set:
            if self.follows:
                matrix = matrix @ np.linalg.inv(self.main.matrix)
        else:
            other = f"uv{use.set}"
            self.look.attributes[other] = uv
        if not np.allclose(matrix, np.eye(3), atol=1e-12):
            full = np.eye(4)
            full[:2, :2], full[:2, 3] = matrix[:2, :2], matrix[:2, 2]
            found["to_uv"] = {"type": "transform", "matrix": full.tolist()}
        return found if other is None else vertex_texture(found, uv=other)

    def _side_by_side(
        self, values: np.ndarray, matrix: np.ndarray, wraps: tuple[str, str], uv: np.ndarray, name: str
    ) -> tuple[np.ndarray, np.ndarray]:
        """Copies of an image along the axes that do not clamp, as far as coordinates go: then all may clamp."""
        for axis, wrap in enumerate(wraps):
            if wrap == "clamp":
                continue
            # One copy more on either side, for filters.
            first, last = int(np.floor(uv[:, axis].min())) - 1, int(np.ceil(uv[:, axis].max())) + 1
            if last - first > _MOST_COPIES:
                raise self.material.file.refusal(
                    "texture that wraps differently along u and v, over too many copies",
                    f"{self.material.name}: {name}",
                    got=last - first,
                    expected=f"at most {_MOST_COPIES}",
                )
            rows = 1 - axis
            copies = [
                np.flip(values, rows) if wrap == "mirror" and k % 2 else values for k in range(first, last)
            ]
            values = np.concatenate(copies, rows)
            scale = np.eye(3)
            scale[axis, axis], scale[axis, 2] = 1 / (last - first), -first / (last - first)
            matrix = scale @ matrix
        return values, matrix


def _finished(inner: Facts, opacity: Facts | float | None) -> Facts:
    """Two-sided, and with holes where there are any."""
    solid = {"type": "twosided", "bsdf": inner}
    return solid if opacity is None else {"type": "mask", "opacity": opacity, "bsdf": solid}


def _transform(facts: dict[str, Any]) -> np.ndarray:
    """Matrix (3, 3) of ``KHR_texture_transform``: scale, then rotation (counter-clockwise as the image is seen,
    whose v points down), then offset."""  # noqa: D205, D209
    matrix = np.eye(3)
    c, s = np.cos(float(facts.get("rotation", 0.0))), np.sin(float(facts.get("rotation", 0.0)))
    matrix[:2, :2] = np.array([[c, s], [-s, c]]) * np.asarray(facts.get("scale", (1.0, 1.0)), np.float64)
    matrix[:2, 2] = facts.get("offset", (0.0, 0.0))
    return matrix


def _moved(uv: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    return uv @ matrix[:2, :2].T + matrix[:2, 2]
