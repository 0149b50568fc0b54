"""Settings of a set of queries: what its rows depend on besides the source. Said here and nowhere else."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import cached_property
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any

from btfref.errors import SAMPLES, InputError, Limit

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from btfref.querying.laws import Laws
    from btfref.types import Facts

#: Footprints of a radius R in texture space: a disk of radius R, a square of side 2R, or a Gaussian of standard
#: deviation R. Variance along an axis, in R².
FOOTPRINTS = {"gaussian": 1.0, "disk": 0.25, "square": 1 / 3}

#: Rows of a set.
ROWS = Limit(2**32 - 1, "random numbers of a row are selected by 32 bits")

#: Lights of a path.
LIGHTS = Limit(1024, "all samples of a group are in memory together")

#: Samples of a row where none are asked for, and the most of one to a target error.
SPP, MOST_SPP = 16, 4096

#: Samples of the pilot of a row to a target error, and the fewest of its estimate.
PILOT, LEAST = 16, 8


@dataclasses.dataclass(frozen=True, eq=False)
class QuerySettings:
    """Settings of a set of queries, checked when they are made.

    Parameters
    ----------
    n : int
        Rows.
    light, view : str or array_like (n, 3)
        Laws of `btfref.querying.laws`: "uniform", "cosine", "grazing", "halfdiff" (of both), a set such as "ubo81", or
        vectors.
    max_theta : float
        Largest polar angle of directions that follow a law, degrees.
    radius : str or float
        Law of the footprints' radii in tiles: "0", R, "levels:R:S0,S1,…", "log:R0:R1".
    footprint : {"gaussian", "disk", "square"}
        Shape of a footprint on the sampling plane: standard deviation R, radius R, side 2R.
    picture : int or (int, int), optional
        Rows and columns of a picture: as many rows in turn share a pair of directions, one for each of its texels.
    lights_per_path : int
        So many rows in turn share place, footprint, view and paths, each with a light of its own: cheaper rows, whose
        errors are correlated within such a group (and which have no target error, `halfdiff` or picture).
    spp : int, optional
        Independent samples of a row; 1 gives no variance. By default 16. With a target error the most of a row, by
        default 4096.
    target_error : float, optional
        Standard error of a row relative to its mean over the channels, or to a tenth of the mean of all where it is
        darker: a pilot says how many samples a row gets. What the pilot misses the row may miss.
    max_depth : int
        As in Mitsuba: 2 is direct light only, −1 has no limit.
    seed : int
        Same seed, same bytes (on the same machine).
    variant : str
        Mitsuba variant; bytes differ between backends.

    Raises
    ------
    InputError
        A setting that cannot be used.
    """

    n: int = 1_000_000
    light: str | ArrayLike = "uniform"
    view: str | ArrayLike = "uniform"
    max_theta: float = 90.0
    radius: str | float = "0"
    footprint: str = "gaussian"
    picture: int | Sequence[int] | None = None
    lights_per_path: int = 1
    spp: int | None = None
    target_error: float | None = None
    max_depth: int = 8
    seed: int = 0
    variant: str = "llvm_ad_rgb"

    def __post_init__(self) -> None:
        def keep(name: str, value: object) -> None:
            object.__setattr__(self, name, value)

        keep("n", _whole("n", self.n, 1, ROWS.most))
        keep("seed", _whole("seed", self.seed, 0, 2**63 - 1))
        if self.max_depth != -1:
            keep("max_depth", _whole("max_depth", self.max_depth, 2, 10_000))
        if self.footprint not in FOOTPRINTS:
            raise InputError(
                "unknown footprint",
                field="footprint",
                got=repr(self.footprint),
                expected=" or ".join(FOOTPRINTS),
            )
        if self.target_error is not None:
            keep("target_error", _number("target_error", self.target_error, 1e-4, 10))
        keep("lights_per_path", _whole("lights_per_path", self.lights_per_path, 1, LIGHTS.most))
        if self.lights_per_path > 1 and self.target_error is not None:
            raise InputError(
                "rows that share paths share their number of samples",
                field="target_error",
                got=self.target_error,
                expected="none with lights_per_path",
            )
        keep("max_theta", _number("max_theta", self.max_theta, 0, 90))
        # These are checked by being made.
        _ = self.samples, self.laws

    @cached_property
    def samples(self) -> int:
        """Samples of a row; with a target error, the most of them."""
        if self.target_error is None:
            return _whole("spp", SPP if self.spp is None else self.spp, 1, SAMPLES.most)
        return _whole("spp", MOST_SPP if self.spp is None else self.spp, LEAST, SAMPLES.most)

    @cached_property
    def laws(self) -> Laws:
        """What the rows follow."""
        from btfref.querying.laws import laws

        sides = None
        if self.picture is not None:
            given = [self.picture] * 2 if isinstance(self.picture, Integral) else list(self.picture)  # type: ignore[arg-type]  # a sequence
            if len(given) != 2:
                raise InputError("sides of a picture", field="picture", got=self.picture, expected="two")
            sides = [_whole("picture", side, 1, 4096) for side in given]
            texels = sides[0] * sides[1]
            if self.n % texels:
                raise InputError(
                    "rows that fill no whole pictures",
                    field="n",
                    got=self.n,
                    expected=f"a multiple of {texels}",
                )
        return laws(
            self.light,
            self.view,
            self.radius,
            max_theta=self.max_theta,
            picture=sides,
            lights=self.lights_per_path,
        )

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """Names of all settings."""
        return tuple(field.name for field in dataclasses.fields(cls))

    def changed(self, keywords: Facts) -> tuple[QuerySettings, Facts]:
        """These settings with those among some keywords, and the keywords that are none (the mesostructure's)."""
        own = {name: value for name, value in keywords.items() if name in self.names()}
        rest = {name: value for name, value in keywords.items() if name not in own}
        return dataclasses.replace(self, **own), rest

    def facts(self) -> Facts:
        """What a file says of them, JSON types; sets of directions of one's own stand in it whole."""
        import numpy as np

        facts: Facts = {
            "n": self.n,
            "laws": self.laws.facts(),
            "footprint": self.footprint,
            "spp": self.samples,
            "target_error": self.target_error,
            "max_depth": self.max_depth,
            "seed": self.seed,
            "variant": self.variant,
        }
        if self.lights_per_path > 1:
            facts["lights_per_path"] = self.lights_per_path
            facts["shared"] = "rows i with one i // lights_per_path: place, footprint, view, paths"
        for name, law in (("light", self.laws.light), ("view", self.laws.view)):
            if law is not None and law.vectors is not None and law.name == "custom":
                facts["laws"][f"{name}_directions"] = np.asarray(law.vectors).tolist()
        return facts


def _whole(name: str, value: Any, low: int, high: int) -> int:
    whole = isinstance(value, Integral) and not isinstance(value, bool)
    if not whole or not low <= value <= high:
        raise InputError(
            "setting of the queries", field=name, got=value, expected=f"a whole number in [{low}, {high}]"
        )
    return int(value)


def _number(name: str, value: Any, low: float, high: float) -> float:
    real = isinstance(value, Real) and not isinstance(value, bool)
    if not real or not low <= value <= high:
        raise InputError(
            "setting of the queries", field=name, got=value, expected=f"a number in [{low:g}, {high:g}]"
        )
    return float(value)
