"""Render a Mitsuba scene: the reference image.

SCENE is a Mitsuba XML file, or one of the scenes that btfref ships.
Any integrator; the film becomes float32 with a box filter. --grid N takes direct light alone, on a regular grid of
N × N positions in each pixel: without random numbers but under an environment; points stand for area lights.
--geometry shows the truth beyond every representation: the flat shape replaced by the mesostructure itself,
path traced.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

from btfref.commands.shared.images import write_images
from btfref.commands.shared.options import (
    add_grid,
    add_image,
    add_interpolation,
    add_keep,
    add_scene,
    add_seed,
    add_shadows,
    help_with_scenes,
)
from btfref.commands.shared.printing import emit, say_area_lights
from btfref.commands.shared.reading import assignments, count, output_file
from btfref.errors import SAMPLES, InputError

#: Arguments that are written, and as what: :func:`btfref.commands.shared.paths.check_paths`.
OUTPUTS = {"output": "picture", "classes": "picture"}


def add_arguments(parser: ArgumentParser) -> None:
    """Describe the command's arguments."""
    add_scene(parser)
    add_image(parser)
    parser.add_argument(
        "--spp", type=count(1, SAMPLES), metavar="N", help="samples per pixel (default: the scene's)"
    )
    add_seed(parser)
    parser.add_argument("--variant", default="llvm_ad_rgb", metavar="NAME", help="Mitsuba variant")
    add_grid(parser, default=None, text="direct light on a regular grid of N × N sub-pixels")
    add_shadows(parser, "cast shadows, or direct light without (default: with)")
    add_keep(parser)
    add_interpolation(
        parser,
        "all neighbours, or one that each lookup draws: cheaper, with more noise (default: the scene's)",
    )
    parser.add_argument("--debug", action="store_true", help="a channel that is no number is an error")
    parser.add_argument("--geometry", action="store_true", help="path trace the mesostructure itself")
    parser.add_argument("--classes", metavar="C.png", help="also write the pixel classes (for compare)")


def help_text(parser: ArgumentParser, args: Namespace) -> str:
    """Help of the command, with what ships."""
    return help_with_scenes(parser)


def run(args: Namespace) -> int:
    """Carry the command out."""
    import btfref
    from btfref.rendering.picture import picture_facts

    out = output_file(args.output, ".exr")
    parameters = assignments(args.define, convert=str, option="-D")
    if args.geometry and args.grid is not None:
        raise InputError("geometry is path traced", field="--geometry", got="--grid")
    if args.interpolation == "drawn" and (args.geometry or args.grid is not None):
        other = "--geometry" if args.geometry else "--grid"
        raise InputError("only pictures of random samples draw views", field="--interpolation", got=other)
    classes_out = output_file(args.classes, ".png") if args.classes else None

    if args.geometry:
        from btfref.rendering.offline.geometry import render_geometry

        options = {"spp": args.spp} if args.spp else {}
        result = render_geometry(args.scene, parameters=parameters, seed=args.seed, size=args.size, **options)
    else:
        result = btfref.render(
            args.scene,
            parameters=parameters,
            variant=args.variant,
            spp=args.spp,
            seed=args.seed,
            size=args.size,
            grid=args.grid,
            shadows=args.shadows,
            keep=args.keep,
            debug=args.debug,
            interpolation=args.interpolation,
        )
    if lost := result.meta.get("not_finite"):
        emit(f"{lost} channels are no numbers: lookups outside of what the file holds, or broken materials")
    if result.meta.get("mirrored"):
        from btfref.scene.mirrored import line

        emit(line(result.meta["mirrored"]))
    say_area_lights(result.meta)
    classes = None
    if classes_out:
        from btfref.scene.pixel_classes import pixel_classes

        shadows = bool(result.meta.get("shadows"))
        shared = {"parameters": parameters, "size": args.size, "grid": args.grid or 4}
        classes = pixel_classes(args.scene, shadows=shadows, **shared)
    facts = picture_facts(result, args.scene, parameters=parameters, size=args.size)
    write_images(result.image, out, facts, png=args.png, classes=classes, classes_out=classes_out)
    return 0
