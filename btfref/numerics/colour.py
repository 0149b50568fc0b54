"""Colour spaces: linear Rec. 709, its sRGB encoding, CIE XYZ and Lab, and spectra under D65."""

from __future__ import annotations

from functools import cache
from importlib import resources

import numpy as np
from numpy.typing import ArrayLike


def _rgb_to_xyz() -> np.ndarray:
    """Matrix from the chromaticities of the primaries and of D65 (ITU-R BT.709-6, item 1.3 and 1.4)."""
    xy = np.array([[0.64, 0.33], [0.30, 0.60], [0.15, 0.06]])
    white = np.array([0.3127, 0.3290])

    def lift(chromaticity: np.ndarray) -> np.ndarray:
        x, y = chromaticity[..., 0], chromaticity[..., 1]
        return np.stack([x / y, np.ones_like(x), (1 - x - y) / y], axis=-1)

    primaries = lift(xy).T
    return primaries * np.linalg.solve(primaries, lift(white))


#: Columns: XYZ of the three primaries; white has Y = 1.
RGB_TO_XYZ = _rgb_to_xyz()

#: Linear Rec. 709 of XYZ under D65 where white has Y = 1: ``rgb = XYZ_TO_RGB @ xyz``.
XYZ_TO_RGB = np.linalg.inv(RGB_TO_XYZ)

#: Bradford's cone responses (Lam 1985; ICC.1:2010, annex E).
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])

#: White of the profile connection space, D50 (ICC.1:2010, 7.2.16).
_D50 = np.array([0.9642, 1.0, 0.8249])


def encode_srgb(linear: ArrayLike) -> np.ndarray:
    """The sRGB encoding of linear values in [0, 1] (IEC 61966-2-1), float64, same shape."""
    x = np.asarray(linear, np.float64)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 0.0031308) ** (1 / 2.4) - 0.055)


def decode_srgb(encoded: ArrayLike) -> np.ndarray:
    """Linear values of sRGB-encoded values in [0, 1] (IEC 61966-2-1), float64, same shape."""
    x = np.asarray(encoded, np.float64)
    return np.where(x <= 0.04045, x / 12.92, ((np.maximum(x, 0.04045) + 0.055) / 1.055) ** 2.4)


def rgb_from_xyz(xyz: ArrayLike) -> np.ndarray:
    """Linear Rec. 709 of CIE XYZ under D65, white at Y = 1; same shape (..., 3). Nothing is clipped."""
    return np.asarray(xyz) @ XYZ_TO_RGB.T.astype(np.result_type(xyz, np.float32))


def rgb_from_lab_d50(lab: ArrayLike) -> np.ndarray:
    """Linear Rec. 709 of CIE L*a*b* under D50, the profile connection space; same shape (..., 3).

    CIE 15:2004, 8.2.1.1 inverted, then Bradford's adaptation from D50 to D65. Nothing is clipped.
    """
    lab = np.asarray(lab)
    y = (lab[..., 0] + 16) / 116
    f = np.stack([y + lab[..., 1] / 500, y, y - lab[..., 2] / 200], -1)
    delta = 6 / 29
    xyz = np.where(f > delta, f**3, 3 * delta**2 * (f - 4 / 29)) * _D50
    d65 = RGB_TO_XYZ.sum(1)
    adapt = np.linalg.solve(_BRADFORD, np.diag((_BRADFORD @ d65) / (_BRADFORD @ _D50)) @ _BRADFORD)
    return rgb_from_xyz(xyz @ adapt.T)


@cache
def _observer() -> tuple[np.ndarray, np.ndarray]:
    """Wavelengths in nm and x̄, ȳ, z̄, each times the power of D65: CIE 018:2019 (2°, 1931) and CIE 15:2004."""
    text = resources.files("btfref.numerics").joinpath("cie1931_d65.csv").read_text("utf-8")
    table = np.array([line.split(",") for line in text.splitlines() if line[:1].isdigit()], float)
    return table[:, 0], table[:, 1:4] * table[:, 4:5]


def spectral_weights(wavelengths: ArrayLike) -> np.ndarray:
    """Weights that turn reflectance at some wavelengths into linear Rec. 709 under D65.

    Parameters
    ----------
    wavelengths : sequence of float
        In nm, each once, any order.

    Returns
    -------
    ndarray, shape (n, 3)
        ``rgb = spectrum @ weights``; a perfect diffuser (1 everywhere) gives (1, 1, 1). Between the wavelengths
        the spectrum is linear, beyond them it holds its end; the sum runs over 380 to 780 nm in steps of 5 nm.
    """
    wavelengths = np.asarray(wavelengths, float)
    order = np.argsort(wavelengths)
    grid, observer = _observer()
    hats = np.stack([np.interp(grid, wavelengths[order], row) for row in np.eye(len(order))])
    xyz = hats @ observer / observer[:, 1].sum()
    rgb = xyz @ XYZ_TO_RGB.T
    # The sum over 5 nm and the white point from chromaticities differ by 1e-4; white stays white.
    result = np.zeros_like(rgb)
    result[order] = rgb / rgb.sum(0)
    return result
