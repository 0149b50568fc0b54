"""The whole decomposition: heights, normals, fusion, reflectance, materials (Menzel and Guthe 2009, section 5)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from btfref.errors import InputError
from btfref.numerics.heightfield import HEIGHT_LIMIT, HeightField
from btfref.numerics.solvers.threads import reproducible
from btfref.outputs import new_file
from btfref.representations.gbrdf.build import from_maps
from btfref.representations.gbrdf.decomposition import heights as height_stage
from btfref.representations.gbrdf.decomposition.materials import cluster_materials
from btfref.representations.gbrdf.decomposition.normals import fuse, helmholtz_normals
from btfref.representations.gbrdf.decomposition.pairs import N_PAIRS, ReciprocalPairs, mean_luminance
from btfref.representations.gbrdf.decomposition.reflectance import material_reflectance, texel_reflectance
from btfref.representations.gbrdf.decomposition.samples import GROUP, SurfaceSamples, texels_together
from btfref.representations.lookup import positive_integer
from btfref.representations.protocol import FitMemory

if TYPE_CHECKING:
    from btfref.representations.gbrdf.definition import Representation
    from btfref.sampling.blocks import BTFBlocks
    from btfref.types import PathLike, Progress


#: What heights can be told by.
SIMILARITIES = ("reciprocity", "correlation")

#: See :mod:`btfref.representations.fit_memory`.
FIT_MEMORY = FitMemory(view=4, rows=6, texels=2 * GROUP, texel=16_000, field=4, scales=("layers", "pairs"))

#: "paper": correlation in windows of 5 × 5 and depth weight 0.2 (section 6). The unit of the paper's smoothness, 0.1,
#: is not given; in ours 0.1 flattens everything, 0.02 is the best for the correlation.
PRESETS = {
    "paper": {"similarity": "correlation", "window": 5, "smoothness": 0.02, "depth_weight": 0.2},
}


@reproducible()
def fit(
    btf: BTFBlocks,
    *,
    seed: int = 0,
    progress: Progress | None = None,
    depth: float = 0.25,
    layers: int = 32,
    pairs: int = N_PAIRS,
    window: int = 5,
    similarity: str = "reciprocity",
    smoothness: float = 0.01,
    depth_weight: float = 0.05,
    materials: int | None = None,
    largest: int = 6,
    ndf_size: int = 32,
    iterations: int = 4,
    storage: str = "half",
    filter_type: str = "bilinear",
    intermediates: PathLike | dict[str, np.ndarray] | None = None,
) -> Representation:
    """Decompose a sampled BTF into a g-BRDF.

    Parameters
    ----------
    btf : BTFBlocks
    seed : int
        Same seed, same result.
    progress : callable, optional
        ``progress(done, total, label)``.
    depth : float
        Tile units below z = 0 in which heights are looked for, (0, 4].
    layers : int
        Candidate heights, at least 1.
    pairs : int
        Reciprocal pairs of images that take part, at least 1.
    window : int
        Side of the correlation window in texels, at least 1.
    similarity : {"reciprocity", "correlation"}
        What heights are told by: how well one normal explains all reciprocal pairs of a texel, or the paper's
        correlation of windows (eq. 5). On the checker, whose squares have no texture inside, the heights of the latter
        are four times as wrong.
    smoothness : float
        Of the minimum cut, at least 0; see `btfref.representations.gbrdf.decomposition.heights.minimum_cut`.
    depth_weight : float
        λ of the fusion of heights and normals, (0, 1].
    materials : int, optional
        Number of materials, at least 1; default: by the separation index, at most ``largest``.
    largest : int
        Most materials that the separation index may choose, at least 1.
    ndf_size : int
        Texels per side of the distributions, a power of two.
    iterations : int
        Alternations of the materials' least squares, at least 1.
    storage : {"half", "float"}
        Type of the stored maps.
    filter_type : {"bilinear", "nearest"}
        Lookup between texels.
    intermediates : path-like or dict, optional
        An ``.npz`` file, or a dictionary, for the maps of every stage: ``similarity`` (layers, rows, columns),
        ``layers``, ``cut`` and ``fused`` heights in tile units, ``slopes`` of the normals, ``texel_diffuse``,
        ``texel_specular``, ``texel_fresnel``, ``texel_ndf`` in luminance, ``labels``, ``rotation``, ``separation``
        (number of materials, index).

    Returns
    -------
    btfref.representations.gbrdf.definition.Representation
        ``meta["fit"]``: ``materials``, ``separation``, ``normals`` (convergence).

    Raises
    ------
    InputError
        For parameters out of range, or values that are not finite.
    """
    named = {"layers": layers, "pairs": pairs, "window": window, "largest": largest, "iterations": iterations}
    for name, count in named.items():
        positive_integer(name, count)
    if materials is not None:
        positive_integer("materials", materials)
    if positive_integer("ndf_size", ndf_size) & (ndf_size - 1):
        raise InputError(
            "a parameter is out of range", field="ndf_size", got=ndf_size, expected="a power of two"
        )
    for name, value, low, high in (
        ("depth", depth, 0.0, HEIGHT_LIMIT),
        ("depth_weight", depth_weight, 0.0, 1.0),
        ("smoothness", smoothness, -1e-30, np.inf),
    ):
        if not (np.isfinite(value) and low < value <= high):
            expected = f"in ({max(low, 0):g}, {high:g}]"
            raise InputError("a parameter is out of range", field=name, got=value, expected=expected)
    if similarity not in SIMILARITIES:
        expected = " or ".join(SIMILARITIES)
        raise InputError("a parameter is out of range", field="similarity", got=similarity, expected=expected)
    report = progress or (lambda *_: None)
    shape, together = btf.texels, texels_together(btf)
    reciprocal = ReciprocalPairs(btf, pairs, seed)
    stages = {"layers": height_stage.height_layers(depth, layers)}
    if not len(reciprocal):
        stages["cut"] = np.zeros(shape)
    else:
        if similarity == "correlation":
            volume = height_stage.similarity(reciprocal, stages["layers"], window, report)
        else:
            volume = height_stage.reciprocity_similarity(reciprocal, stages["layers"], report)
        stages["similarity"] = volume
        report(0, 1, "minimum cut")
        stages["cut"] = height_stage.minimum_cut(volume, stages["layers"], smoothness)
        report(1, 1, "minimum cut")
    stages["slopes"], summary = helmholtz_normals(reciprocal, stages["cut"], report)
    fused = fuse(stages["cut"], stages["slopes"], depth_weight)
    # Nothing rises above the plane that the BTF was taken on.
    fused = np.clip(fused, -HEIGHT_LIMIT, 0)
    stages["fused"] = fused

    low, high = float(fused.min()), float(fused.max())
    unit = (fused - low) / (high - low) if high > low else np.ones(shape)
    surface_heights = HeightField((low + (high - low) * unit).astype(np.float32))
    mean = mean_luminance(btf, 4)
    points = SurfaceSamples(btf, surface_heights, stride=2, mean=mean)
    texels = texel_reflectance(btf, points, together=together, progress=report)
    stages |= {f"texel_{name}": values for name, values in texels.items()}
    clustering, separation = cluster_materials(
        texels["ndf"], shape, largest=largest, count=materials, seed=seed
    )
    labels, n_materials = clustering.labels, len(clustering.centres)
    stages["labels"], stages["rotation"] = labels.reshape(shape), clustering.rotation.reshape(shape)
    stages["separation"] = np.array(list(separation.items()))
    found = material_reflectance(
        btf,
        SurfaceSamples(btf, surface_heights, stages["rotation"], mean=mean),
        labels,
        n_materials,
        size=ndf_size,
        iterations=iterations,
        together=together,
        progress=report,
    )
    parameters = {
        "seed": seed,
        "depth": depth,
        **named,
        "similarity": similarity,
        "smoothness": smoothness,
        "depth_weight": depth_weight,
        "materials": materials,
        "ndf_size": ndf_size,
        "storage": storage,
    }
    representation = from_maps(
        unit,
        height_min=low,
        height_max=high,
        diffuse=found["diffuse"].reshape(*shape, 3),
        fresnel=found["fresnel"].reshape(shape),
        rotation=stages["rotation"],
        material=stages["labels"],
        ndf=found["ndf"],
        specular=found["specular"],
        views=btf.views,
        lights=btf.lights,
        filter_type=filter_type,
        storage=storage,
        parameters=parameters,
        parent=btf.attributes,
    )
    finite = {str(k): v for k, v in separation.items() if np.isfinite(v)}
    representation.meta["fit"] = {"materials": n_materials, "separation": finite, "normals": summary}
    if isinstance(intermediates, dict):
        intermediates.update(stages)
    elif intermediates is not None:
        save_stages(stages, intermediates)
    return representation


def save_stages(stages: dict[str, np.ndarray], path: PathLike) -> None:
    """Write the maps of the stages as one ``.npz`` file.

    Raises
    ------
    InputError
        When the folder does not exist.
    """
    with new_file(path) as draft, draft.open("wb") as stream:
        np.savez(stream, allow_pickle=True, **stages)
