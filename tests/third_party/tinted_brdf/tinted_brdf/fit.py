"""Fit and float64 definition of ``B(x, v, l) = t(x) F(v, l)``, channel by channel."""

import numpy as np

from btfref import conventions
from btfref.representations.file.schema import MapSchema, Schema
from btfref.representations.lookup import (
    StoredMaps,
    base_meta,
    direction_arrays,
    evaluate_tabulated,
    stored,
)

PRESETS = {"paper": {}}


class Representation(StoredMaps):
    """Maps: ``brdf`` [view, light, 3] in 1/sr, ``tint`` [row, column, 3]."""

    @classmethod
    def schema(cls, meta, names):
        """What its files hold: they are checked before the ports see them."""
        return Schema({"brdf": MapSchema("views lights 3"), "tint": MapSchema("rows columns 3")})

    def evaluate(self, uv, w_light, w_view, *, lod=0.0):
        """B in 1/sr, cosine included, float64; ``lod`` is ignored."""
        brdf, tint = self.maps["brdf"], self.maps["tint"].reshape(-1, 3)

        def kernel(s):
            table = brdf[s.view[:, :, None], s.light[:, None, :]].astype(float)
            colour = np.einsum("nt,ntc->nc", s.texel_weight, tint[s.texel].astype(float))
            return colour * np.einsum("nvl,nvlc->nc", s.pair_weight, table)

        return evaluate_tabulated(self, kernel, uv, w_light, w_view)

    def sampling_tables(self):
        """One group: all texels reflect alike, up to their tint."""
        tint = self.maps["tint"].astype(float).mean((0, 1))
        mean = conventions.luminance(self.maps["brdf"].astype(float) * tint)
        return np.zeros(self.maps["tint"].shape[:2], np.uint32), mean[None]


def fit(btf, *, seed=0, progress=None, storage="half", filter_type="bilinear"):
    """Least squares in two steps: the mean over texels, then each texel's factor of it."""
    values = btf.values.astype(np.float32)
    brdf = values.mean((2, 3), dtype=np.float64)
    norm = np.maximum(np.einsum("vlc,vlc->c", brdf, brdf), np.finfo(float).tiny)
    tint = np.einsum("vlrkc,vlc->rkc", values, brdf.astype(np.float32), optimize=True) / norm
    maps = {"brdf": stored("brdf", brdf, storage), "tint": stored("tint", tint, storage)}
    meta = base_meta("tinted_brdf", btf, {"storage": storage, "seed": seed}, filter_type=filter_type)
    if progress:
        progress(1, 1, "means")
    return Representation(maps | direction_arrays(btf.views, btf.lights), meta)
