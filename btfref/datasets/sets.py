"""What the standard sets hold: materials, tiers and their settings. Said here and nowhere else."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from btfref.errors import InputError

if TYPE_CHECKING:
    from btfref.types import Facts


@dataclass(frozen=True)
class Material:
    """A material of a set.

    Attributes
    ----------
    name : str
    mesostructure : str
        Of `btfref.mesostructure`.
    kind : str
        Its family in a word or two.
    difficulty : str
        What makes it hard, in words.
    parameters : dict
        Of the mesostructure; those not named have its defaults.
    samples : int
        Samples of its grids, in those of the tier: rare highlights and light that bounces many times are noisier.
    """

    name: str
    mesostructure: str
    kind: str
    difficulty: str
    parameters: Facts = field(default_factory=dict)
    samples: int = 1


@dataclass(frozen=True)
class Tier:
    """A size of a set.

    Attributes
    ----------
    texels : int
        Along a side of the grids.
    grids : tuple of str
        Sets of directions, each for views and lights.
    spp : int
        Of the grids.
    test_rows, test_spp : int
        Rows of each footprint, and samples of each of their two halves.
    training_rows, training_spp : int
    map_texels : int
        Along a side of the truth maps.
    map_lights : int
        Light directions of each texel of the maps.
    """

    texels: int
    grids: tuple[str, ...]
    spp: int
    test_rows: int
    test_spp: int
    training_rows: int
    training_spp: int
    map_texels: int
    map_lights: int = 64


@dataclass(frozen=True)
class DataSet:
    """A set: its name, version, materials and tiers."""

    name: str
    version: str
    materials: tuple[Material, ...]
    tiers: dict[str, Tier]

    def material(self, name: str) -> Material:
        """A material by its name.

        Raises
        ------
        InputError
        """
        for one in self.materials:
            if one.name == name:
                return one
        known = ", ".join(one.name for one in self.materials)
        raise InputError(f"{self.name} has no such material", field="NAME", got=name[:40], expected=known)

    def tier(self, name: str) -> Tier:
        """A tier by its name.

        Raises
        ------
        InputError
        """
        if name not in self.tiers:
            raise InputError("unknown tier", field="tier", got=name[:40], expected=", ".join(self.tiers))
        return self.tiers[name]

    def size(self, tier: str, material: Material) -> Tier:
        """A tier as it is made of a material, with the samples that it takes.

        Raises
        ------
        InputError
        """
        size = self.tier(tier)
        return replace(size, spp=size.spp * material.samples)


#: Seeds: of the grids, of the queries that nobody fits to (that of footprint k is the number + k), of training queries,
#: and of the maps.
GRID_SEED, TEST_SEED, TRAINING_SEED, MAP_SEED = 1, 1_618_033, 2_718_281, 3

#: Mitsuba variant of all sets: its bytes are what is published.
VARIANT = "llvm_ad_rgb"

#: Where packages are looked for and made when nobody says where.
FOLDER = "btfref-data"

#: Largest polar angle of queries, degrees.
MAX_THETA = 85.0

#: Footprints of the test queries: half sides of squares, in texels of the grids.
FOOTPRINTS = {"point": 0.0, "texel": 0.5, "wide": 2.0}

#: Paths are as long as this, as Mitsuba counts.
MAX_DEPTH = 8

_MATERIALS = (
    Material(
        "flat",
        "flat",
        "analytic",
        "none: B = ρ/π cos θ_light everywhere. Whatever errs here errs by itself.",
        {"reflectance": [0.60, 0.42, 0.25]},
    ),
    Material(
        "plaster",
        "plaster",
        "height field",
        "easy: dull, shadows and slopes of all sizes, no highlights.",
    ),
    Material(
        "leather",
        "leather",
        "height field",
        "easy to medium: cells with creases under a soft gloss.",
    ),
    Material(
        "hammered",
        "hammered",
        "height field",
        "medium: narrow highlights that wander over curved metal; hardly any diffuse light.",
    ),
    Material(
        "brushed",
        "brushed",
        "metal",
        "medium: an anisotropic highlight, far wider across the grooves than along them.",
    ),
    Material(
        "mail",
        "mail",
        "overhanging metal",
        "hard: metal under metal; silhouettes, holes, light that bounces many times.",
        samples=8,
    ),
    Material(
        "pebbles",
        "pebbles",
        "bodies",
        "hard: the largest parallax of the set; what a texel shows depends on the view.",
    ),
    Material(
        "flakes",
        "flakes",
        "sparse",
        "hard: rare small mirrors; most samples see none, the mean is made by few.",
        samples=2,
    ),
    Material(
        "specks",
        "specks",
        "layers",
        "medium: sharp borders between dull, glossy and metal discs, on three levels.",
    ),
    Material(
        "blisters",
        "blisters",
        "translucent",
        "medium: thin shells that glow; the ground is lit through them.",
    ),
    Material(
        "tissue",
        "tissue",
        "cloth",
        "medium: a plain weave with sheen; two colours that occlude each other.",
    ),
    Material("twill", "twill", "cloth", "medium: a diagonal of floats, dark warp over light weft."),
    Material("satin", "satin", "cloth", "medium: long floats with strong anisotropic gloss.", samples=4),
    Material("knit", "knit", "cloth", "hard: loops that pass through loops; deep, with overhang."),
    Material(
        "pile",
        "pile",
        "fibres",
        "hard: hundreds of thin fibres that let light through; structure below a texel.",
    ),
)

SETS = {
    "btf-1": DataSet(
        "btf-1",
        "1.0.0",
        _MATERIALS,
        {
            "toy": Tier(16, ("3x6", "4x9"), 64, 1500, 64, 16_384, 8, 64),
            "standard": Tier(64, ("ubo81", "ubo151"), 256, 20_000, 64, 1_000_000, 8, 256),
            "large": Tier(128, ("ubo81", "ubo151"), 512, 100_000, 64, 10_000_000, 8, 512),
        },
    )
}


def find(name: str) -> tuple[DataSet, list[Material]]:
    """A set and materials of it by "SET", "SET/MATERIAL", "MATERIAL" (of the first set) or "all".

    Parameters
    ----------
    name : str

    Returns
    -------
    DataSet, list of Material

    Raises
    ------
    InputError
    """
    first, _, rest = name.partition("/")
    if first in SETS:
        chosen, wanted = SETS[first], rest or "all"
    elif rest:
        raise InputError("no such set", field="NAME", got=name[:40], expected=", ".join(SETS))
    else:
        chosen, wanted = next(iter(SETS.values())), first
    if wanted == "all":
        return chosen, list(chosen.materials)
    return chosen, [chosen.material(wanted)]
