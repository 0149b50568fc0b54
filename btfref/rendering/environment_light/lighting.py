"""Ways to light a representation by an environment: one place that knows which there are and what each needs.

``lights`` works for every method; ``prefiltered`` where the registry names a class for it; ``sh`` and ``transfer``
where texels share tables over lights. A way that is made ready for a representation holds a GLSL file with
``btf_environment``, the tables that it reads, and the same approximation in float64.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Hashable, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from btfref.errors import InputError
from btfref.numerics.sphere import harmonics
from btfref.registry import image_light, methods
from btfref.rendering.environment_light import PATHS, harmonic_light, transfer_light
from btfref.rendering.environment_light.light_set import light_set
from btfref.rendering.environment_light.prepared import Evaluate, Place, Prepared, Radiance, lit
from btfref.rendering.environment_light.transfer import (
    TransferSettings,
    clustered,
    corner_matrices,
    vertex_transfer,
)
from btfref.representations.protocol import LitByHarmonics, LitByTransfer
from btfref.scene.environment import constant
from btfref.scene.shapes import neighbours
from btfref.types import Facts, PathLike

if TYPE_CHECKING:
    from btfref.rendering.environment_light.light_set import LightSet
    from btfref.representations.protocol import Representation
    from btfref.scene.description import SceneDescription
    from btfref.scene.environment import Environment
    from btfref.scene.shapes import MeshDescription


#: Lookups whose mean is the albedo of a material.
ALBEDO_SAMPLES = 512

#: Lights of a picture that is drawn at once: Mesa's llvmpipe ends a shader's loops, all together, after 65 535 steps
#: (LP_MAX_TGSI_LOOP_ITERATIONS) without a word, and drivers of GPUs end draws that take seconds.
PASS = 32

#: Environments whose lights are kept for the next picture: two renderers ask for the same ones.
KEPT = 4
_LIGHTINGS: dict[Hashable, Lighting] = {}


T = TypeVar("T")


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
        environment: Environment,
        path: str = "auto",
        *,
        lights: int | None = None,
        order: int = harmonic_light.ORDER,
        window: str | None = None,
        meshes: Sequence[MeshDescription] = (),
        delta: bool = False,
        transfer: TransferSettings | None = None,
    ) -> None:
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
        self._made: dict[Hashable, Prepared] = {}
        self._delta = delta

    @cached_property
    def light_set(self) -> LightSet:
        """The lights that stand for the environment."""
        return light_set(self.environment, lights=self._count)

    @cached_property
    def coefficients(self) -> np.ndarray:
        """The environment in spherical harmonics, world space, shape (order², 3)."""
        return self.coefficients_of(self.environment)

    def coefficients_of(self, environment: Environment) -> np.ndarray:
        """Another environment, likewise."""
        return harmonic_light.environment_coefficients(environment, self._order, window=self._window)

    @property
    def per_mesh(self) -> bool:
        """Whether every mesh is prepared on its own."""
        return self.path == "transfer"

    @cached_property
    def of_plain(self) -> Lighting:
        """The way that the environment lights materials that are no BTFs: by its lights, whatever the others' is."""
        if self.path in ("auto", "lights"):
            return self
        return Lighting(self.environment, "lights")

    @cached_property
    def _vertex_transfer(self) -> list[np.ndarray] | None:
        """Of all meshes, or None where nothing hides the environment."""
        settings = self._transfer
        if not settings.shadows:
            return None
        albedo = [self._albedo(mesh) for mesh in self._meshes] if settings.bounces else ()
        return vertex_transfer(self._meshes, self._order, bounces=settings.bounces, albedo=albedo)

    def _albedo(self, mesh: MeshDescription) -> np.ndarray:
        """Mean colour of a material under radiance 1, over texels and views, shape (3,)."""
        from btfref import representations

        if mesh.plain is not None:
            return mesh.plain.albedo
        rep = representations.load(mesh.btf.filename)
        rng = np.random.default_rng(0)
        uv, w_view = rng.random((ALBEDO_SAMPLES, 2)), rng.normal(size=(ALBEDO_SAMPLES, 3))
        w_view[:, 2] = np.abs(w_view[:, 2]) + 0.1
        w_view /= np.linalg.norm(w_view, axis=1, keepdims=True)
        frame = np.broadcast_to(np.eye(3), (ALBEDO_SAMPLES, 3, 3))
        white = Lighting(constant(), "sh", order=1).prepared(rep)
        return mesh.btf.scale * white.radiance(uv, w_view, frame).mean(0)

    def prepared(
        self, representation: Representation, *, file: PathLike | None = None, mesh: int | None = None
    ) -> Prepared:
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
            assert mesh is not None, "each mesh is prepared on its own"
            return self._by_transfer(representation, file, mesh)
        content = (path, *_content(representation.arrays(), representation.meta))
        return _remembered(self._made, content, lambda: getattr(self, f"_by_{path}")(representation, file), 1)

    def _by_prefiltered(self, representation: Representation, file: PathLike | None) -> Prepared:
        light = image_light(representation.meta["method"], file=file)
        split = light.split(representation, self.environment)
        tables = light.tables(representation, split.rest)

        def radiance(
            *at: np.ndarray, evaluate: Evaluate | None = None, place: Place | None = None
        ) -> np.ndarray:
            filtered = light.radiance(representation, tables, *at)
            return filtered + lit(representation, split.lights, *at, evaluate=evaluate)

        return self._with_lights("prefiltered", light.SHADER, tables, radiance, split.lights)

    def _by_lights(self, representation: Representation, file: PathLike | None) -> Prepared:
        found = self.light_set

        def radiance(
            *at: np.ndarray, evaluate: Evaluate | None = None, place: Place | None = None
        ) -> np.ndarray:
            return lit(representation, found, *at, evaluate=evaluate)

        return self._with_lights("lights", "environment/lights.glsl", {}, radiance, found)

    def _with_lights(
        self, path: str, shader: str, tables: dict[str, np.ndarray], radiance: Radiance, found: LightSet
    ) -> Prepared:
        """A way that has directional lights, a few a pass."""
        facts: Facts = {"environment_lights": len(found)}
        if found.error is not None:
            facts["estimated_error"] = found.error
        tables = {**tables, "environment_lights": found.table()}
        passes = tuple(
            {"environment_first": first, "environment_end": min(first + PASS, len(found))}
            for first in range(0, max(len(found), 1), PASS)
        )
        return Prepared(path, shader, tables, radiance, facts, passes=passes)

    def _by_sh(self, representation: Representation, file: PathLike | None) -> Prepared:
        order, light = self._order, self.coefficients
        found = harmonic_light.table_coefficients(representation, order, file=file)
        stored = found.astype(np.float32)

        def radiance(
            *at: np.ndarray, evaluate: Evaluate | None = None, place: Place | None = None
        ) -> np.ndarray:
            return harmonic_light.radiance(representation, stored, light, *at)

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
        assert isinstance(representation, LitByHarmonics)
        shader = representation.harmonic_shader
        return Prepared("sh", shader, tables, radiance, facts, {"HARMONIC_ORDER": order})

    def _by_transfer(self, representation: Representation, file: PathLike | None, number: int) -> Prepared:
        mesh, settings, order = self._meshes[number], self._transfer, self._order
        material = transfer_light.Material(representation, order, map_size=settings.map_size, file=file)
        vertices = self._vertex_transfer
        matrices = corner_matrices(mesh, order, None if vertices is None else vertices[number])
        transfer = clustered(matrices, settings)
        two_sided = mesh.btf.twosided
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

        def radiance(
            *at: np.ndarray, evaluate: Evaluate | None = None, place: Place | None = None
        ) -> np.ndarray:
            assert place is not None
            uv, w_view, _ = at
            return light.radiance(uv, w_view, *place())

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
        assert isinstance(representation, LitByTransfer)
        shader = representation.transfer_shader
        passes = tuple(
            {"bin": k, "bin_first": int(first)} for k, first in zip(bin_numbers, starts[:-1], strict=True)
        )
        return Prepared("transfer", shader, tables, radiance, facts, constants, passes, starts, light)


def lighting_of(scene: SceneDescription, path: str = "auto", **options: Any) -> Lighting | None:
    """The :class:`Lighting` of a scene's environment, or None without one.

    Parameters
    ----------
    scene : SceneDescription
    path : str
    **options
        Of :class:`Lighting`; None leaves the default.
    """
    environment = scene.environment
    if environment is None:
        return None
    given = {k: v for k, v in options.items() if v is not None}
    if path == "transfer":
        delta = bool(scene.lights)
        return Lighting(environment, path, meshes=scene.meshes, delta=delta, **given)
    content = (
        path,
        repr(sorted(given.items(), key=lambda item: item[0])),
        *_content(vars(environment)),
    )
    return _remembered(_LIGHTINGS, content, lambda: Lighting(environment, path, **given), KEPT)


def _remembered(store: dict[Any, T], key: Hashable, make: Callable[[], T], most: int) -> T:
    """What was made under a key; of old ones ``most`` are kept."""
    if key not in store:
        made = make()
        while len(store) >= most:
            store.pop(next(iter(store)))
        store[key] = made
    return store[key]


def _content(*values: Mapping[str, Any]) -> tuple[str, ...]:
    """Keys of what dictionaries of arrays and facts hold, by content."""
    digests = []
    for value in values:
        digest = hashlib.blake2b(digest_size=16)
        for name in sorted(value):
            entry = value[name]
            if isinstance(entry, np.ndarray):
                digest.update(f"{name} {entry.dtype} {entry.shape} ".encode())
                digest.update(np.ascontiguousarray(entry).data)
            else:
                digest.update(f"{name} {entry!r} ".encode())
        digests.append(digest.hexdigest())
    return tuple(digests)
