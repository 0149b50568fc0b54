"""χ² tests of a BSDF's samples against its density, for validation and for tests of the plugin."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from contextlib import chdir
from types import ModuleType
from typing import TYPE_CHECKING

from numpy.typing import ArrayLike

from btfref.gates.tolerances import tolerance
from btfref.stress.evaluators import surface

if TYPE_CHECKING:
    from btfref.types import JitArray

#: Intervals a side with which a cell of the test's table is integrated for a million samples: densities jump at the
#: borders of their own cells. With 16, four million samples of a sharp material (`svd` of the rings) tell the integral
#: from the density. Such an integral's error falls as 1 / intervals and what a test can see as 1 / √samples.
INTERVALS, INTERVALS_SAMPLES = 64, 1_000_000


def chi_square(
    mi: ModuleType,
    bsdf: JitArray,
    uv: ArrayLike,
    w_view: ArrayLike,
    *,
    samples: int,
    tests: int = 1,
    intervals: int | None = None,
    pdf_view: ArrayLike | None = None,
    counts: Callable[[JitArray, JitArray, JitArray], JitArray] | None = None,
) -> tuple[bool, str]:
    """Whether the directions that a BSDF samples follow its density.

    Parameters
    ----------
    mi : module
    bsdf : object
        With ``sample`` and ``pdf`` as of ``mitsuba.BSDF``.
    uv : array_like, shape (2,)
    w_view : array_like, shape (3,)
    samples : int
    tests : int
        That are made together: the level is Šidák-corrected by their number.
    intervals : int, optional
        Along each side of a cell of the test's table, over which the density is integrated; by default as many as so
        many samples can tell from more.
    pdf_view : array_like, shape (3,), optional
        View of the density where it is another, which must be found out.
    counts : callable, optional
        ``(si, sample, weight) -> Bool``: samples that are right in other ways too; the others are lost to the test.

    Returns
    -------
    bool, str
        The outcome and what the test says.
    """
    import drjit as dr

    context = mi.BSDFContext()

    def sample(s: JitArray) -> tuple[JitArray, JitArray]:
        si = surface(mi, dr.width(s), uv, w_view)
        bs, weight = bsdf.sample(context, si, s[0], mi.Point2f(s[1], s[2]))
        right = bs.pdf > 0
        if counts is not None:
            right &= counts(si, bs, weight)
        return bs.wo, dr.select(right, mi.Float(1), 0)

    def pdf(w: JitArray) -> JitArray:
        return bsdf.pdf(context, surface(mi, dr.width(w), uv, w_view if pdf_view is None else pdf_view), w)

    test = mi.chi2.ChiSquareTest(
        domain=mi.chi2.SphericalDomain(),
        sample_func=sample,
        pdf_func=pdf,
        sample_dim=3,
        sample_count=samples,
        ires=intervals or math.ceil(INTERVALS * math.sqrt(min(samples / INTERVALS_SAMPLES, 1))),
    )
    # A test that fails writes its tables where it stands.
    with tempfile.TemporaryDirectory() as scratch, chdir(scratch):
        right = test.run(tolerance("chi2.significance"), test_count=tests, quiet=True)
    return bool(right), " ".join(str(test.messages).split())[-200:]
