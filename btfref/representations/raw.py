"""The tabulated BTF itself, interpolated over directions and texels: what every method approximates."""

from __future__ import annotations

import numpy as np

from btfref import conventions
from btfref.errors import InputError
from btfref.representations.guide import feature_views, group_means, texel_groups
from btfref.representations.lookup import StoredMaps, base_meta, direction_arrays, evaluate_tabulated

PRESETS = {"paper": {}}


class Representation(StoredMaps):
    """Table ``values`` [row, column, view, light, 3] and the directions it is sampled at."""

    def evaluate(self, uv, w_light, w_view, *, lod=0.0):
        """See :meth:`btfref.representations.protocol.Representation.evaluate`; ``lod`` is ignored."""
        values = self.maps["values"]
        table = values.reshape(-1, *values.shape[2:])

        def kernel(s):
            index = (s.texel[:, :, None, None], s.view[:, None, :, None], s.light[:, None, None, :])
            return np.einsum(
                "nt,nv,nl,ntvlc->nc",
                s.texel_weight,
                s.view_weight,
                s.light_weight,
                table[index].astype(float),
            )

        return evaluate_tabulated(self, kernel, uv, w_light, w_view)

    def sampling_tables(self):
        """Groups of texels alike, and their means."""
        values = self.maps["values"]
        table = values.reshape(-1, *values.shape[2:])
        some = conventions.luminance(table[:, feature_views(table.shape[1])].astype(np.float32))
        labels = texel_groups(some.reshape(len(table), -1))
        return labels.reshape(values.shape[:2]), conventions.luminance(group_means(labels, table))


def fit(btf, *, seed=0, progress=None, filter_type="bilinear"):
    """The table of ``btf`` in the layout of lookups.

    Parameters
    ----------
    btf : SampledBTF
    seed : int
        Unused: nothing is random.
    progress : callable, optional
        Unused: the copy takes no noticeable time.
    filter_type : {"bilinear", "nearest"}
        Texel filter that :meth:`Representation.evaluate` and the ports use.

    Raises
    ------
    InputError
        For values that are not finite.
    """
    for view in btf.values:
        if not np.isfinite(view).all():
            raise InputError("the BTF holds a value that is not finite", file=btf.path)
    values = np.ascontiguousarray(np.transpose(btf.values, (2, 3, 0, 1, 4)))
    meta = base_meta("raw", btf, {}, filter_type=filter_type)
    return Representation({"values": values, **direction_arrays(btf.views, btf.lights)}, meta)
