"""The real-time renderer: the same scene through GLSL, without a window.

Direct light of directional, point, spot and area lights, with cast shadows (:mod:`btfref.rendering.gl.shadows`), and of
an environment (:mod:`btfref.rendering.environment_light.lighting`), without; the environment itself is not drawn.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable
from typing import TYPE_CHECKING, Any

import numpy as np

from btfref import representations
from btfref.errors import InputError
from btfref.rendering.environment_light.lighting import Lighting, lighting_of
from btfref.rendering.gl import device, quadrics
from btfref.rendering.gl.raster import (
    clip_planes,
    light_passes,
    light_table,
    material_uniforms,
    triangle_table,
    world_to_clip,
)
from btfref.rendering.gl.shadows import TRACED, ShadowMaps
from btfref.representations.protocol import DrawsViews
from btfref.scene.description import SceneDescription
from btfref.scene.surfaces.materials import PlainMaterial
from btfref.types import Facts, JitArray

if TYPE_CHECKING:
    from btfref.rendering.environment_light.prepared import Prepared
    from btfref.rendering.environment_light.transfer_light import TransferLight
    from btfref.representations.protocol import Representation
    from btfref.scene.environment import Environment
    from btfref.scene.shapes import MeshDescription


#: Gives the representation of a file.
LoadFile = Callable[[str], "Representation"]

#: Of what is shown: file or material, texel filter, interpolation between views, the mesh where each has light of its
#: own, whether on a quadric.
Key = tuple["str | PlainMaterial", str | None, str, int | None, bool]


class Renderer:
    """A scene on the GPU; draws one sample a pixel at a time.

    Parameters
    ----------
    scene : SceneDescription
    load_file : callable, optional
        ``path -> Representation``; the default reads the files.
    lighting : btfref.rendering.environment_light.lighting.Lighting, optional
        Of the scene's environment; default: "auto".
    shadows : bool
        Cast by shapes, under lights.
    count_fetches : bool
        Have :meth:`fetches` tell the texels fetched; a little slower.
    """

    def __init__(
        self,
        scene: SceneDescription,
        load_file: LoadFile | None = None,
        *,
        lighting: Lighting | None = None,
        shadows: bool = False,
        count_fetches: bool = False,
    ) -> None:
        if not scene.lights and scene.environment is None:
            raise InputError("the scene has no light", file=scene.source, field="emitter")
        self.ctx = device.context()
        self.camera = scene.camera
        self._owned: list[JitArray] = []
        self._shown: dict[Key, tuple[device.ShaderRepresentation, JitArray, JitArray, Prepared | None]] = {}
        self._meshes: list[tuple[MeshDescription, Key, JitArray]] = []
        size = (self.camera.width, self.camera.height)
        limit = self.ctx.info["GL_MAX_RENDERBUFFER_SIZE"]
        if max(size) > limit:
            raise InputError(
                "the image is too large for this driver",
                field="size",
                got=f"{size[0]}x{size[1]}",
                expected=f"≤ {limit}",
            )
        colour = self._own(self.ctx.texture(size, 4, dtype="f4"))
        self._target = self._own(self.ctx.framebuffer([colour], self._own(self.ctx.depth_renderbuffer(size))))
        self._near, self._far = clip_planes(self.camera, scene.meshes)
        self._lights = self._own(device.upload(self.ctx, light_table(scene.lights), "scene_lights"))
        self._shadows = self._own(ShadowMaps(self.ctx, scene)) if shadows and scene.lights else None
        self._n_lights, self._lighting = len(scene.lights), lighting
        if lighting is None:
            self._lighting = lighting_of(scene)
        self._light_facts: Facts = {}
        self._programs: dict[Hashable, tuple[JitArray, JitArray]] = {}
        self._hosts: dict[tuple[str, bool], tuple[JitArray, JitArray]] = {}
        self._seen: tuple[JitArray, JitArray] | None = None
        self._counting = {"COUNT_FETCHES": 1} if count_fetches else {}
        #: Whether frames of different numbers differ.
        self.draws = False
        try:
            for number, mesh in enumerate(scene.meshes):
                self._add(number, mesh, load_file or representations.load)
        except BaseException:
            self.release()
            raise

    def __enter__(self) -> Renderer:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

    def _own(self, thing: JitArray) -> JitArray:
        self._owned.append(thing)
        return thing

    def _add(self, number: int, mesh: MeshDescription, load_file: LoadFile) -> None:
        material, lighting = mesh.shown, self._lighting
        if lighting is not None and isinstance(material, PlainMaterial):
            lighting = lighting.of_plain
        own = number if lighting is not None and lighting.per_mesh else None
        # Matrices of transfer belong to triangles.
        exact = mesh.quadric is not None and own is None
        what = material if isinstance(material, PlainMaterial) else material.filename
        key = (what, material.filter_type, material.interpolation, own, exact)
        if key not in self._shown:
            rep = what.representation if isinstance(what, PlainMaterial) else load_file(what)
            light = None
            if lighting is not None:
                file = what if isinstance(what, str) else None
                light = lighting.prepared(rep, file=file, mesh=own)
                if file:
                    self._light_facts[file] = {"environment_path": light.path, **light.facts}
            shown = device.ShaderRepresentation.upload(
                self.ctx, rep, filter_type=material.filter_type, light=light
            )
            defines = {"N_LIGHTS": self._n_lights, **self._counting}
            if self._shadows is not None:
                defines |= self._shadows.defines
            if material.interpolation == "drawn" and isinstance(rep, DrawsViews):
                defines["DRAWN_VIEWS"] = 1
                self.draws = True
            by_pixel = len(self._passes(light, 1)) > 1 and (light is None or light.bins is None)
            if by_pixel:
                defines["SEEN"] = 1
                self._what_is_seen()
            if exact:
                defines["QUADRIC"] = 1
            vertex = "quadric" if exact else "screen" if by_pixel else "mesh"
            program, vertices = self._program(shown, f"hosts/{vertex}.vert", defines)
            self._shown[key] = self._own(shown), program, vertices, light
        table = None if exact else self._own(device.upload(self.ctx, triangle_table(mesh), "triangles"))
        self._meshes.append((mesh, key, table))

    def _passes(self, light: Prepared | None, n_faces: int) -> list[tuple[Facts, int]]:
        """Pictures of a mesh that add up."""
        traced = self._shadows is not None and self._shadows.traced > 0
        return light_passes(light, self._n_lights, n_faces, **({"most": TRACED} if traced else {}))

    def _program(
        self, shown: device.ShaderRepresentation, vertex: str, defines: dict[str, Any]
    ) -> tuple[JitArray, JitArray]:
        """A program, and what it is drawn with; many materials are of one kind, and differ in what they read."""
        constants = tuple(sorted({**shown.defines, **defines}.items()))
        key = vertex, shown.shader, shown.environment, constants
        if key not in self._programs:
            made = self._own(shown.program(self.ctx, vertex, "hosts/mesh.frag", defines=defines))
            self._programs[key] = made, self._own(self.ctx.vertex_array(made, []))
        return self._programs[key]

    def _what_is_seen(self) -> tuple[JitArray, JitArray]:
        """What each pixel sees: passes that add up shade pixels, not triangles of less than a pixel anew each time."""
        if self._seen is None:
            size = (self.camera.width, self.camera.height)
            texture = self._own(self.ctx.texture(size, 2, dtype="f4"))
            target = self._own(self.ctx.framebuffer([texture], self._own(self.ctx.depth_renderbuffer(size))))
            self._seen = texture, target
        return self._seen

    def _fill_seen(self, common: dict[str, Any]) -> None:
        """Find what each pixel sees, in all meshes."""
        _, target = self._what_is_seen()
        target.use()
        target.clear(0.0, 0.0, 0.0, 0.0)
        self._draw_all("hosts/seen.frag", common)
        self._target.use()

    def _draw_all(self, fragment: str, common: dict[str, Any]) -> None:
        """Draw all surfaces by a host that knows no material."""
        for number, (mesh, _, table) in enumerate(self._meshes):
            exact = table is None
            if (fragment, exact) not in self._hosts:
                vertex, defines = ("quadric", {"QUADRIC": 1}) if exact else ("mesh", {})
                made = device.compile_program(self.ctx, f"hosts/{vertex}.vert", fragment, defines=defines)
                self._hosts[fragment, exact] = self._own(made), self._own(self.ctx.vertex_array(made, []))
            program, vertices = self._hosts[fragment, exact]
            device.bind(program, {} if exact else {"triangles": table})
            device.set_uniforms(program, {**common, **self._surface(mesh, table, common), "mesh": number})
            count = quadrics.TRIANGLES if exact else len(mesh.faces)
            vertices.render(self.ctx.TRIANGLES, vertices=3 * count)

    def _surface(
        self, mesh: MeshDescription, table: JitArray | None, common: dict[str, Any], *, adds: bool = False
    ) -> dict[str, Any]:
        """Uniforms of a shape that has no table of triangles."""
        if table is not None or mesh.quadric is None:
            return {}
        clip, planes = common["world_to_clip"].T, (self._near, self._far)
        return quadrics.quadric_uniforms(mesh.quadric, self.camera, clip, planes, adds=adds)

    def draw(
        self, offset: tuple[float, float] = (0.5, 0.5), *, share: float = 1.0, frame: int = 0, seed: int = 0
    ) -> float:
        """Draw a frame.

        Parameters
        ----------
        offset : (float, float)
            The sample's place in each pixel, from the top left.
        share : float
            Side of a sample's footprint in pixels, for the level of detail.
        frame, seed : int
            What materials with drawn interpolation draw by, as :func:`btfref.numerics.draws.of_pixels` says.

        Returns
        -------
        float
            Milliseconds: GPU timer or wall clock around it, whichever is longer.
        """
        ctx, camera = self.ctx, self.camera
        self._target.use()
        ctx.disable(ctx.BLEND | ctx.CULL_FACE)
        ctx.enable(ctx.DEPTH_TEST)
        self._target.clear(0.0, 0.0, 0.0, -1.0)
        corner, right, down = camera.ray_basis()
        common = {
            "world_to_clip": world_to_clip(camera, offset, self._near, self._far).T,
            "camera_origin": camera.origin,
            "ray_corner": corner,
            "ray_right": right,
            "ray_down": down,
            # gl_FragCoord is at pixel centres.
            "film_offset": np.asarray(offset, float) - 0.5,
            "film_height": float(camera.height),
            "frame": frame,
            "seed": seed,
            **(self._shadows.uniforms if self._shadows is not None else {}),
        }
        ctx.finish()
        start = time.perf_counter()
        query = ctx.query(time=True)
        with query:
            adds = any(len(self._passes(light, 1)) > 1 for *_, light in self._shown.values())
            if adds:
                if self._seen is not None:
                    self._fill_seen(common)
                self._fill_depth(common)
            for index, (mesh, key, table) in enumerate(self._meshes):
                shown, program, vertices, light = self._shown[key]
                tables, by_pixel = dict(shown.textures), "seen" in program
                if table is not None:
                    tables["triangles"] = table
                tables["scene_lights"] = self._lights
                if self._shadows is not None:
                    tables |= self._shadows.textures
                if by_pixel:
                    tables["seen"] = self._what_is_seen()[0]
                    ctx.depth_func, self._target.depth_mask = ">", False
                device.bind(program, tables)
                own = material_uniforms(mesh.shown, shown.texels, share * camera.pixel_angle)
                own |= self._surface(mesh, table, common, adds=adds) | {"emission": mesh.emission}
                if self._shadows is not None:
                    own |= self._shadows.uniforms_of(index)
                device.set_uniforms(program, {**common, **own, "mesh": index})
                if light is not None and light.bins is not None and light.transfer is not None:
                    device.set_uniforms(program, {"transfer_components": light.transfer.table.shape[3]})
                whole = quadrics.TRIANGLES if table is None else 1 if by_pixel else len(mesh.faces)
                for number, (values, count) in enumerate(self._passes(light, whole)):
                    device.set_uniforms(program, {**values, "pass": number})
                    vertices.render(ctx.TRIANGLES, vertices=3 * count)
                if by_pixel:
                    ctx.depth_func, self._target.depth_mask = "<=", True
        ctx.depth_func = "<"
        ctx.disable(ctx.BLEND)
        ctx.finish()
        return max(1e-6 * query.elapsed, 1e3 * (time.perf_counter() - start))

    @property
    def transfers(self) -> list[TransferLight]:
        """What can be lit anew, one :class:`btfref.rendering.environment_light.transfer_light.TransferLight` a mesh."""
        lights = [light for *_, light in self._shown.values()]
        return [light.transfer for light in lights if light is not None and light.transfer is not None]

    @property
    def shadow_facts(self) -> Facts:
        """Number of the shadow maps, that of lights without one, and milliseconds to draw maps, with shadows."""
        maps = self._shadows
        if maps is None:
            return {}
        views = maps.defines.get("SHADOW_VIEWS", 0)
        return {"shadow_maps": views, "shadow_traced": maps.traced, "shadow_ms": maps.milliseconds}

    @property
    def environment_facts(self) -> Facts:
        """How the environment lights: the facts of one file, or facts by file where there are several."""
        if len(self._light_facts) == 1:
            return next(iter(self._light_facts.values()))
        return {"environment_path": dict(self._light_facts)} if self._light_facts else {}

    def _fill_depth(self, common: dict[str, Any]) -> None:
        """Draw all surfaces black; what follows adds to what is nearest."""
        ctx = self.ctx
        self._draw_all("hosts/depth.frag", common)
        ctx.depth_func = "<="
        ctx.enable(ctx.BLEND)
        ctx.blend_func = ctx.ONE, ctx.ONE

    def relight(self, environment: Environment, *, moving: bool = False) -> None:
        """Light all by another environment through the matrices that are there (way "transfer" only).

        Parameters
        ----------
        environment : btfref.scene.environment.Environment
        moving : bool
            Few components of matrices and materials, as while a light is dragged; the next call without it refines.

        Raises
        ------
        InputError
            When the scene is lit in another way.
        """
        if self._lighting is None or not self._lighting.per_mesh:
            raise InputError("only transferred light changes", field="environment", expected="transfer")
        coefficients = self._lighting.coefficients_of(environment)
        # The lights of other materials than BTFs follow when nothing moves any longer.
        lights = None if moving else Lighting(environment, "lights")
        for key, (shown, program, vertices, light) in self._shown.items():
            assert light is not None
            if light.transfer is not None:
                light.transfer.relight(coefficients, moving=moving)
                tables = light.transfer.tables()
            elif lights is not None and isinstance(key[0], PlainMaterial):
                light = lights.prepared(key[0].representation)
                self._shown[key] = shown, program, vertices, light
                tables = light.tables
            else:
                continue
            for name, table in tables.items():
                shown.textures.pop(name).release()
                shown.textures[name] = device.upload(self.ctx, table, name)

    def read(self) -> np.ndarray:
        """The frame, float32 (H, W, 3), row 0 at the top."""
        pixels = np.frombuffer(self._target.read(components=3, dtype="f4"), np.float32)
        return pixels.reshape(self.camera.height, self.camera.width, 3)[::-1]

    def fetches(self) -> np.ndarray:
        """Texels fetched for each pixel of the frame, shape (H, W); −1 where nothing is seen."""
        pixels = np.frombuffer(self._target.read(components=4, dtype="f4"), np.float32)
        return pixels.reshape(self.camera.height, self.camera.width, 4)[::-1, :, 3]

    def release(self) -> None:
        """Give everything on the GPU back."""
        while self._owned:
            self._owned.pop().release()
