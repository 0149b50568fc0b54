"""Ways to light a representation by an environment: one place that knows which there are and what each needs.

``lights`` works for every method; ``prefiltered`` where the registry names a class for it; ``sh`` where texels share
tables over lights. A way that is made ready for a representation holds a GLSL file with ``btf_environment``, the tables
that it reads, and the same approximation in float64.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from btfref.errors import InputError
from btfref.numerics import harmonics
from btfref.registry import image_light, methods
from btfref.render import harmonic_light
from btfref.render.light_set import light_set
from btfref.render.paths import PATHS

#: Values of B evaluated at a time in float64.
BLOCK = 1 << 18


@dataclass(frozen=True)
class Prepared:
    """A way, ready for one representation.

    Parameters
    ----------
    path : str
        Its name.
    shader : str
        GLSL file with ``btf_environment``.
    tables : dict of str to ndarray
        That the file reads, beside the representation's own.
    radiance : callable
        ``(uv (N, 2), w_view (N, 3), to_world (N, 3, 3), evaluate=None) -> (N, 3)`` in float64. ``evaluate(uv, w_light,
        w_view, point)`` stands for the representation's own where points have levels of detail: ``point`` are their
        indices.
    facts : dict
        JSON-able: for the picture's ``meta``.
    constants : dict
        Of the GLSL file.
    """

    path: str
    shader: str
    tables: dict
    radiance: object
    facts: dict = field(default_factory=dict)
    constants: dict = field(default_factory=dict)


class Lighting:
    """An environment and the way that it lights.

    Parameters
    ----------
    environment : btfref.render.environment.Environment
    path : {"auto", "prefiltered", "lights", "sh"}
    lights : int, optional
        Of the path "lights"; see :func:`btfref.render.light_set.light_set`.
    order : int
        Bands of spherical harmonics of the path "sh".
    window : {"none", "hanning", "lanczos"}, optional
        That damps their ringing.

    Raises
    ------
    InputError
        For an unknown way.
    """

    def __init__(self, environment, path="auto", *, lights=None, order=harmonic_light.ORDER, window=None):
        if path not in PATHS:
            raise InputError(
                "unknown way to light", field="environment", got=repr(path), expected=", ".join(PATHS)
            )
        if lights is not None and path not in ("auto", "lights"):
            raise InputError("only the path 'lights' has a number of lights", field="lights", got=lights)
        self.environment, self.path, self._count = environment, path, lights
        self._order, self._window = harmonics.checked_order(order), window
        harmonics.window(window, order)

    @cached_property
    def light_set(self):
        """The lights that stand for the environment."""
        return light_set(self.environment, lights=self._count)

    @cached_property
    def coefficients(self):
        """The environment in spherical harmonics, world space, shape (order², 3)."""
        return harmonic_light.environment_coefficients(self.environment, self._order, window=self._window)

    def prepared(self, representation, *, file=None):
        """The way for a representation.

        Parameters
        ----------
        representation : Representation
        file : str, optional
            For messages.

        Returns
        -------
        Prepared

        Raises
        ------
        InputError
            When its method lacks the way.
        """
        path = self.path
        if path == "auto":
            key = representation.meta["method"]
            prefiltered = methods()[key].image_light if key in methods() else ""
            path = "prefiltered" if prefiltered and self._count is None else "lights"
        return getattr(self, f"_{path}")(representation, file)

    def _prefiltered(self, representation, file):
        light = image_light(representation.meta["method"], file=file)
        tables = light.tables(representation, self.environment)

        def radiance(uv, w_view, to_world, evaluate=None):
            return light.radiance(representation, tables, uv, w_view, to_world)

        return Prepared("prefiltered", light.SHADER, tables, radiance)

    def _lights(self, representation, file):
        found = self.light_set

        def radiance(uv, w_view, to_world, evaluate=None):
            evaluate = evaluate or (
                lambda uv, w_light, w_view, _: representation.evaluate(uv, w_light, w_view)
            )
            uv, w_view, to_world = (np.asarray(a, float) for a in (uv, w_view, to_world))
            result = np.zeros((len(uv), 3))
            step = max(1, BLOCK // len(found))
            for first in range(0, len(uv), step):
                part = slice(first, first + step)
                w_light = np.einsum("li,nij->nlj", found.w, to_world[part])
                point, light = np.nonzero(w_light[..., 2] > 0)
                at = first + point
                value = evaluate(uv[at], w_light[point, light], w_view[at], at) * found.power[light]
                for k in range(3):
                    result[part, k] = np.bincount(point, value[:, k], minlength=len(w_light))
            return result

        facts = {"environment_lights": len(found), "estimated_error": found.error}
        tables = {"environment_lights": found.table()}
        return Prepared("lights", "environment/lights.glsl", tables, radiance, facts)

    def _sh(self, representation, file):
        order, light = self._order, self.coefficients
        found = harmonic_light.table_coefficients(representation, order, file=file)
        stored = found.astype(np.float32)

        def radiance(uv, w_view, to_world, evaluate=None):
            return harmonic_light.radiance(representation, stored, light, uv, w_view, to_world)

        tables = {
            "environment_harmonics": light.astype(np.float32),
            "harmonic_turn": harmonic_light.turn_table(order),
            "eigen_harmonics": stored.reshape(*stored.shape[:3], -1),
        }
        facts = {
            "order": order,
            "window": self._window or "none",
            "ringing": harmonics.ringing(light, order),
            "estimated_error": harmonic_light.estimated_error(self.environment, light),
        }
        shader = representation.harmonic_shader
        return Prepared("sh", shader, tables, radiance, facts, {"HARMONIC_ORDER": order})


def lighting_of(scene, path="auto", **options):
    """The :class:`Lighting` of a scene's environment, or None without one.

    Parameters
    ----------
    scene : SceneDescription
    path : str
    **options
        Of :class:`Lighting`; None leaves the default.
    """
    if scene.environment is None:
        return None
    return Lighting(scene.environment, path, **{k: v for k, v in options.items() if v is not None})
