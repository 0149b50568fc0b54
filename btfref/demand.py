"""What a scene needs of its representations: the measured views that its camera can ask for."""

from __future__ import annotations

import numpy as np

#: Directions that differ by so much, in each of four directions, may ask for other neighbours: renderers round.
MARGIN = 1e-4


def scene_views(scene, *, parameters=None, grid=4, size=None):
    """Measured views that the direct view of a scene interpolates, by file.

    Parameters
    ----------
    scene : path-like or dict
        Mitsuba scene.
    parameters : dict of str to str, optional
        Values for ``$name`` in the file.
    grid : int
        n of the n × n sub-pixel samples.
    size : (int, int), optional
        Width and height in place of the scene's.

    Returns
    -------
    dict of str to ndarray of int
        Absolute path of each BTF to the indices of its views, sorted. Reflections of reflections may need others.

    Raises
    ------
    InputError
        For a scene that cannot be read.
    """
    from btfref.numerics import interpolation
    from btfref.render.reference import film_rays, grid_offsets, loaded
    from btfref.render.scene import read_scene
    from btfref.representations import load

    meshes = read_scene(scene, parameters, size=size).meshes
    tables, needed = {}, {}
    with loaded(scene, parameters, size=size) as made:
        import mitsuba as mi

        for offset in grid_offsets(grid):
            ray, _ = film_rays(made.sensors()[0], offset)
            si = made.ray_intersect(ray)
            w = np.array(si.wi, float).T
            for mesh, shape in zip(meshes, made.shapes(), strict=True):
                if mesh.material is None:
                    continue
                name = mesh.material.filename
                if name not in tables:
                    tables[name] = interpolation.from_arrays(load(name).arrays(), "view")
                    needed[name] = set()
                seen = np.array(si.is_valid() & (si.shape == mi.ShapePtr(shape)))
                needed[name] |= _neighbours(tables[name], _local(w[seen], mesh.material))
    return {name: np.array(sorted(views), np.int64) for name, views in needed.items()}


def _local(w, material):
    """View directions in the texture's frame, those that reflect."""
    c, s = material.rotation
    w = np.stack([c * w[:, 0] - s * w[:, 1], s * w[:, 0] + c * w[:, 1], w[:, 2]], 1)
    if material.twosided:
        w[:, 2] = np.abs(w[:, 2])
    return w[w[:, 2] > -MARGIN]


def _neighbours(table, w):
    """Views with weight at the directions or close to them."""
    shifts = MARGIN * np.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    w = (w + shifts[:, None]).reshape(-1, 3)
    w[:, 2] = np.maximum(w[:, 2], 1e-6)
    index, weight = table.stencil(w / np.linalg.norm(w, axis=1, keepdims=True))
    return set(np.unique(index[weight > 0]).tolist())
