"""Render a Mitsuba scene with OpenGL: the real-time image.

Meshes, spheres, disks and cylinders with BTFs or other materials (diffuse exactly, the rest as their mean albedo), a
perspective camera, directional, point, spot and area lights, and an envmap, sunsky or constant emitter. The image is
the mean of a regular sub-pixel grid (--grid); with --interpolation drawn of as many frames of it as --frames says.

All lights but environments cast shadows, as in `btfref render --grid`, where a shape can be in the way: always, unless
all shapes lie in one plane. A scene with an environment is drawn without, since an environment's light casts none here
(but by the way "transfer"). --shadows and --no-shadows decide otherwise; compare a picture without with `btfref render
--no-shadows`.

--environment says how an envmap lights: "prefiltered" maps, for the methods that have them, "lights", directional
lights that stand for it, for any method, or "auto", the first of these that there is; "sh", spherical harmonics, for
methods whose texels share tables (lpca); "transfer", these after transfer through the mesh, with its own shadows.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from typing import TYPE_CHECKING

from btfref.commands.shared.images import write_images
from btfref.commands.shared.options import (
    add_grid,
    add_image,
    add_interpolation,
    add_json,
    add_keep,
    add_scene,
    add_seed,
    add_shadows,
    help_with_scenes,
)
from btfref.commands.shared.printing import Progress, emit, emit_json, say_area_lights
from btfref.commands.shared.reading import assignments, count, output_file
from btfref.errors import DIRECTIONS, SAMPLES, InputError
from btfref.rendering.environment_light import PATHS

if TYPE_CHECKING:
    from btfref.rendering.environment_light.transfer import TransferSettings

#: Arguments that are written, and as what: :func:`btfref.commands.shared.paths.check_paths`.
OUTPUTS = {"output": "picture"}


def add_arguments(parser: ArgumentParser) -> None:
    """Describe the command's arguments."""
    add_scene(parser)
    add_image(parser)
    add_grid(parser)
    add_keep(parser)
    add_shadows(parser, "of all lights but environments (default: where shapes do not all lie in one plane)")
    parser.add_argument(
        "--environment", choices=PATHS, default="auto", help="how an envmap lights (default auto)"
    )
    parser.add_argument(
        "--lights",
        type=count(1, DIRECTIONS),
        metavar="N",
        help="that stand for it (default: for an estimated error of 1 %%)",
    )
    parser.add_argument(
        "--order", type=count(1), metavar="N", help="bands of spherical harmonics (default 5)"
    )
    parser.add_argument("--window", choices=("none", "hanning", "lanczos"), help="that damps their ringing")
    parser.add_argument(
        "--transfer",
        nargs="+",
        action="extend",
        metavar="KEY=VALUE",
        help="clusters, components, shadows (0 or 1), bounces, bits (8 or 32) and map_size of the transfer",
    )
    add_interpolation(
        parser,
        "all neighbours, or one that each pixel and frame draws: cheaper, with noise (default: the scene's)",
    )
    parser.add_argument(
        "--frames",
        type=count(1, SAMPLES),
        metavar="N",
        help="that are averaged where views are drawn: a multiple of those of --grid (default: once these)",
    )
    add_seed(parser)
    add_json(parser, "frame time and OpenGL renderer")


def help_text(parser: ArgumentParser, args: Namespace) -> str:
    """Help of the command, with what ships."""
    return help_with_scenes(parser)


def transfer_settings(items: Sequence[str]) -> TransferSettings:
    """``KEY=VALUE`` as :class:`btfref.rendering.environment_light.transfer.TransferSettings`."""
    from dataclasses import fields

    from btfref.rendering.environment_light.transfer import TransferSettings

    given = assignments(items, option="--transfer")
    known = [field.name for field in fields(TransferSettings)]
    for name in given:
        if name not in known:
            raise InputError(
                "no such setting of the transfer", field="--transfer", got=name, expected=", ".join(known)
            )
    if "shadows" in given:
        given["shadows"] = bool(given["shadows"])
    return TransferSettings(**given)


def run(args: Namespace) -> int:
    """Carry the command out."""
    import btfref
    from btfref.rendering.picture import picture_facts

    out = output_file(args.output, ".exr")
    parameters = assignments(args.define, convert=str, option="-D")
    with Progress() as progress:
        result = btfref.realtime(
            args.scene,
            parameters=parameters,
            grid=args.grid,
            size=args.size,
            keep=args.keep,
            environment=args.environment,
            lights=args.lights,
            order=args.order,
            window=args.window,
            transfer=transfer_settings(args.transfer) if args.transfer else None,
            shadows=args.shadows,
            interpolation=args.interpolation,
            frames=args.frames,
            seed=args.seed,
            progress=progress,
        )
    facts = picture_facts(result, args.scene, parameters=parameters, size=args.size)
    write_images(result.image, out, facts, png=args.png)
    if args.json:
        emit_json(result.meta)
    else:
        meta = result.meta
        emit(f"{out}: {meta['frame_ms']:.3g} ms a frame on {meta['gl_renderer']}")
        if meta["mirrored"]:
            from btfref.scene.mirrored import line

            emit(line(meta["mirrored"]))
        for note in meta["notes"]:
            emit(f"note: {note}")
        say_area_lights(meta)
        if "estimated_error" in meta:
            number = meta.get("environment_lights", meta.get("order"))
            kind = "lights" if "environment_lights" in meta else "bands"
            emit(f"environment: {number} {kind}, estimated error {100 * meta['estimated_error']:.2g} %")
    return 0
