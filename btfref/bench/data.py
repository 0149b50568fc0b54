"""The BTF that benchmarks share."""

from __future__ import annotations


def checker(*, texels=64, spp=2, progress=None):
    """The checker at 81² directions, in memory; drafts are enough where only the size matters.

    Parameters
    ----------
    texels, spp : int
    progress : callable, optional

    Returns
    -------
    SampledBTF
    """
    from btfref.sampling.synthesis import synthesize

    return synthesize("checker", texels=texels, spp=spp, progress=progress)
