"""Derivatives of a rendered mean by the maps of a material, against differences of means in float64.

A small picture of a plane under two directional lights is rendered by ``prb``; the material stands beside another one,
so that Mitsuba calls it as it does in scenes. Each map is moved along a direction that is relative to its values, alone
and together with all others, by forward and by backward derivatives, and by central differences with Richardson's
extrapolation, at steps that get smaller until they agree. All of these take the same samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from btfref.gates import judge
from btfref.gates.tolerances import gate_table

if TYPE_CHECKING:
    from btfref.gates import GateResult
    from btfref.types import JitArray

#: Pixels of a side of the picture, and samples of each.
SIZE, SPP = 12, 16

#: Step of the first outer central difference, relative to the values of a map; the inner one is half of it.
STEP = 0.01

#: Times that it is halved at most.
HALVINGS = 5

#: Share of the gate's deviation within which two steps agree.
AGREEING = 0.25

#: Share of a map's root mean square by which values near zero are moved as well.
LEAST = 0.01

#: Steps of Adam, how far a map is moved away before them, relative to its root mean square, and the rate of the first
#: one, relative to that.
STEPS, AWAY, FIRST_RATE = 20, 0.3, 0.4

#: What its means of gradients and of their squares keep from step to step: twenty steps are few for 0.9 and 0.999.
KEPT = 0.7, 0.95

#: The gate.
GATE = "gradient.maps"

_SEED = 3
_MATERIAL = "subject.bsdf."


@dataclass(frozen=True)
class Slope:
    """Derivatives of the mean of a picture along a direction of some maps.

    Attributes
    ----------
    maps : tuple of str
    difference, forward, backward : float
        Relative to the mean itself.
    """

    maps: tuple[str, ...]
    difference: float
    forward: float
    backward: float

    @property
    def deviation(self) -> float:
        """The larger distance of a derivative from the difference, relative to the latter or to the gate's floor."""
        least = max(abs(self.difference), gate_table(GATE)["floor"])
        return max(abs(found - self.difference) for found in (self.forward, self.backward)) / least

    @property
    def silent(self) -> bool:
        """Whether a derivative is zero where the difference is not."""
        there = abs(self.difference) > gate_table(GATE)["floor"]
        return there and 0.0 in (self.forward, self.backward)


class Subject:
    """A material in the scene of the measurement.

    Parameters
    ----------
    material : mitsuba.BSDF
        Of the plugin ``btf``.
    seed : int
        Of the directions.
    """

    def __init__(self, material: JitArray, *, seed: int = 0) -> None:
        import drjit as dr
        import mitsuba as mi

        self.scene = mi.load_dict(_scene(material))
        self.parameters = mi.traverse(self.scene)
        self.names = tuple(
            key.removeprefix(_MATERIAL)
            for key in self.parameters.keys()
            if key.startswith(_MATERIAL) and self._differentiable(key)
        )
        rng = np.random.default_rng(seed)
        self._start, self._direction = {}, {}
        for name in self.names:
            # A copy: what is put in place of a parameter becomes it.
            start = type(self.parameters[_MATERIAL + name])(dr.detach(self.parameters[_MATERIAL + name]))
            values = np.array(start, float)
            size = np.abs(values) + LEAST * np.sqrt((values**2).mean())
            step = (rng.uniform(0.5, 1, values.shape) * size).astype(np.float32)
            self._start[name], self._direction[name] = start, type(start)(step)

    def _differentiable(self, key: str) -> bool:
        import mitsuba as mi

        return not self.parameters.flags(key) & mi.ParamFlags.NonDifferentiable

    def slope(self, maps: Sequence[str]) -> Slope:
        """Derivatives along the direction of some maps."""
        mean = self._mean(maps, 0.0)
        difference = self._difference(maps, mean)
        found = Slope(tuple(maps), difference / mean, self._forward(maps) / mean, self._backward(maps) / mean)
        self._put({name: type(self._start[name])(self._start[name]) for name in maps})
        return found

    def _difference(self, maps: Sequence[str], mean: float) -> float:
        """Central difference, extrapolated, of steps that are halved until two agree far better than the gate asks.

        A height field's normals turn samples away from the light within a percent of their size: extrapolation wants
        smaller steps there. These scatter by rounding; where none agree, the median of the last three counts.
        """
        gate, step = gate_table(GATE), STEP
        central = lambda h: (self._mean(maps, h) - self._mean(maps, -h)) / (2 * h)  # noqa: E731
        wide, narrow = central(step), central(0.5 * step)
        found = [(4 * narrow - wide) / 3]
        for _ in range(HALVINGS):
            step *= 0.5
            wide, narrow = narrow, central(0.5 * step)
            found.append((4 * narrow - wide) / 3)
            size = max(abs(found[-1]), gate["floor"] * mean)
            if abs(found[-1] - found[-2]) <= AGREEING * gate["deviation"] * size:
                return found[-1]
        return float(np.median(found[-3:]))

    def slopes(self) -> list[Slope]:
        """Of each map alone, and of all together."""
        alone = [self.slope([name]) for name in self.names]
        return [*alone, self.slope(self.names)]

    def approach(self, name: str, *, steps: int = STEPS) -> tuple[float, float]:
        """RMSE of the picture before and after steps of Adam, towards that of the map as it was, from one moved away.

        Every value of the map is moved by `AWAY` of the map's root mean square, up or down.

        Returns
        -------
        before, after : float
            Relative to the picture's mean.
        """
        import drjit as dr
        import mitsuba as mi

        key, start = _MATERIAL + name, self._start[name]
        target = self._picture()
        size = AWAY * float(np.sqrt((np.array(start, float) ** 2).mean()))
        sign = np.random.default_rng(1).choice([-size, size], start.shape).astype(np.float32)
        optimizer = mi.ad.Adam(lr=size, beta_1=KEPT[0], beta_2=KEPT[1])
        optimizer[key] = start + type(start)(sign)
        self.parameters.update(optimizer)
        before = _rmse(self._picture(), target)
        for step in range(steps):
            optimizer.set_learning_rate(FIRST_RATE * size * (1 - step / steps))
            picture = mi.render(self.scene, self.parameters, spp=SPP, seed=_SEED, seed_grad=_SEED + 1 + step)
            dr.backward(dr.mean(dr.square(picture - target), axis=None))
            optimizer.step()
            self.parameters.update(optimizer)
        after = _rmse(self._picture(), target)
        self._put({name: type(start)(start)})
        return before, after

    def _picture(self) -> JitArray:
        import drjit as dr

        sensor = self.scene.sensors()[0]
        with dr.suspend_grad():
            picture = self.scene.integrator().render(self.scene, sensor, seed=_SEED, spp=SPP)
        # Else each step would trace it anew.
        dr.eval(picture)
        return picture

    def _put(self, values: dict[str, JitArray]) -> None:
        self.parameters.update({_MATERIAL + name: value for name, value in values.items()})

    def _moved(self, maps: Sequence[str], t: JitArray) -> dict[str, JitArray]:
        return {name: self._start[name] + t * self._direction[name] for name in maps}

    def _mean(self, maps: Sequence[str], t: float) -> float:
        """Mean of the picture, added up in float64: a sum of floats would round the difference away."""
        import drjit as dr
        import mitsuba as mi

        self._put(self._moved(maps, dr.opaque(mi.Float, t)))
        return float(np.array(self._picture(), float).mean())

    def _forward(self, maps: Sequence[str]) -> float:
        import drjit as dr
        import mitsuba as mi

        t = mi.Float(0)
        dr.enable_grad(t)
        self._put(self._moved(maps, t))
        dr.forward(t, flags=dr.ADFlag.ClearEdges)
        sensor = self.scene.sensors()[0]
        slope = self.scene.integrator().render_forward(
            self.scene, self.parameters, sensor, seed=_SEED, spp=SPP
        )
        return float(np.array(slope, float).mean())

    def _backward(self, maps: Sequence[str]) -> float:
        import drjit as dr
        import mitsuba as mi

        own = {name: type(self._start[name])(self._start[name]) for name in maps}
        dr.enable_grad(*own.values())
        self._put(own)
        share = dr.full(mi.TensorXf, 1 / (3 * SIZE * SIZE), (SIZE, SIZE, 3))
        sensor = self.scene.sensors()[0]
        self.scene.integrator().render_backward(
            self.scene, self.parameters, share, sensor, seed=_SEED, spp=SPP
        )
        return sum(
            float((np.array(dr.grad(value), float) * np.array(self._direction[name], float)).sum())
            for name, value in own.items()
        )


def _rmse(picture: JitArray, target: JitArray) -> float:
    a, b = np.array(picture, float), np.array(target, float)
    return float(np.sqrt(((a - b) ** 2).mean()) / b.mean())


def gradient_gates(slopes: Sequence[Slope]) -> list[GateResult]:
    """The verdict on all slopes of a material."""
    worst = max((slope.deviation for slope in slopes), default=None)
    return judge(GATE, {"deviation": worst, "silent": float(sum(slope.silent for slope in slopes))})


def _scene(material: JitArray) -> dict[str, object]:
    """A plane of the material and a diffuse one beside it, seen obliquely."""
    import mitsuba as mi

    t = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    return {
        "type": "scene",
        "integrator": {"type": "prb", "max_depth": 2},
        "sensor": {
            "type": "perspective",
            "fov": 40,
            "to_world": t().look_at([0.4, -1.2, 2.2], [0, 0, 0], [0, 0, 1]),
            "film": film,
        },
        "subject": {"type": "rectangle", "bsdf": material},
        "other": {"type": "rectangle", "to_world": t().translate([2, 0, 0]), "bsdf": {"type": "diffuse"}},
        "first": {"type": "directional", "direction": [-0.5, 0.4, -1.0], "irradiance": 2.0},
        "second": {"type": "directional", "direction": [0.9, 0.1, -0.6], "irradiance": 1.0},
    }
