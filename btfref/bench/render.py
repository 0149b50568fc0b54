"""Reference rendering: the plugin against what a user would take instead, equal samples."""

from __future__ import annotations

import tempfile
from pathlib import Path

from btfref.bench.timing import interleaved, machine, summary

#: What stands in for a BTF where none is at hand: one BRDF with a coloured texture.
BASELINE = "principled + bitmap"

SAMPLES, SIZE = 16, 512


def run(*, quick=False, progress=None, btf=None, only=None):
    """Time of a path-traced image with each texture filter, relative to ``principled`` with a bitmap.

    Parameters
    ----------
    quick : bool
        Fewer rounds.
    progress : callable, optional
    btf : SampledBTF, optional
        Default: a checker of 64² texels and 81² directions at 2 samples (noise does not change the time).
    only : iterable of str, optional
        Keys of the methods to measure; default all.

    Returns
    -------
    dict
        ``raw``: seconds by scene and material, ``summary``, ``parameters``, ``machine``.
    """
    from btfref.platform import prepare_llvm

    prepare_llvm()
    import drjit as dr
    import mitsuba as mi

    from btfref.bench.data import checker
    from btfref.registry import method, methods
    from btfref.representations import save

    btf = btf or checker(progress=progress)
    mi.set_variant("llvm_ad_rgb")
    import mitsuba_plugins

    mitsuba_plugins.register()
    rounds = 5 if quick else 9
    report = progress or (lambda *_: None)
    raw, result = {}, {}
    with tempfile.TemporaryDirectory() as folder:
        materials = {BASELINE: _principled(mi, btf)}
        for key in only or methods():
            row = method(key)
            path = Path(folder) / f"checker.{key}.exr"
            save(row.fit(btf), path)
            for filter_type in ("nearest", "bilinear"):
                materials[f"{key} {filter_type}"] = {
                    "type": "btf",
                    "filename": str(path),
                    "filter_type": filter_type,
                    "to_uv": mi.ScalarTransform4f().scale([4, 4, 1]),
                }
        scenes = _scenes(mi)
        for i, (name, scene) in enumerate(scenes.items()):
            report(i, len(scenes), name)
            tasks = {}
            for material, bsdf in materials.items():
                loaded = mi.load_dict(_with_material(scene, bsdf))
                tasks[material] = _render_task(mi, dr, loaded)
            raw[name] = interleaved(tasks, rounds)
            result[name] = summary(raw[name], BASELINE)
    parameters = {"spp": SAMPLES, "size": SIZE, "rounds": rounds, "variant": mi.variant()}
    return {"suite": "render", "parameters": parameters, "raw": raw, "summary": result, "machine": machine()}


def table(result):
    """Rows for people: scene, material, median, ratio with its spread."""
    header = ("scene", "material", "median s", "ratio", "ratio range")
    rows = [
        (
            scene,
            name,
            f"{s['median_s']:.3f}",
            f"{s['ratio']:.2f}",
            f"{s['ratio_min']:.2f} to {s['ratio_max']:.2f}",
        )
        for scene, materials in result["summary"].items()
        for name, s in materials.items()
    ]
    return header, rows


def _principled(mi, btf):
    import numpy as np

    # The top view under the top light, as an albedo: a texture of the same size and contrast.
    albedo = np.clip(btf.values[0, 0].astype(np.float32) * np.pi, 0, 1)
    bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(albedo), "raw": True, "format": "variant"}
    bitmap["to_uv"] = mi.ScalarTransform4f().scale([4, 4, 1])
    return {"type": "principled", "base_color": bitmap, "roughness": 0.3, "specular": 0.5}


def _scenes(mi):
    """A bare sphere (nothing but shading costs), and the shipped cloth under a sky and under three lights."""
    from btfref.scenes import scene_file

    t = mi.ScalarTransform4f
    sphere = {"type": "sphere"}
    cloth = {"type": "ply", "filename": str(scene_file("cloth").with_name("cloth.ply"))}
    sky = {"sky": {"type": "constant"}}
    suns = {
        f"sun{i}": {"type": "directional", "direction": d}
        for i, d in enumerate(([0, 1, -1], [1, 0.5, -1], [-1, 0.3, -1]))
    }
    views = {
        "sphere": (sphere, t().look_at([0, -4, 1], [0, 0, 0], [0, 0, 1]), 30),
        "cloth": (cloth, t().look_at([0.6, -2.6, 2.0], [0, 0, 0], [0, 0, 1]), 45),
    }
    scenes = {}
    for (name, (shape, to_world, fov)), (lights, emitters) in (
        (view, light) for view in views.items() for light in (("sky", sky), ("suns", suns))
    ):
        film = {
            "type": "hdrfilm",
            "width": SIZE,
            "height": SIZE,
            "component_format": "float32",
            "rfilter": {"type": "box"},
        }
        sensor = {"type": "perspective", "fov": fov, "to_world": to_world, "film": film}
        integrator = {"type": "path", "max_depth": 6}
        scenes[f"{name}, {lights}"] = {
            "type": "scene",
            "integrator": integrator,
            "sensor": sensor,
            "shape": shape,
            **emitters,
        }
    return scenes


def _with_material(scene, bsdf):
    # Mitsuba evaluates both sides of a ``twosided`` material: only where the back can be seen.
    if scene["shape"]["type"] != "sphere":
        bsdf = {"type": "twosided", "bsdf": bsdf}
    return scene | {"shape": scene["shape"] | {"bsdf": bsdf}}


def _render_task(mi, dr, scene):
    seeds = iter(range(1 << 30))

    def render():
        # An opaque seed: a literal one would compile the kernel anew.
        dr.eval(mi.render(scene, spp=SAMPLES, seed=dr.opaque(mi.UInt32, next(seeds))))
        dr.sync_thread()

    return render
