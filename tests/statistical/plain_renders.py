"""Plain Mitsuba renders of mesostructure that share no code with the synthesis: own tiling, own camera."""

import numpy as np


def patch(mi, mesostructure, reach):
    """The tile and its neighbours as one mesh per material (no instances): dict of shapes."""
    shapes = {}
    offsets = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1)] * 2), -1).reshape(-1, 2)
    for index, part in enumerate(mesostructure.parts):
        n = len(part.vertices)
        vertices = np.concatenate([part.vertices + np.append(offset, 0) for offset in offsets])
        faces = np.concatenate([part.faces + n * copy for copy in range(len(offsets))])
        properties = mi.Properties()
        properties["material"] = mi.load_dict(part.bsdf)
        mesh = mi.Mesh(
            f"material_{index}",
            len(vertices),
            len(faces),
            has_vertex_normals=True,
            has_vertex_texcoords=part.uv is not None,
            props=properties,
        )
        values = mi.traverse(mesh)
        values["vertex_positions"] = vertices.astype(np.float32).ravel()
        values["vertex_normals"] = np.tile(part.normals, (len(offsets), 1)).astype(np.float32).ravel()
        values["faces"] = faces.astype(np.uint32).ravel()
        if part.uv is not None:
            # Fibres run along u: without it an anisotropic BSDF is turned any way.
            values["vertex_texcoords"] = np.tile(part.uv, (len(offsets), 1)).astype(np.float32).ravel()
        values.update()
        shapes[f"material_{index}"] = mesh
    return shapes


def texel_camera(mi, view, texels):
    """An orthographic camera, sheared so that pixel (row, column) sees exactly that texel's square on z = 0.

    Mitsuba's orthographic film spans [−1, 1]² in camera space with +x to the left and +y up, rays along +z.
    The columns of the matrix are the images of these axes: pixel column → x, pixel row → y, ray → −view.
    """
    matrix = np.eye(4)
    matrix[:3, 0] = [-0.5, 0, 0]
    matrix[:3, 1] = [0, -0.5, 0]
    matrix[:3, 2] = -np.asarray(view)
    # The corner (0, 0) of the tile is pixel (0, 0); the camera stands two units up the view direction.
    matrix[:3, 3] = np.array([0.5, 0.5, 0]) + 2 * np.asarray(view)
    return mi.load_dict(
        {
            "type": "orthographic",
            "to_world": mi.ScalarTransform4f(matrix),
            "film": {
                "type": "hdrfilm",
                "width": texels,
                "height": texels,
                "rfilter": {"type": "box"},
                "pixel_format": "rgb",
                "component_format": "float32",
            },
            "sampler": {"type": "independent"},
        }
    )


class PlainRenders:
    """Means and variances of the mean of texels for chosen pairs, from independent `mi.render` calls."""

    def __init__(self, mi, mesostructure, *, texels, reach, max_depth):
        self.mi, self.texels = mi, texels
        self.shapes = patch(mi, mesostructure, reach)
        self.integrator = mi.load_dict({"type": "path", "max_depth": max_depth})
        self.scenes, self.cameras = {}, {}

    def scene(self, light):
        key = tuple(light)
        if key not in self.scenes:
            emitter = {"type": "directional", "direction": [-float(x) for x in light], "irradiance": 1.0}
            self.scenes[key] = self.mi.load_dict({"type": "scene", "light": emitter, **self.shapes})
        return self.scenes[key]

    def pair(self, view, light, *, spp, rounds, seed):
        """(texels, texels, 3) mean and variance of the mean from `rounds` renders of `spp` samples each."""
        key = tuple(view)
        if key not in self.cameras:
            self.cameras[key] = texel_camera(self.mi, view, self.texels)
        scene = self.scene(light)
        images = np.stack(
            [
                np.array(
                    self.mi.render(
                        scene,
                        sensor=self.cameras[key],
                        integrator=self.integrator,
                        spp=spp,
                        seed=seed + k,
                    ),
                    np.float64,
                )
                for k in range(rounds)
            ]
        )
        return images.mean(0), images.var(0, ddof=1) / rounds
