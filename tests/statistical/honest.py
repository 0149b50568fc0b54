"""Whether the variances that a synthesis states are those of its values."""

import numpy as np

from btfref.gates import tolerance


def assert_variances_are_honest(first, second):
    """z-scores of two independent runs are standard normal.

    Lights share their paths: texels and views are what is independent, so the middle of |z| is judged.
    """
    total = first.variance.astype(np.float64) + second.variance
    noisy = total > 0
    z = (first.values - second.values.astype(np.float64))[noisy] / np.sqrt(total[noisy])
    assert noisy.mean() > tolerance("synthesis.seen.min_noisy")
    assert tolerance("synthesis.z.min_median") <= np.median(np.abs(z)) <= tolerance("synthesis.z.median")
