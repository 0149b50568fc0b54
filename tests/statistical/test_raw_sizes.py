"""Sizes of the BTFs of the factorization paper (Suykens et al. 2003), from stores of the same settings."""

import pytest

from btfref.gates import tolerance
from btfref.sampling import SampledBTF
from btfref.sampling.store.selection import Selection
from btfref.sampling.synthesis import synthesize_store

pytestmark = pytest.mark.usefixtures("llvm")


#: Raw sizes (MiB of float32) of the BTFs of Suykens et al. 2003: texels, directions, size.
RAW = {"checker": (16, "10x5", 7.3), "rings": (64, "10x5", 117.2), "tissue": (64, "16x8", 768.0)}


@pytest.mark.parametrize("views", [(0,), pytest.param(None, marks=pytest.mark.long)])
@pytest.mark.parametrize("name", RAW)
def test_raw_sizes_of_the_factorization_paper(tmp_path, name, views):
    """A view of each in the default run, the whole of each in the long one."""
    texels, directions_, size = RAW[name]
    store = synthesize_store(
        tmp_path / "a.btf.zarr", name, texels=texels, views=directions_, lights=directions_, spp=2, max_depth=2,
        estimator="path",
        only=None if views is None else Selection(views=views), variance=False,
    )  # fmt: skip
    assert store.complete == (views is None)
    assert store.info()["raw_bytes"] / 2**20 == pytest.approx(size, abs=tolerance("synthesis.raw_sizes"))
    part = SampledBTF.load(store.path, views=views, partial=True)
    n = len(store.coverage) if views is None else len(views)
    assert 4 * part.values.size == store.info()["raw_bytes"] * n / len(store.coverage)
    assert (part.values.max((1, 2, 3)) > 0).any()
