"""Ways to light a representation by an environment: one place that knows which there are and what each needs.

``lights`` works for every method; ``prefiltered`` where the registry names a class for it; ``sh`` and ``transfer``
where texels share tables over lights. A way that is made ready for a representation holds a GLSL file with
``btf_environment``, the tables that it reads, and the same approximation in float64.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from btfref.errors import InputError
from btfref.numerics.sphere import harmonics
from btfref.registry import image_light, methods
from btfref.rendering.environment_light import PATHS, harmonic_light, transfer_light
from btfref.rendering.environment_light.light_set import light_set
from btfref.rendering.environment_light.transfer import (
    TransferSettings,
    clustered,
    corner_matrices,
    vertex_transfer,
)
from btfref.scene.environment import constant
from btfref.scene.shapes import neighbours

#: Lookups whose mean is the albedo of a material.
ALBEDO_SAMPLES = 512

#: Lights of a picture that is drawn at once: Mesa's llvmpipe ends a shader's loops, all together, after 65 535 steps
#: (LP_MAX_TGSI_LOOP_ITERATIONS) without a word, and drivers of GPUs end draws that take seconds.
PASS = 32

#: Environments whose lights are kept for the next picture: two renderers ask for the same ones.
KEPT = 4
_LIGHTINGS = {}

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
        ``(uv (N, 2), w_view (N, 3), to_world (N, 3, 3), evaluate=None, place=None) -> (N, 3)`` in float64.
        ``evaluate(uv, w_light, w_view, point)`` stands for the representation's own where points have levels of detail:
        ``point`` are their indices. ``place()`` gives triangles (N,) and barycentric coordinates (N, 3).
    facts : dict
        JSON-able: for the picture's ``meta``.
    constants : dict
        Of the GLSL file.
    passes : tuple of dict
        Uniforms of pictures that add up; one, without any, where a single picture does.
    bins : ndarray of int, shape (n + 1,), or None
        Where the triangles of each pass begin in the table ``bin_triangles``; None: all are drawn.
    transfer : btfref.rendering.environment_light.transfer_light.TransferLight or None
        What can be lit anew.
    """

    path: str
    shader: str
    tables: dict
    radiance: object
    facts: dict = field(default_factory=dict)
    constants: dict = field(default_factory=dict)
    passes: tuple = ({},)
    bins: np.ndarray | None = None
    transfer: object = None


class Lighting:
    """An environment and the way that it lights.

    Parameters
    ----------
    environment : btfref.scene.environment.Environment
    path : {"auto", "prefiltered", "lights", "sh", "transfer"}
    lights : int, optional
        Of the path "lights"; see :func:`btfref.rendering.environment_light.light_set.light_set`.
    order : int
        Bands of spherical harmonics of the paths "sh" and "transfer".
    window : {"none", "hanning", "lanczos"}, optional
        That damps their ringing.
    meshes : sequence of MeshDescription
        Of the scene, for the path "transfer".
    delta : bool
        Whether directional and point lights stand beside the environment: that path then draws them apart.
    transfer : btfref.rendering.environment_light.transfer.TransferSettings, optional
        Of that path.

    Raises
    ------
    InputError
        For an unknown way.
    """

    def __init__(
        self,
        environment,
        path="auto",
        *,
        lights=None,
        order=harmonic_light.ORDER,
        window=None,
        meshes=(),
        delta=False,
        transfer=None,
    ):
        if path not in PATHS:
            raise InputError(
                "unknown way to light", field="environment", got=repr(path), expected=", ".join(PATHS)
            )
        if lights is not None and path not in ("auto", "lights"):
            raise InputError("only the path 'lights' has a number of lights", field="lights", got=lights)
        self.environment, self.path, self._count = environment, path, lights
        self._order, self._window = harmonics.checked_order(order), window
        harmonics.window(window, order)
        self._meshes, self._transfer = tuple(meshes), transfer or TransferSettings()
        self._made = {}
        self._delta = delta

    @cached_property
    def light_set(self):
        """The lights that stand for the environment."""
        return light_set(self.environment, lights=self._count)

    @cached_property
    def coefficients(self):
        """The environment in spherical harmonics, world space, shape (order², 3)."""
        return self.coefficients_of(self.environment)

    def coefficients_of(self, environment):
        """Another environment, likewise."""
        return harmonic_light.environment_coefficients(environment, self._order, window=self._window)

    @property
    def per_mesh(self):
        """Whether every mesh is prepared on its own."""
        return self.path == "transfer"

    @cached_property
    def _vertex_transfer(self):
        """Of all meshes, or None where nothing hides the environment."""
        settings = self._transfer
        if not settings.shadows:
            return None
        albedo = [self._albedo(mesh) for mesh in self._meshes] if settings.bounces else ()
        return vertex_transfer(self._meshes, self._order, bounces=settings.bounces, albedo=albedo)

    def _albedo(self, mesh):
        """Mean colour of a material under radiance 1, over texels and views, shape (3,)."""
        from btfref import representations

        rep = representations.load(mesh.material.filename)
        rng = np.random.default_rng(0)
        uv, w_view = rng.random((ALBEDO_SAMPLES, 2)), rng.normal(size=(ALBEDO_SAMPLES, 3))
        w_view[:, 2] = np.abs(w_view[:, 2]) + 0.1
        w_view /= np.linalg.norm(w_view, axis=1, keepdims=True)
        frame = np.broadcast_to(np.eye(3), (ALBEDO_SAMPLES, 3, 3))
        white = Lighting(constant(), "sh", order=1).prepared(rep)
        return mesh.material.scale * white.radiance(uv, w_view, frame).mean(0)

    def prepared(self, representation, *, file=None, mesh=None):
        """The way for a representation.

        Parameters
        ----------
        representation : Representation
        file : str, optional
            For messages.
        mesh : int, optional
            Index of the mesh that it is on, where each is prepared on its own.

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
        if path == "transfer":
            return self._by_transfer(representation, file, mesh)
        content = (path, *_content(representation.arrays(), representation.meta))
        return _remembered(self._made, content, lambda: getattr(self, f"_by_{path}")(representation, file), 1)

    def _by_prefiltered(self, representation, file):
        light = image_light(representation.meta["method"], file=file)
        split = light.split(representation, self.environment)
        tables = light.tables(representation, split.rest)

        def radiance(uv, w_view, to_world, evaluate=None, place=None):
            filtered = light.radiance(representation, tables, uv, w_view, to_world)
            return filtered + lit(representation, split.lights, uv, w_view, to_world, evaluate)

        return self._with_lights("prefiltered", light.SHADER, tables, radiance, split.lights)

    def _by_lights(self, representation, file):
        found = self.light_set

        def radiance(uv, w_view, to_world, evaluate=None, place=None):
            return lit(representation, found, uv, w_view, to_world, evaluate)

        return self._with_lights("lights", "environment/lights.glsl", {}, radiance, found)

    def _with_lights(self, path, shader, tables, radiance, found):
        """A way that has directional lights, a few a pass."""
        facts = {"environment_lights": len(found)}
        if found.error is not None:
            facts["estimated_error"] = found.error
        tables = {**tables, "environment_lights": found.table()}
        passes = tuple(
            {"environment_first": first, "environment_end": min(first + PASS, len(found))}
            for first in range(0, max(len(found), 1), PASS)
        )
        return Prepared(path, shader, tables, radiance, facts, passes=passes)

    def _by_sh(self, representation, file):
        order, light = self._order, self.coefficients
        found = harmonic_light.table_coefficients(representation, order, file=file)
        stored = found.astype(np.float32)

        def radiance(uv, w_view, to_world, evaluate=None, place=None):
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

    def _by_transfer(self, representation, file, number):
        mesh, settings, order = self._meshes[number], self._transfer, self._order
        material = transfer_light.Material(representation, order, map_size=settings.map_size, file=file)
        vertices = self._vertex_transfer
        matrices = corner_matrices(mesh, order, None if vertices is None else vertices[number])
        transfer = clustered(matrices, settings)
        two_sided = mesh.material.twosided
        light = transfer_light.TransferLight(
            material, transfer, self.coefficients, two_sided=two_sided, bits=settings.bits
        )
        triangles, starts = transfer_light.bins(transfer, neighbours(mesh.positions, mesh.faces))
        bin_numbers = list(range(len(starts) - 1))
        if self._delta:
            # One more bin with every triangle once, number −1, under the other lights.
            every = np.zeros((len(mesh.faces), triangles.shape[1]), np.float32)
            every[:, 0] = np.arange(len(mesh.faces))
            triangles, starts = np.concatenate([triangles, every]), np.append(starts, starts[-1] + len(every))
            bin_numbers.append(-1)

        def radiance(uv, w_view, to_world, evaluate=None, place=None):
            return light.radiance(uv, w_view, np.linalg.det(to_world) < 0, *place())

        tables = {
            **light.tables(),
            "transfer_corners": transfer_light.corner_table(transfer),
            "transfer_clusters": light.places(),
            "bin_triangles": triangles,
        }
        facts = {
            "order": order,
            "window": self._window or "none",
            "environment_shadows": settings.shadows,
            "bounces": settings.bounces,
            "matrix_clusters": len(transfer.basis),
            "matrix_components": transfer.basis.shape[1] - 1,
            "matrix_error": transfer.error,
            "material_clusters": len(material.present),
            "map_size": material.map_size,
            "bits": settings.bits,
            "table_bytes": light.table_bytes,
            "lambda_ms": light.milliseconds,
            "ringing": harmonics.ringing(self.coefficients, order),
            "estimated_error": harmonic_light.estimated_error(self.environment, self.coefficients),
        }
        constants = {
            "HAS_BINS": True,
            "TRANSFER_BITS": settings.bits,
            "TRANSFER_SIZE": material.map_size,
            "TRANSFER_SIDES": 2 if two_sided else 1,
            "TRANSFER_CLUSTERS": len(transfer.basis),
            "TRANSFER_MATERIALS": len(material.present),
        }
        shader = representation.transfer_shader
        passes = tuple(
            {"bin": k, "bin_first": int(first)} for k, first in zip(bin_numbers, starts[:-1], strict=True)
        )
        return Prepared("transfer", shader, tables, radiance, facts, constants, passes, starts, light)


def lit(representation, found, uv, w_view, to_world, evaluate=None):
    """Radiance under directional lights in float64, as ``shaders/lib/light/environment_lights.glsl`` sums it.

    Parameters
    ----------
    representation : Representation
    found : btfref.rendering.environment_light.light_set.LightSet
    uv : array_like, shape (N, 2)
    w_view : array_like, shape (N, 3)
        Local frame.
    to_world : array_like, shape (N, 3, 3)
        Columns: the local axes in world space.
    evaluate : callable, optional
        In place of the representation's own: see :class:`Prepared`.

    Returns
    -------
    ndarray of float64, shape (N, 3)
    """
    evaluate = evaluate or (lambda uv, w_light, w_view, _: representation.evaluate(uv, w_light, w_view))
    uv, w_view, to_world = (np.asarray(a, float) for a in (uv, w_view, to_world))
    result = np.zeros((len(uv), 3))
    step = max(1, BLOCK // max(len(found), 1))
    for first in range(0, len(uv) if len(found) else 0, step):
        part = slice(first, first + step)
        w_light = np.einsum("li,nij->nlj", found.w, to_world[part])
        point, light = np.nonzero(w_light[..., 2] > 0)
        at = first + point
        value = evaluate(uv[at], w_light[point, light], w_view[at], at) * found.power[light]
        for k in range(3):
            result[part, k] = np.bincount(point, value[:, k], minlength=len(w_light))
    return result


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
    given = {k: v for k, v in options.items() if v is not None}
    if path == "transfer":
        delta = bool(scene.lights)
        return Lighting(scene.environment, path, meshes=scene.meshes, delta=delta, **given)
    content = (
        path,
        repr(sorted(given.items(), key=lambda item: item[0])),
        *_content(vars(scene.environment)),
    )
    return _remembered(_LIGHTINGS, content, lambda: Lighting(scene.environment, path, **given), KEPT)


def _remembered(store, key, make, most):
    """What was made under a key; of old ones ``most`` are kept."""
    if key not in store:
        made = make()
        while len(store) >= most:
            store.pop(next(iter(store)))
        store[key] = made
    return store[key]


def _content(*values):
    """Keys of what dictionaries of arrays and facts hold, by content."""
    digests = []
    for value in values:
        digest = hashlib.blake2b(digest_size=16)
        for name in sorted(value):
            entry = value[name]
            if isinstance(entry, np.ndarray):
                digest.update(f"{name} {entry.dtype} {entry.shape} ".encode())
                digest.update(np.ascontiguousarray(entry))
            else:
                digest.update(f"{name} {entry!r} ".encode())
        digests.append(digest.hexdigest())
    return digests
