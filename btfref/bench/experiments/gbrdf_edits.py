"""The four edits of the g-BRDF paper (section 6, Table 2), each on its maps and each rendered: ``gbrdf-edits.png``.

Run in a checkout: ``python btfref/bench/experiments/gbrdf_edits.py FOLDER``. The maps before and after every edit
stay in FOLDER.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from btfref.images import save_image
from btfref.numerics.microfacets import isotropic_ndf
from btfref.numerics.sphere.parabolic import texel_directions
from btfref.rendering.gl.realtime import realtime
from btfref.representations import save
from btfref.representations.gbrdf.build import from_maps, from_photograph
from btfref.representations.gbrdf.geometry import from_mesostructure
from btfref.representations.gbrdf.maps import export_maps, hue_of_turns, import_maps, turns_of_hue
from btfref.scene.shipped import scene_file

if TYPE_CHECKING:
    from btfref.representations.gbrdf.definition import Representation


SIZE = (192, 192)


def logo(shape: tuple[int, int]) -> np.ndarray:
    """A ring with a bar: the shape that is pasted into maps."""
    v, u = ((np.arange(n) + 0.5) / n - 0.5 for n in shape)
    u, v = np.meshgrid(u, v)
    radius = np.hypot(u, v)
    return (np.abs(radius - 0.3) < 0.07) | ((np.abs(u) < 0.06) & (radius < 0.3))


def changed(rep: Representation, **changes: Any) -> Representation:
    """A g-BRDF with some maps replaced."""
    maps = {
        "height": rep.maps["height"][..., 0],
        "diffuse": rep.maps["diffuse"],
        "rotation": rep.maps["rotation"][..., 0],
        "fresnel": rep.maps["fresnel"][..., 0],
        "material": rep.maps["material"][..., 0],
        "ndf": rep.maps["ndf"],
        "specular": rep.maps["specular"][:, 0],
        "height_min": rep.meta["constants"]["height_min"],
        "height_max": rep.meta["constants"]["height_max"],
    }
    return from_maps(
        maps.pop("height") if "height" not in changes else changes.pop("height"),
        **{k: v for k, v in maps.items() if k != "height"} | changes,
    )


def meso_structure(folder: Path, cloth: Representation) -> Representation:
    """1. Fibres turned by a quarter under the logo, in rotation.png as any picture editor would."""
    export_maps(cloth, folder / "1-maps")
    path = folder / "1-maps" / "rotation.png"
    with Image.open(path) as picture:
        turns = turns_of_hue(np.asarray(picture.convert("RGB")))
    turns = np.where(logo(turns.shape), turns + 0.25, turns)
    Image.fromarray(hue_of_turns(np.mod(turns, 1))).save(path)
    return import_maps(folder / "1-maps")


def colour(cloth: Representation) -> Representation:
    """2. Colour channels exchanged in diffuse map and distributions; light pink lint at grazing half vectors."""
    swap = [2, 1, 0]
    z = texel_directions(cloth.maps["ndf"].shape[1])[..., 2]
    lint = np.clip(1 - z / 0.5, 0, 1)[..., None] ** 2 * [0.5, 0.3, 0.35]
    return changed(cloth, diffuse=cloth.maps["diffuse"][..., swap], ndf=cloth.maps["ndf"][..., swap] + lint)


def synthetic_material(checker: Representation) -> Representation:
    """3. The logo engraved and painted with a new, glossy material."""
    mark = logo(checker.maps["height"].shape[:2])
    height = checker.maps["height"][..., 0] - 0.25 * mark
    low = checker.meta["constants"]["height_min"] * (1 - min(height.min(), 0))
    unit = (height - height.min()) / (height.max() - height.min())
    n = len(checker.maps["ndf"])
    table = np.repeat(isotropic_ndf(0.15)[None, ..., None], 3, -1)
    return changed(
        checker,
        height=unit,
        height_min=low,
        diffuse=np.where(mark[..., None], [0.02, 0.25, 0.05], checker.maps["diffuse"]),
        fresnel=np.where(mark, 0.3, checker.maps["fresnel"][..., 0]),
        material=np.where(mark, n, checker.maps["material"][..., 0]).astype(int),
        ndf=np.concatenate([checker.maps["ndf"], table]),
        specular=np.append(checker.maps["specular"][:, 0], 1.0),
    )


def photograph(folder: Path) -> Representation:
    """4. A g-BRDF from one picture: diffuse map, height from its grey values, a minor highlight."""
    v, u = np.meshgrid(*[(np.arange(128) + 0.5) / 128] * 2, indexing="ij")
    # A wall of bricks, drawn: it tiles, and everybody has it.
    row = np.floor(8 * v)
    x = np.mod(4 * u + 0.5 * np.mod(row, 2), 1)
    brick = np.minimum(np.minimum(x, 1 - x) / 0.05, np.minimum(np.mod(8 * v, 1), 1 - np.mod(8 * v, 1)) / 0.1)
    number = np.mod(np.floor(4 * u + 0.5 * np.mod(row, 2)), 4) * 8 + row
    shade = 0.75 + 0.25 * np.random.default_rng(0).random(40)[number.astype(int)]
    wall = np.clip(brick, 0, 1)[..., None] * shade[..., None] * [200, 95, 70] + 20
    Image.fromarray(np.clip(wall, 0, 255).astype(np.uint8)).save(folder / "4-photograph.png")
    return from_photograph(folder / "4-photograph.png", depth=0.04)


def picture(rep: Representation, path: Path) -> np.ndarray:
    """The shipped cloth scene, in real time."""
    save(rep, path)
    parameters = {"btf": str(path), "lights": "directional3", "tiling": "3"}
    return realtime(scene_file("cloth"), parameters=parameters, size=SIZE, shadows=False).image


def main(folder: Path) -> None:
    """Make all maps and pictures."""
    folder.mkdir(parents=True, exist_ok=True)
    cloth, checker = from_mesostructure("tissue", texels=96), from_mesostructure("checker", texels=64)
    before = [cloth, cloth, checker, None]
    after = [meso_structure(folder, cloth), colour(cloth), synthetic_material(checker), photograph(folder)]
    rows = []
    for name, group in (("before", before), ("after", after)):
        rows.append(
            [
                np.zeros((*SIZE[::-1], 3))
                if rep is None
                else picture(rep, folder / f"{k + 1}-{name}.gbrdf.exr")
                for k, rep in enumerate(group)
            ]
        )
    with Image.open(folder / "4-photograph.png") as photo:
        from btfref.numerics.colour import decode_srgb

        rows[0][3] = decode_srgb(np.asarray(photo.resize(SIZE)) / 255.0)
    save_image(folder / "gbrdf-edits.png", np.concatenate([np.concatenate(row, 1) for row in rows]))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
