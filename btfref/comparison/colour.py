"""Displayed colours as people see them: CIE Lab and CIEDE2000."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from btfref.images.display import Display
from btfref.numerics.colour import RGB_TO_XYZ


def lab(rgb: ArrayLike) -> np.ndarray:
    """CIE L*a*b* under D65 of linear Rec. 709 in [0, 1] (CIE 15:2004, 8.2.1).

    Parameters
    ----------
    rgb : (..., 3) array
        Displayed light; (1, 1, 1) is the white point.

    Returns
    -------
    (..., 3) float64 array
        L* in [0, 100], a*, b*.
    """
    ratio = np.asarray(rgb, np.float64) @ (RGB_TO_XYZ / RGB_TO_XYZ.sum(axis=1, keepdims=True)).T
    delta = 6 / 29
    f = np.where(ratio > delta**3, np.cbrt(ratio), ratio / (3 * delta**2) + 4 / 29)
    x, y, z = np.moveaxis(f, -1, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


def ciede2000(lab1: ArrayLike, lab2: ArrayLike) -> np.ndarray:
    """CIEDE2000 colour difference with all parametric factors 1.

    Parameters
    ----------
    lab1, lab2 : (..., 3) array
        CIE L*a*b*.

    Returns
    -------
    (...) float64 array
        ΔE00 ≥ 0. Made for uniform patches and small differences; large values only rank.

    Notes
    -----
    Sharma, Wu and Dalal 2005, "The CIEDE2000 color-difference formula: implementation notes, supplementary
    test data, and mathematical observations", eq. 2 to 22.
    """
    L1, a1, b1 = np.moveaxis(np.asarray(lab1, np.float64), -1, 0)
    L2, a2, b2 = np.moveaxis(np.asarray(lab2, np.float64), -1, 0)
    c7 = (0.5 * (np.hypot(a1, b1) + np.hypot(a2, b2))) ** 7
    stretch = 1.5 - 0.5 * np.sqrt(c7 / (c7 + 25.0**7))  # 1 + G, eq. 4
    a1, a2 = a1 * stretch, a2 * stretch
    C1, C2 = np.hypot(a1, b1), np.hypot(a2, b2)
    h1, h2 = (np.degrees(np.arctan2(b, a)) % 360.0 for a, b in ((a1, b1), (a2, b2)))

    grey = C1 * C2 == 0
    turn = h2 - h1
    turn = np.where(turn > 180, turn - 360, np.where(turn < -180, turn + 360, turn))  # eq. 10
    dL, dC = L2 - L1, C2 - C1
    dH = 2 * np.sqrt(C1 * C2) * np.sin(np.radians(np.where(grey, 0.0, turn)) / 2)

    L, C, total = 0.5 * (L1 + L2), 0.5 * (C1 + C2), h1 + h2
    far = np.abs(h1 - h2) > 180
    h = np.where(
        grey, total, 0.5 * np.where(far, np.where(total < 360, total + 360, total - 360), total)
    )  # eq. 14

    def cosine(multiple: float, offset: float) -> np.ndarray:
        return np.cos(np.radians(multiple * h + offset))

    T = 1 - 0.17 * cosine(1, -30) + 0.24 * cosine(2, 0) + 0.32 * cosine(3, 6) - 0.20 * cosine(4, -63)
    rotation = 30 * np.exp(-np.minimum(((h - 275) / 25) ** 2, 700.0))
    c7 = C**7
    R = -np.sin(np.radians(2 * rotation)) * 2 * np.sqrt(c7 / (c7 + 25.0**7))
    S_L = 1 + 0.015 * (L - 50) ** 2 / np.sqrt(20 + (L - 50) ** 2)
    tL, tC, tH = dL / S_L, dC / (1 + 0.045 * C), dH / (1 + 0.015 * C * T)
    return np.sqrt(np.maximum(tL**2 + tC**2 + tH**2 + R * tC * tH, 0.0))


def delta_e00(test: ArrayLike, reference: ArrayLike, display: Display) -> np.ndarray:
    """CIEDE2000 between two pictures of linear radiance as a display shows them.

    Parameters
    ----------
    test, reference : (..., 3) array
        Linear Rec. 709 radiance.
    display : Display
        The same for both.

    Returns
    -------
    (...) float64 array
    """
    return ciede2000(lab(display.linear(reference)), lab(display.linear(test)))
