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
