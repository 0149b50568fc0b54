"""Plain Mitsuba renders of mesostructure that share no code with the synthesis: the naive loop's tiling and camera."""

import numpy as np

from btfref.bench.synth_methods import merged, texel_camera

__all__ = ["PlainRenders", "texel_camera"]


class PlainRenders:
    """Means and variances of the mean of texels for chosen pairs, from independent `mi.render` calls."""

    def __init__(self, mi, mesostructure, *, texels, reach, max_depth):
        self.mi, self.texels = mi, texels
        self.shapes = merged(mi, mesostructure, reach)
        self.integrator = mi.load_dict({"type": "path", "max_depth": max_depth})
        self.cameras = {}
        emitter = {"type": "directional", "irradiance": 1.0}
        self._scene = mi.load_dict({"type": "scene", "light": emitter, **self.shapes})
        self._parameters = mi.traverse(self._scene)

    def scene(self, light):
        """The scene under this light; its tree of triangles is built once for all lights."""
        light = np.asarray(light, float)
        up = np.eye(3)[np.argmin(np.abs(light))].tolist()
        towards = self.mi.ScalarTransform4f().look_at(origin=[0, 0, 0], target=(-light).tolist(), up=up)
        self._parameters["light.to_world"] = self.mi.Transform4f(towards)
        self._parameters.update()
        return self._scene

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
