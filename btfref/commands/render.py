"""Render a Mitsuba scene: the reference image.

SCENE is a Mitsuba XML file, or one of the scenes that btfref ships: plane, sphere, cloth, bowl, horizon, turning.
Any integrator; the film becomes float32 with a box filter. --grid N takes direct light alone, on a regular grid of
N × N positions in each pixel: without random numbers where all lights are directional or points.
--geometry shows the truth beyond every representation: the flat shape replaced by the mesostructure itself,
path traced.
"""

from __future__ import annotations

from btfref.commands._shared import assignments, count, emit, output_file, size, write_images
from btfref.errors import InputError
from btfref.scene.shipped import scene_file


def add_arguments(parser):
    """Describe the command's arguments."""
    parser.add_argument(
        "scene", metavar="SCENE", help="scene file, or plane, sphere, cloth, bowl, horizon, turning"
    )
    parser.add_argument("-o", "--output", required=True, metavar="X.exr", help="the image to write")
    parser.add_argument(
        "-D", dest="define", action="append", metavar="KEY=VALUE", help="parameter of the scene"
    )
    parser.add_argument("--spp", type=count(1), metavar="N", help="samples per pixel (default: the scene's)")
    parser.add_argument("--seed", type=count(0), default=0, metavar="N")
    parser.add_argument("--variant", default="llvm_ad_rgb", metavar="NAME", help="Mitsuba variant")
    parser.add_argument(
        "--grid", type=count(1), metavar="N", help="direct light on a regular grid of N × N sub-pixels"
    )
    parser.add_argument("--no-shadows", action="store_true", help="direct light without cast shadows")
    parser.add_argument(
        "--keep",
        choices=("all", "needed"),
        default="all",
        help="maps to load: all, or those that the camera's first hits need",
    )
    parser.add_argument("--debug", action="store_true", help="a channel that is no number is an error")
    parser.add_argument("--size", type=size, metavar="WxH", help="of the film, in pixels")
    parser.add_argument("--geometry", action="store_true", help="path trace the mesostructure itself")
    parser.add_argument("--classes", metavar="C.png", help="also write the pixel classes (for compare)")
    parser.add_argument("--png", action="store_true", help="also write X.png, for eyes")


def run(args):
    """Carry the command out."""
    scene, out = scene_file(args.scene), output_file(args.output, ".exr")
    parameters = assignments(args.define, convert=str, option="-D")
    if args.geometry and args.grid is not None:
        raise InputError("geometry is path traced", field="--geometry", got="--grid")
    classes_out = output_file(args.classes, ".png") if args.classes else None

    if args.geometry:
        from btfref.rendering.offline.geometry import render_geometry

        options = {"spp": args.spp} if args.spp else {}
        result = render_geometry(scene, parameters=parameters, seed=args.seed, size=args.size, **options)
    else:
        from btfref.rendering.offline.reference import render

        result = render(
            scene,
            parameters=parameters,
            variant=args.variant,
            spp=args.spp,
            seed=args.seed,
            grid=args.grid,
            shadows=not args.no_shadows,
            size=args.size,
            keep=args.keep,
            debug=args.debug,
        )
    if lost := result.meta.get("not_finite"):
        emit(f"{lost} channels are no numbers: lookups outside of what the file holds, or broken materials")
    classes = None
    if classes_out:
        from btfref.scene.pixel_classes import pixel_classes

        classes = pixel_classes(scene, parameters=parameters, size=args.size, grid=args.grid or 4)
    write_images(result.image, out, png=args.png, classes=classes, classes_out=classes_out)
    return 0
