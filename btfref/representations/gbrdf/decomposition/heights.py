"""Heights from the similarity of reciprocal images: correlation over layers and a minimum cut.

Sources: Menzel and Guthe 2009, eq. 5 and 6; S. Roy, I. J. Cox, "A Maximum-Flow Formulation of the N-Camera Stereo
Correspondence Problem", ICCV 1998; for the baseline T. Zickler, P. Belhumeur, D. Kriegman, "Helmholtz Stereopsis",
IJCV 49, 2002.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from btfref.representations.gbrdf.decomposition.pairs import shifted, tangent

if TYPE_CHECKING:
    from btfref.representations.gbrdf.decomposition.pairs import ReciprocalPairs
    from btfref.types import Progress


#: Variance of log luminance in a window that counts as texture: below it a correlation is noise and fades to 0.
_QUIET = 1e-4


def height_layers(depth: float, count: int) -> np.ndarray:
    """Candidate heights from ``−depth`` to 0, shape (count,)."""
    return np.linspace(-depth, 0, count)


def similarity(
    pairs: ReciprocalPairs, layers: np.ndarray, window: int = 5, progress: Progress | None = None
) -> np.ndarray:
    """Mean normalized cross-correlation of reciprocal images at each texel and height (eq. 5).

    Parameters
    ----------
    pairs : btfref.representations.gbrdf.decomposition.pairs.ReciprocalPairs
    layers : ndarray, shape (n_layers,)
        Heights in tile units.
    window : int
        Side of the neighbourhood in texels.
    progress : callable, optional

    Returns
    -------
    ndarray of float32, shape (n_layers, rows, columns)
        In [−1, 1].
    """
    from scipy.ndimage import uniform_filter

    def mean(image: np.ndarray) -> np.ndarray:
        return uniform_filter(image, window, mode="wrap")

    total = np.zeros((len(layers), *pairs.shape), np.float32)
    for pair in range(len(pairs)):
        first, second = pairs.logarithms(pair)
        # The global means are taken out: variances then lose no digits in float32.
        first, second = first - first.mean(), second - second.mean()
        at = tangent(np.stack([pairs.first[pair], pairs.second[pair]]))
        for layer, z in enumerate(layers):
            a, b = shifted(first, -z * at[0]), shifted(second, -z * at[1])
            mean_a, mean_b = mean(a), mean(b)
            cross = mean(a * b) - mean_a * mean_b
            power = np.maximum(mean(a * a) - mean_a**2, 0) * np.maximum(mean(b * b) - mean_b**2, 0)
            total[layer] += cross / (np.sqrt(power) + _QUIET)
        if progress:
            progress(pair + 1, len(pairs), "similarity")
    return total / max(len(pairs), 1)


def correlation_heights(volume: np.ndarray, layers: np.ndarray) -> np.ndarray:
    """The height of the largest correlation, texel by texel: the baseline "NCC" of figure 6."""
    return layers[np.argmax(volume, 0)]


def minimum_cut(volume: np.ndarray, layers: np.ndarray, smoothness: float = 0.1) -> np.ndarray:
    """Heights of least cost by a minimum cut through the volume, periodic over the tile.

    A column of nodes a texel; cutting its edge of layer k costs ``(1 − S_k)/2``, and neighbours whose cuts differ by j
    layers pay ``smoothness · j``, scaled so that the depth of the volume costs the same for any number of layers.

    Parameters
    ----------
    volume : ndarray, shape (n_layers, rows, columns)
        Similarity.
    layers : ndarray, shape (n_layers,)
    smoothness : float
        Per step of 1/32 of the depth between four-neighbours, in units of the cost's spread over a column; diagonal
        neighbours pay 1/√2 of it.

    Returns
    -------
    ndarray of float64, shape (rows, columns)
        Tile units, refined between layers by the parabola through the similarity's peak.
    """
    import maxflow

    n_layers, rows, columns = volume.shape
    if n_layers == 1:
        return np.full((rows, columns), layers[0])
    cost = (1 - np.moveaxis(volume, 0, -1).astype(float)) / 2
    scale = float(np.mean(cost.max(-1) - cost.min(-1))) * 32 / n_layers
    graph = maxflow.Graph[float](rows * columns * (n_layers - 1), 0)
    nodes = graph.add_grid_nodes((rows, columns, n_layers - 1))
    # No capacity ever reaches this: a column is cut once.
    infinite = float(cost.max() * n_layers + 8 * n_layers)
    graph.add_grid_tedges(nodes[..., 0], cost[..., 0], 0)
    graph.add_grid_tedges(nodes[..., -1], 0, cost[..., -1])
    if n_layers > 2:
        below, above = nodes[..., :-1].ravel(), nodes[..., 1:].ravel()
        graph.add_edges(below, above, cost[..., 1:-1].ravel(), np.full(below.size, infinite))
    for dy, dx, share in ((0, 1, 1.0), (1, 0, 1.0), (1, 1, 2**-0.5), (1, -1, 2**-0.5)):
        beside = np.roll(nodes, (-dy, -dx), (0, 1)).ravel()
        here = nodes.ravel()
        apart = here != beside
        capacity = np.full(int(apart.sum()), smoothness * scale * share)
        graph.add_edges(here[apart], beside[apart], capacity, capacity)
    graph.maxflow()
    # get_grid_segments: False on the source's side. The edge that is cut follows the last node of that side.
    label = (~graph.get_grid_segments(nodes)).sum(-1)
    return _between_layers(volume, layers, label)


def _between_layers(volume: np.ndarray, layers: np.ndarray, label: np.ndarray) -> np.ndarray:
    """Layer labels refined by the peak of the parabola through three similarities, by at most half a layer."""
    inner = np.clip(label, 1, len(layers) - 2)
    if len(layers) < 3:
        return layers[label]
    low, middle, high = (
        np.take_along_axis(volume, (inner + k)[None], 0)[0].astype(float) for k in (-1, 0, 1)
    )
    bend = 2 * middle - low - high
    peak = (label == inner) & (middle >= low) & (middle >= high) & (bend > 1e-9)
    offset = np.where(peak, 0.5 * (high - low) / np.where(peak, bend, 1), 0)
    return layers[label] + np.clip(offset, -0.5, 0.5) * (layers[1] - layers[0])


def helmholtz_stereopsis(
    pairs: ReciprocalPairs, layers: np.ndarray, progress: Progress | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Heights and normals by reciprocity alone, texel by texel: the baseline of figure 6.

    For the right height, ``L(b, a) a − L(a, b) b`` is orthogonal to the normal for all pairs (a, b); the height of the
    smallest share of the third eigenvalue wins.

    Returns
    -------
    heights : ndarray, shape (rows, columns)
    slopes : ndarray, shape (rows, columns, 2)
    """
    least, best = reciprocity_normals(pairs, layers[0])
    heights = np.full(least.shape, layers[0])
    for number, z in enumerate(layers[1:], 1):
        if progress:
            progress(number, len(layers), "Helmholtz stereopsis")
        share, normal = reciprocity_normals(pairs, z)
        better = share < least
        least, heights = np.where(better, share, least), np.where(better, z, heights)
        best = np.where(better[..., None], normal, best)
    if progress:
        progress(len(layers), len(layers), "Helmholtz stereopsis")
    return heights, slopes_of(best)


def reciprocity_similarity(
    pairs: ReciprocalPairs, layers: np.ndarray, progress: Progress | None = None
) -> np.ndarray:
    """How well one normal explains all reciprocal pairs of each texel at each height, for :func:`minimum_cut`.

    The reciprocity that Helmholtz stereopsis minimises texel by texel, as a volume. It needs no texture in the
    neighbourhood, only a normal that different pairs agree on.

    Parameters
    ----------
    pairs : btfref.representations.gbrdf.decomposition.pairs.ReciprocalPairs
    layers : ndarray, shape (n_layers,)
    progress : callable, optional

    Returns
    -------
    ndarray of float32, shape (n_layers, rows, columns)
        1 minus twice the residual over its mean range: at most 1, on the scale of a correlation.
    """
    shares = []
    for number, z in enumerate(layers):
        shares.append(reciprocity_normals(pairs, z)[0])
        if progress:
            progress(number + 1, len(layers), "reciprocity")
    residual = np.stack(shares)
    spread = float(np.mean(residual.max(0) - residual.min(0)))
    return (1 - 2 * residual / (spread if spread > 0 else 1)).astype(np.float32)


def reciprocity_normals(pairs: ReciprocalPairs, z: float) -> tuple[np.ndarray, np.ndarray]:
    """Normals that fit reciprocity best in linear least squares, at one height for all texels.

    Returns
    -------
    share : ndarray, shape (rows, columns)
        Smallest eigenvalue over the sum of all: 0 where reciprocity holds exactly.
    normal : ndarray, shape (rows, columns, 3)
    """
    matrix = np.zeros((*pairs.shape, 3, 3))
    for pair in range(len(pairs)):
        a, b = pairs.first[pair], pairs.second[pair]
        seen_a, seen_b = pairs.images(pair)
        at = shifted(seen_a, -z * tangent(a)), shifted(seen_b, -z * tangent(b))
        scale = 1 / np.maximum(at[0] + at[1], pairs.black)
        row = ((at[0] * scale)[..., None] * a - (at[1] * scale)[..., None] * b).astype(float)
        matrix += row[..., :, None] * row[..., None, :]
    values, vectors = np.linalg.eigh(matrix)
    normal = vectors[..., 0]
    normal = normal * np.where(normal[..., 2:] < 0, -1, 1)
    total = values.sum(-1)
    return values[..., 0] / np.where(total > 0, total, 1), normal


def slopes_of(normal: np.ndarray, limit: float = 5.0) -> np.ndarray:
    """Slopes ``−n_xy / n_z`` of normals, held at ``limit``; shape (..., 3) -> (..., 2)."""
    z = np.maximum(normal[..., 2:], 1e-6)
    return np.clip(-normal[..., :2] / z, -limit, limit)
