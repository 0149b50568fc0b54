"""Laplacian pyramid of a BTF with principal components per level: level of detail that costs less the coarser it is.

Source: W.-C. Ma, S.-H. Chao, Y.-T. Tseng, Y.-Y. Chuang, C.-F. Chang, B.-Y. Chen, M. Ouhyoung, "Level-of-Detail
Representation of Bidirectional Texture Functions for Real-Time Rendering", I3D 2005, eq. 7:
``B(x, l, v; λ) = Σ_{k=⌊λ⌋..λ_max} w_k D_kᵀ(x) E_k(l, v) + μ'(l, v)`` in Y, Cb, Cr, ``w_k = clamp(1 − λ + k, 0, 1)``.

Differs from the paper by default: directions are interpolated instead of taken from the nearest measured ones; levels
are reduced by a binomial kernel and looked up bilinearly, so that they do not shift against each other; the pyramid
goes down to one texel; each level holds the difference to the *compressed* coarser ones, which corrects their error
and is never worse. The preset "paper" has all of it as published.
"""

from __future__ import annotations

from btfref.representations.laplacian.fit import fit
from btfref.representations.laplacian.levels import Representation
from btfref.representations.protocol import FitMemory

__all__ = ["FIT_MEMORY", "PRESETS", "Representation", "fit"]

#: See :mod:`btfref.representations.fit_memory`.
FIT_MEMORY = FitMemory(0.022, view=28, columns=200)

#: "paper": λ_max = 4, 8 + 2 + 2 components a level, Phong mean, 3 × 3 box, nearest texels and directions, in floats.
PRESETS = {
    "paper": {
        "levels": 5,
        "components": (8, 2, 2),
        "mean": "phong",
        "reduction": "box",
        "prediction": "open",
        "filter_type": "nearest",
        "directions": "nearest",
        "storage": "float",
    }
}
