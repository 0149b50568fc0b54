"""Table 1 of Meseth, Müller and Klein (2004) on modelled mesostructures or on a measured BTF.

ε is the mean of |B − model| in luminance over all measured pairs of directions (their eq. 2), times π: a white diffuser
under perpendicular light has 1, as in their data.

Memory: they report about 365 MB for 256² texels and 81 views in floats, which is 17.2 floats a texel and view. Two
lobes of their eq. 1 need 9 (191 MB), four need 17 (361 MB): the figure fits four. Ours takes 4 a lobe, the peak in
place of ρ_s and ‖t‖: 170.9 MB for two lobes with chroma and ρ_d, half of that in halves. Eight bits hold for the
polynomials; peaks and exponents of lobes need the range of a half.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from btfref.bench.data import MESOSTRUCTURES, materials
from btfref.bench.options import Options
from btfref.bench.timing import machine

if TYPE_CHECKING:
    from btfref.sampling import SampledBTF
    from btfref.types import Facts


#: The paper's columns.
METHODS = {"LAF": "lafortune", "SLAF": "lafortune_lut", "RFP": "rf_poly", "RFNL": "rf_lobes"}

#: Texels a side and paths a sample: enough for three digits of a mean over texels.
TEXELS, SPP = 32, 16


def run(options: Options) -> Facts:
    """ε and seconds of the four methods.

    Parameters
    ----------
    options : Options
        ``quick``: checker only. ``btf``: instead of the mesostructures. ``only``: some of the columns "LAF", "SLAF",
        "RFP", "RFNL".

    Returns
    -------
    dict
        ``summary``: by material and column, ``average``, ``minimum``, ``maximum``, ``seconds``, ``not_converged``, and
        ``storage``: bytes of the maps in floats, in halves and in 8 bits, with ε of each; ``raw``: seconds.
    """
    options.demand(METHODS)
    columns = {column: key for column, key in METHODS.items() if options.wants(column)}
    names = MESOSTRUCTURES[:1] if options.quick else MESOSTRUCTURES
    summary, raw = {}, {}
    for name, data in materials(
        options.btf, names, texels=TEXELS, spp=SPP, estimator="path", progress=options.progress
    ):
        summary[name] = {column: fitted(data, key) for column, key in columns.items()}
        raw[name] = {column: row["seconds"] for column, row in summary[name].items()}
    parameters = (
        {"texels": TEXELS, "spp": SPP} if options.btf is None else {"shape": list(options.btf.values.shape)}
    )
    return {
        "suite": "reflectance",
        "parameters": parameters,
        "raw": raw,
        "summary": summary,
        "machine": machine(),
    }


def fitted(btf: SampledBTF, key: str) -> Facts:
    """ε of one method with its maps in floats, in halves and in 8 bits."""
    from btfref.registry import method
    from btfref.representations.analytic.light_functions import fit_report
    from btfref.representations.file.container import payload_bytes

    row = method(key)
    start = time.perf_counter()
    representation = row.fit(btf, storage="float")
    seconds = time.perf_counter() - start
    meta = representation.meta
    result = dict(meta["fit"]["epsilon"])
    result |= {"seconds": seconds, "not_converged": meta["fit"].get("not_converged", 0), "storage": {}}
    maps = {name: (a.shape, a.dtype.name) for name, a in representation.maps.items()}
    in_floats = payload_bytes(maps, meta)
    rows, columns = meta["texels"]
    for name, share in (("float", 1), ("half", 2), ("8 bit", 4)):
        stored = type(representation).from_arrays(narrowed(representation.maps, name), meta)
        result["storage"][name] = {
            "bytes": in_floats // share,
            "bytes_at_256": in_floats // share * 256 * 256 // (rows * columns),
            "epsilon": fit_report(stored, btf)["average"],
        }
    return result


def narrowed(maps: Mapping[str, np.ndarray], storage: str) -> dict[str, np.ndarray]:
    """The maps as halves, or as 8-bit integers between each channel's extremes, widened again."""
    import numpy as np

    result = {}
    for name, array in maps.items():
        if name.startswith(("view_", "light_")) or storage == "float":
            result[name] = array
        elif storage == "half":
            result[name] = array.astype(np.float16)
        else:
            axes = tuple(range(array.ndim - 1))
            low, high = array.min(axes), array.max(axes)
            step = np.where(high > low, (high - low) / 255, 1)
            result[name] = (low + np.round((array - low) / step) * step).astype(np.float32)
    return result


def table(result: Facts) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Rows for people: the paper's table, seconds, and ε and bytes by type of the maps."""
    header = ("material", "", *next(iter(result["summary"].values())))
    rows = []
    for name, columns in result["summary"].items():
        extremes = ("average", "minimum", "maximum")
        rows += [(name, k, *(f"{c[k]:.4f}" for c in columns.values())) for k in extremes]
        rows.append((name, "seconds", *(f"{c['seconds']:.1f}" for c in columns.values())))
        rows.append((name, "not converged", *(str(c["not_converged"]) for c in columns.values())))
        for kind in ("float", "half", "8 bit"):
            cells = [c["storage"][kind] for c in columns.values()]
            rows.append((name, f"average, {kind}", *(f"{c['epsilon']:.4f}" for c in cells)))
            rows.append((name, f"MB at 256², {kind}", *(f"{c['bytes_at_256'] / 1e6:.1f}" for c in cells)))
    return header, rows
