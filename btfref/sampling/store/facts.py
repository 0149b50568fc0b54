"""What a store's headers say of it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from btfref.sampling.paths.adaptive import summary
from btfref.sampling.store.layout import KIND

if TYPE_CHECKING:
    from btfref.sampling.store.store import BTFStore
    from btfref.types import Facts


def store_facts(store: BTFStore) -> Facts:
    """Header facts; see `BTFStore.info`."""
    rows, columns = store.texels
    covered = store.coverage
    files = [entry for entry in store.path.rglob("*") if entry.is_file()]
    count = len(store.views) * len(store.lights) * rows * columns * 3
    return {
        "kind": KIND,
        "method": "sampled",
        "shape": [len(store.views), len(store.lights), rows, columns, 3],
        "directions": {
            "views": {"name": store.views.name, "count": len(store.views)},
            "lights": {"name": store.lights.name, "count": len(store.lights)},
        },
        "dtype": str(store.dtype),
        "payload_bytes": count * store.dtype.itemsize,
        # As for representations: a ratio is against 32-bit floats.
        "raw_bytes": 4 * count,
        "file_bytes": sum(entry.stat().st_size for entry in files),
        "ratio": 4 / store.dtype.itemsize,
        "coverage": float(covered.mean()),
        "coverage_of": {
            "views": int(covered.any(axis=(1, 2, 3)).sum()),
            "lights": int(covered.any(axis=(0, 2, 3)).sum()),
            "pairs": f"{int(covered.any(axis=(2, 3)).sum())} of {covered[:, :, 0, 0].size}",
            "tiles": f"{int(covered.any(axis=(0, 1)).sum())} of {covered[0, 0].size}",
        },
        "complete": bool(covered.all()),
        "has_variance": store.has_variance,
        "error": summary(store),
        "parameters": store.attributes.get("parameters", {}),
        "parent": store.attributes.get("parent", {}),
        "seed": store.attributes.get("seed"),
        "versions": store.attributes.get("versions", {}),
        **{key: store.attributes[key] for key in ("fallback", "ignored") if key in store.attributes},
        "attributes": store.attributes,
    }
