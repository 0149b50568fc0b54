"""Luminance and colour differences of linear Rec. 709 (ITU-R BT.709-6, items 3.2 and 3.3, without the transfer curve).

``Y = K · rgb``, ``Cb = (B − Y) / (2 (1 − K_b))``, ``Cr = (R − Y) / (2 (1 − K_r))``: linear values stay linear, so that
filtering commutes with the transform.
"""

from __future__ import annotations

import numpy as np

from btfref.conventions import LUMINANCE

#: rgb -> (Y, Cb, Cr).
FROM_RGB = np.stack(
    [
        LUMINANCE,
        (np.array([0, 0, 1]) - LUMINANCE) / (2 * (1 - LUMINANCE[2])),
        (np.array([1, 0, 0]) - LUMINANCE) / (2 * (1 - LUMINANCE[0])),
    ]
)

#: (Y, Cb, Cr) -> rgb: R = Y + 1.5748 Cr, B = Y + 1.8556 Cb, G from both and Y.
TO_RGB = np.linalg.inv(FROM_RGB)

#: Squared error of rgb as a quadratic form of the errors of Y, Cb and Cr.
RGB_METRIC = TO_RGB.T @ TO_RGB

#: The part of each channel alone.
RGB_WEIGHT = np.diag(RGB_METRIC).copy()

CHANNELS = ("Y", "Cb", "Cr")
