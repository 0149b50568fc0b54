"""A latent texture and a small network shared by all texels.

Sources: G. Rainer, W. Jakob, A. Ghosh, T. Weyrich, "Neural BTF Compression and Interpolation", Computer Graphics Forum
38(2), 2019: a network decodes a texel's latent numbers and two directions; A. Kuznetsov, K. Mullia, Z. Xu, M. Hašan,
R. Ramamoorthi, "NeuMIP: Multi-Resolution Neural Materials", ACM Transactions on Graphics 40(4), 2021: a small network
over a texture that is interpolated; E. Perez, F. Strub, H. de Vries, V. Dumoulin, A. Courville, "FiLM: Visual Reasoning
with a General Conditioning Layer", AAAI 2018: what is known beside the input scales and shifts the hidden units.

With ``c`` the code of the directions (:func:`btfref.representations.neural.network.code`), ``z`` the numbers of the
texels around a lookup, interpolated, and ``r`` the leaky rectifier::

    x₁ = r(g₁(z) ⊙ W₁ᵀ c + b₁(z))        g₁, b₁, g₂, b₂: numbers of z, as many as there are hidden units
    x₂ = r(g₂(z) ⊙ W₂ᵀ x₁ + b₂(z))
    B  = scale · cos θ_light · 2^(W₃ᵀ x₂ + b₃(z))

Differs from the papers: the numbers of a texel are no input beside the directions but scale and shift the hidden units,
which costs no products and lets a texel choose where each unit bends; light and view are held at the outermost measured
cosines, so that nothing is extrapolated towards the horizon; the light's cosine is a factor. B is never negative.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from btfref import conventions
from btfref.precision import real
from btfref.representations.analytic.light_functions import EDGES, held
from btfref.representations.file.schema import MapSchema, Schema
from btfref.representations.guide import feature_views, spread_members, texel_groups
from btfref.representations.lookup import StoredMaps, evaluate_points
from btfref.representations.neural import network

if TYPE_CHECKING:
    from collections.abc import Collection

    from numpy.typing import ArrayLike

    from btfref.types import Facts

#: Largest magnitude of a number in the maps, that of a half: what the ports compute stays within float32.
LARGEST = 65504.0

#: Members of a group of texels whose mean guides importance sampling.
GUIDE_MEMBERS = 4

#: Texels whose tables are made at a time.
BLOCK = 64


class Representation(StoredMaps):
    """``latent`` [row, column, 4 · hidden + 3], ``layer_1`` [12, hidden], ``layer_2``, ``layer_3`` and directions.

    ``layer_2`` is [hidden, hidden], ``layer_3`` [hidden, 3]; ``colour_scale`` is [1, 3]. The channels of ``latent``:
    gains and biases of the first hidden layer, gains and biases of the second one, biases of the colours.
    """

    @classmethod
    def schema(cls, meta: Facts, names: Collection[str]) -> Schema:
        """What its files hold; see :class:`btfref.representations.protocol.HasSchema`."""
        axes = {
            "latent": "rows columns 16*quads+3",
            "layer_1": f"{network.CODE} 4*quads",
            "layer_2": "4*quads 4*quads",
            "layer_3": "4*quads 3",
        }
        maps = {name: MapSchema(text, least=-LARGEST, most=LARGEST) for name, text in axes.items()}
        maps["colour_scale"] = MapSchema("1 3", least=0)
        return Schema(maps, EDGES)

    def evaluate(
        self, uv: ArrayLike, w_light: ArrayLike, w_view: ArrayLike, *, lod: ArrayLike = 0.0
    ) -> np.ndarray:
        """See :meth:`btfref.representations.protocol.Representation.evaluate`; ``lod`` is ignored."""
        constants, meta = self.meta["constants"], self.meta
        latent = self.maps["latent"].reshape(-1, self.maps["latent"].shape[-1])
        layers = {name: real(self.maps[name]) for name in network.LAYERS}
        scale = real(self.maps["colour_scale"][0])

        def lookup(uv: np.ndarray, w_light: np.ndarray, w_view: np.ndarray) -> np.ndarray:
            texel, weight = conventions.texel_stencil(uv, meta["texels"], meta["filter_type"])
            own = np.einsum("nt,ntc->nc", weight, real(latent[texel]))
            light, _ = held(w_light, constants["light_edge"])
            view, _ = held(w_view, constants["view_edge"])
            y = network.exponents(own, network.code(light, view), layers)
            return network.values(y, w_light[:, 2], scale)

        return evaluate_points(lookup, uv, w_light, w_view, gathered=4 * latent.shape[-1])

    def luminance_tables(self, texels: np.ndarray, views: np.ndarray) -> np.ndarray:
        """Luminance at measured views and all measured lights in float32, shape (n, n_views, n_lights).

        Parameters
        ----------
        texels, views : ndarray of int, shapes (n,), (n_views,)
            Flat indices of texels, and indices of views.
        """
        lights = self.maps["light_directions"].astype(np.float32)
        seen = self.maps["view_directions"].astype(np.float32)[views]
        pairs = len(seen), len(lights)
        codes = network.code(np.tile(lights, (pairs[0], 1)), np.repeat(seen, pairs[1], 0)).astype(np.float32)
        layers = {name: self.maps[name].astype(np.float32) for name in network.LAYERS}
        latent = self.maps["latent"].reshape(-1, self.maps["latent"].shape[-1])
        cosine = np.tile(lights[:, 2], pairs[0])
        result = np.zeros((len(texels), *pairs), np.float32)
        for start in range(0, len(texels), BLOCK):
            part = slice(start, start + BLOCK)
            y, _ = network.forward(latent[texels[part]].astype(np.float32), codes, layers)
            found = network.values(y, cosine, self.maps["colour_scale"][0].astype(np.float32))
            result[part] = conventions.luminance(found).reshape(-1, *pairs)
        return result

    def sampling_tables(self) -> tuple[np.ndarray, np.ndarray]:
        """Groups of texels alike, and means over a few members of each."""
        rows, columns = self.meta["texels"]
        n_views = len(self.maps["view_directions"])
        features = self.luminance_tables(np.arange(rows * columns), feature_views(n_views))
        labels = texel_groups(features.reshape(rows * columns, -1))
        members = spread_members(labels, GUIDE_MEMBERS)
        tables = self.luminance_tables(members, np.arange(n_views))
        mean = np.zeros((int(labels.max()) + 1, *tables.shape[1:]), np.float32)
        for group in range(len(mean)):
            own = tables[labels[members] == group]
            if len(own):
                mean[group] = own.mean(0)
        return labels.reshape(rows, columns), mean
