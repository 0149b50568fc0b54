"""Settings of a synthesis: what a sampled BTF depends on besides its mesostructure. Said here and nowhere else."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from functools import cached_property
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any

from btfref.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from btfref.numerics.sphere.directions import DirectionSet
    from btfref.types import Facts

#: name -> "module:class". An estimator is made from (mesostructure, light vectors, all view vectors, texels,
#: spp, seed, max_depth, wanted views, mask of texels); ``all_views(views)`` yields (view, mean, variance of
#: the mean), arrays (lights, rows, columns, 3) float32. Any order and any subset gives the same bytes.
ESTIMATORS = {
    "path": "btfref.sampling.paths.texels:TexelPaths",
    "surface": "btfref.sampling.surface.estimator:SurfaceEstimator",
}

#: In place of a name: the fastest of them that applies.
AUTO = "auto"

#: Types that values are stored in.
DTYPES = ("float16", "float32")

#: Samples per texel and view where none are asked for, and the most of a synthesis to a target error.
SAMPLES, MOST_SAMPLES = 64, 4096

_LARGEST_SIDE, _LARGEST_SPP = 4096, 1 << 20


@dataclasses.dataclass(frozen=True, eq=False)
class SynthesisSettings:
    """Settings of a synthesis, checked when they are made.

    Parameters
    ----------
    texels : int or (int, int)
        Texels along each side of the tile, or rows and columns; 1 to 4096.
    views, lights : str, DirectionSet or array_like (n, 3)
        See `btfref.numerics.sphere.directions.directions`.
    spp : int, optional
        Samples per texel and view, at least 2; each serves all lights. By default 64. With a target error:
        the most that a texel may get, by default 4096. The surface estimator counts surface points per texel of
        the tile.
    seed : int
        Same seed, same bytes (on the same machine).
    max_depth : int
        As in Mitsuba: 2 is direct light only, −1 has no limit.
    dtype : {"float16", "float32"}
        Type of the stored values. Variance is float32.
    estimator : {"auto", "path", "surface"}
        "path", the reference, or "surface", which traces visibility once for all views and lights; see
        `btfref.sampling.surface.estimator`. "auto" is "surface" where that applies and "path" where a material
        transmits, masks or mirrors, and for a limit per texel, since only paths give each texel samples of its own. The
        attribute ``estimator`` of a store says which it was, and ``fallback`` why "surface" was not used.
    variant : str
        Mitsuba variant; bytes differ between backends.
    target_error : float, optional
        Root mean square of all standard errors, relative to the mean of all values: samples are placed where
        they are needed for it, see `btfref.sampling.paths.adaptive`. Whether it was reached stands in the store.
    texel_error : float, optional
        Largest relative standard error of a texel of a view (over lights and channels), relative to its mean
        or to a tenth of the whole's. With a target error only; by default no limit.
    variance : bool
        Whether the variance of the mean is made and kept. Without it the surface estimator is faster by a tenth.

    Raises
    ------
    InputError
        A setting that cannot be used.
    """

    texels: int | Sequence[int] = 64
    views: str | DirectionSet | ArrayLike = "ubo81"
    lights: str | DirectionSet | ArrayLike = "ubo81"
    spp: int | None = None
    seed: int = 0
    max_depth: int = 8
    dtype: str = "float16"
    estimator: str = AUTO
    variant: str = "llvm_ad_rgb"
    target_error: float | None = None
    texel_error: float | None = None
    variance: bool = True

    def __post_init__(self) -> None:
        def keep(name: str, value: object) -> None:
            object.__setattr__(self, name, value)

        keep("target_error", _share("target_error", self.target_error))
        if self.target_error is None and self.texel_error is not None:
            raise InputError(
                "without a target error", field="texel_error", got=self.texel_error, expected="both"
            )
        keep("texel_error", _share("texel_error", self.texel_error))
        if self.target_error is not None and not self.variance:
            raise InputError(
                "a target error wants variances", field="variance", got=self.variance, expected="True"
            )
        keep("variance", bool(self.variance))
        keep("seed", _whole("seed", self.seed, 0, 2**63 - 1))
        if self.max_depth != -1:
            keep("max_depth", _whole("max_depth", self.max_depth, 2, 10_000))
        if self.dtype not in DTYPES:
            raise InputError(
                "type of the values", field="dtype", got=repr(self.dtype), expected=" or ".join(DTYPES)
            )
        if self.estimator not in (AUTO, *ESTIMATORS):
            raise InputError(
                "unknown estimator",
                field="estimator",
                got=repr(self.estimator),
                expected=f"one of {', '.join((AUTO, *ESTIMATORS))}",
            )
        # These are checked by being made.
        _ = self.sides, self.samples, self.view_set, self.light_set

    @cached_property
    def sides(self) -> tuple[int, int]:
        """Rows and columns of texels."""
        texels: Any = self.texels
        try:
            sides = [texels, texels] if isinstance(texels, int | str) else list(texels)
        except TypeError:  # a number of another kind
            sides = [texels, texels]
        if len(sides) != 2:
            raise InputError(
                "texels of the tile", field="texels", got=texels, expected="n or (rows, columns)"
            )
        rows, columns = (_whole("texels", side, 1, _LARGEST_SIDE) for side in sides)
        return rows, columns

    @cached_property
    def samples(self) -> int:
        """Samples per texel and view; with a target error, the most of them."""
        from btfref.sampling.paths.adaptive import LEAST
        from btfref.sampling.paths.texels import STREAMS

        if self.target_error is None:
            return _whole("spp", SAMPLES if self.spp is None else self.spp, 2, _LARGEST_SPP)
        return _whole("spp", MOST_SAMPLES if self.spp is None else self.spp, LEAST, STREAMS)

    @cached_property
    def view_set(self) -> DirectionSet:
        """Directions of the views."""
        from btfref.numerics.sphere.directions import directions

        return directions(self.views)

    @cached_property
    def light_set(self) -> DirectionSet:
        """Directions of the lights."""
        from btfref.numerics.sphere.directions import directions

        return directions(self.lights)

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """Names of all settings."""
        return tuple(field.name for field in dataclasses.fields(cls))

    def changed(self, keywords: Mapping[str, Any]) -> tuple[SynthesisSettings, Facts]:
        """These settings with those among some keywords, and the keywords that are none (the mesostructure's)."""
        own = {name: value for name, value in keywords.items() if name in self.names()}
        rest = {name: value for name, value in keywords.items() if name not in own}
        return dataclasses.replace(self, **own), rest

    def attributes(self) -> Facts:
        """What a store says of them: its attributes ``seed``, ``estimator`` and ``parameters``."""
        from btfref.sampling.paths.adaptive import PILOT, SURFACE_POINTS
        from btfref.sampling.store.layout import TILE

        parameters: Facts = {
            "texels": list(self.sides),
            "spp": self.samples,
            "max_depth": self.max_depth,
            "dtype": self.dtype,
            "variant": self.variant,
            "tile": TILE,
        }
        # Only where they are asked for: stores of earlier versions lack them.
        if not self.variance:
            parameters["variance"] = False
        if self.target_error is not None:
            parameters["target_error"] = self.target_error
            parameters["texel_error"] = self.texel_error
            parameters["pilot"] = PILOT if self.estimator == "path" else SURFACE_POINTS
        return {"seed": self.seed, "estimator": self.estimator, "parameters": parameters}


def _whole(name: str, value: Any, low: int, high: int) -> int:
    whole = isinstance(value, Integral) and not isinstance(value, bool)
    if not whole or not low <= value <= high:
        raise InputError(
            "setting of the synthesis", field=name, got=value, expected=f"a whole number in [{low}, {high}]"
        )
    return int(value)


def _share(name: str, value: Any) -> float | None:
    """A relative error, or None."""
    if value is None:
        return None
    number = isinstance(value, Real) and not isinstance(value, bool)
    if not number or not 1e-5 <= value <= 10:
        raise InputError(
            "setting of the synthesis", field=name, got=value, expected="a number in [1e-5, 10], 0.02 for 2 %"
        )
    return float(value)
