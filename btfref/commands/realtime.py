"""Render a Mitsuba scene with OpenGL: the real-time image.

Meshes with BTF materials, a perspective camera, directional and point lights, and an envmap or constant emitter for
methods with a prefiltered path. No cast shadows: compare with `btfref render --noise-free N --no-shadows`. The image is
the mean of a regular sub-pixel grid (--grid).
"""

from __future__ import annotations

from btfref.commands._shared import (
    assignments,
    count,
    emit,
    emit_json,
    output_file,
    size,
    write_images,
)
from btfref.scenes import scene_file


def add_arguments(parser):
    """Describe the command's arguments."""
    parser.add_argument(
        "scene", metavar="SCENE", help="scene file, or plane, sphere, cloth, horizon, turning"
    )
    parser.add_argument("-o", "--output", required=True, metavar="X.exr", help="the image to write")
    parser.add_argument(
        "-D", dest="define", action="append", metavar="KEY=VALUE", help="parameter of the scene"
    )
    parser.add_argument("--grid", type=count(1), default=4, metavar="N", help="N × N sub-pixels (default 4)")
    parser.add_argument("--size", type=size, metavar="WxH", help="of the image, in pixels")
    parser.add_argument(
        "--views",
        choices=("all", "needed"),
        default="all",
        help="measured views to keep in memory: all, or those that the camera can see",
    )
    parser.add_argument("--png", action="store_true", help="also write X.png, for eyes")
    parser.add_argument("--json", action="store_true", help="print frame time and OpenGL renderer as JSON")


def run(args):
    """Carry the command out."""
    scene, out = scene_file(args.scene), output_file(args.output, ".exr")
    parameters = assignments(args.define, convert=str, option="-D")

    from btfref.render.realtime import realtime

    result = realtime(scene, parameters=parameters, grid=args.grid, size=args.size, views=args.views)
    write_images(result.image, out, png=args.png)
    if args.json:
        emit_json(result.meta)
    else:
        emit(f"{out}: {result.meta['frame_ms']:.3g} ms a frame on {result.meta['gl_renderer']}")
    return 0
