"""What the camera sees, as points with local frames: where float64 definitions of a picture are evaluated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from btfref.errors import InputError
from btfref.numerics.footprint import TINY, cone_footprint
from btfref.representations import read_info

#: Shapes whose triangles are a tessellation of ours.
ANALYTIC = ("sphere", "disk", "cylinder")


def _barycentric(corners, position):
    """Coordinates of points in the planes of triangles; (3, 3) or (N, 3, 3), (N, 3) -> (N, 3)."""
    a, b, c = np.moveaxis(corners, -2, 0)
    e1, e2, d = b - a, c - a, position - a
    normal = np.cross(e1, e2)
    square = (normal * normal).sum(-1)
    v = (np.cross(d, e2) * normal).sum(-1) / square
    w = (np.cross(e1, d) * normal).sum(-1) / square
    return np.stack([1 - v - w, v, w], -1)


@dataclass(frozen=True)
class Points:
    """What one sub-pixel sample of all pixels sees of one shape.

    Parameters
    ----------
    shape : (int, int)
        Height and width of the picture.
    pixel : ndarray of int, shape (N,)
        Flat index, row by row.
    material : BtfMaterial
    mesh : int
        Index of the shape in the scene.
    position : ndarray, shape (N, 3)
        World space.
    uv : ndarray, shape (N, 2)
        Of the texture, transformed.
    w_view : ndarray, shape (N, 3)
        In the texture's frame; on two-sided surfaces above the horizon.
    to_world : ndarray, shape (N, 3, 3)
        Columns: the frame's axes in world space; the third one points to the side that is seen where that is the back.
    triangle : ndarray of int, shape (N,)
        Mitsuba's, of a mesh.
    footprint : tuple
        ``lod (N,)``, ``step (N, 2)`` in texture coordinates, ``ratio (N,)``; see
        :func:`btfref.numerics.footprint.cone_footprint`.
    """

    shape: tuple
    pixel: np.ndarray
    material: object
    mesh: int
    position: np.ndarray
    uv: np.ndarray
    w_view: np.ndarray
    to_world: np.ndarray
    triangle: np.ndarray
    footprint: tuple

    def place(self, mesh):
        """Triangle and barycentric coordinates of every point.

        Parameters
        ----------
        mesh : MeshDescription
            The points' own.

        Returns
        -------
        triangle : ndarray of int, shape (N,)
        barycentric : ndarray of float64, shape (N, 3)

        Raises
        ------
        InputError
            For a curved shape that is no mesh: its triangles are not those that the camera sees.
        """
        corners = np.asarray(mesh.positions, float)[mesh.faces]
        if mesh.plugin == "rectangle":
            every = [_barycentric(corners[k], self.position) for k in range(len(corners))]
            triangle = np.argmax([b.min(1) for b in every], axis=0)
        elif mesh.plugin in ANALYTIC:
            raise InputError("a mesh is needed", field=mesh.name, got=mesh.plugin, expected="such as ply")
        else:
            triangle = self.triangle.astype(np.int64)
        return triangle, _barycentric(corners[triangle], self.position)


def visible_points(scene, description, *, parameters=None, size=None, grid=4, pixels=None):
    """Primary hits of a regular sub-pixel grid, sample by sample and shape by shape.

    Parameters
    ----------
    scene : path-like or dict
    description : SceneDescription
        Of the same scene.
    parameters, size, grid, pixels
        As of :func:`btfref.rendering.offline.approximate.approximate`.

    Yields
    ------
    Points

    Raises
    ------
    InputError
        For a shape without a BTF.
    """
    from btfref.scene.camera import film_rays, grid_offsets
    from btfref.scene.loading import loaded

    for mesh in description.meshes:
        if mesh.material is None:
            where = f"{description.source}: shape {mesh.name}"
            raise InputError(
                "the approximation needs a btf material", file=where, field="bsdf", got=mesh.bsdf
            )
    texels, camera = {}, description.camera
    with loaded(scene, parameters, size=size) as made:
        import mitsuba as mi

        for offset in grid_offsets(grid):
            ray, _ = film_rays(made.sensors()[0], offset)
            si = made.ray_intersect(ray)
            frame = [np.array(v, float).T for v in (si.sh_frame.s, si.sh_frame.t, si.sh_frame.n)]
            surface = [np.array(v, float).T for v in (si.p, si.n, si.dp_du, si.dp_dv)]
            uv, wi = np.array(si.uv, float).T, np.array(si.wi, float).T
            frame, triangle = np.stack(frame, 1), np.array(si.prim_index)
            seen = np.array(si.is_valid())
            if pixels is not None:
                seen &= np.ravel(pixels)
            for number, (mesh, shape) in enumerate(zip(description.meshes, made.shapes(), strict=True)):
                at = np.flatnonzero(seen & np.array(si.shape == mi.ShapePtr(shape)))
                if not len(at):
                    continue
                material = mesh.material
                c, s = material.rotation
                turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
                to_local, w_view = turn @ frame[at], wi[at] @ turn.T
                if material.twosided:
                    # Both directions are mirrored at the surface, the tangents stay: as Mitsuba's twosided.
                    side = np.where(w_view[:, 2] < 0, -1.0, 1.0)
                    w_view[:, 2] *= side
                    to_local[:, 2] *= side[:, None]
                name = material.filename
                if name not in texels:
                    texels[name] = read_info(name)["shape"][2:4]
                place = [a[at] for a in surface]
                yield Points(
                    (camera.height, camera.width),
                    at,
                    material,
                    number,
                    place[0],
                    uv[at] @ material.to_uv[:, :2].T + material.to_uv[:, 2],
                    w_view,
                    to_local.transpose(0, 2, 1),
                    triangle[at],
                    _footprint(material, texels[name], camera, grid, *place),
                )


def _footprint(material, texels, camera, grid, position, normal, dp_du, dp_dv):
    """Level of detail, step in texture coordinates and ratio of every point."""
    towards = camera.origin - position
    distance = np.linalg.norm(towards, axis=1)
    n = len(position)
    if material.lod == "auto":
        e, f, g = ((a * b).sum(1) for a, b in ((dp_du, dp_du), (dp_du, dp_dv), (dp_dv, dp_dv)))
        area = (e * g - f * f)[:, None]
        inverse = np.where(area > 0, 1 / np.where(area > 0, area, 1), 0)
        of_u = (dp_du * g[:, None] - dp_dv * f[:, None]) * inverse
        of_v = (dp_dv * e[:, None] - dp_du * f[:, None]) * inverse
        size = np.array(texels[::-1], float)
        u, v = (k * (a[0] * of_u + a[1] * of_v) for k, a in zip(size, material.to_uv, strict=True))
        width = camera.pixel_angle / grid * distance
        lod, step, ratio = cone_footprint(u, v, towards / distance[:, None], normal, width)
        return material.lod_bias + lod, step / size, ratio
    lod = np.full(n, float(material.lod_bias))
    if material.lod == "distance":
        lod += np.log2(np.clip(distance / material.lod_unit, TINY, 1e30))
    return lod, np.zeros((n, 2)), np.ones(n)
