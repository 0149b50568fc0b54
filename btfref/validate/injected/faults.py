"""Known faults, and the limit that is meant for each."""

from __future__ import annotations

from dataclasses import dataclass

#: What is fitted: method, and parameters of the fit.
Subject = tuple[str, tuple[tuple[str, object], ...]]


@dataclass(frozen=True)
class Fault:
    """A fault and what is to catch it.

    Parameters
    ----------
    name : str
    meant : str
        The limit that must fail: gate and entry.
    look : str
        Method of `btfref.validate.injected.bench.Bench` that looks for faults of this kind and returns gates.
    method : str
        Registry key of what is looked at.
    edit : tuple of str, optional
        Shader file, right text, wrong text.
    change : str, optional
        What the look itself does wrong, where no shader is at fault.
    parameters : tuple of (str, value), optional
        Of the fit.
    """

    name: str
    meant: str
    look: str
    method: str = "lpca"
    edit: tuple[()] | tuple[str, str, str] = ()
    change: str = ""
    parameters: tuple[tuple[str, object], ...] = ()

    @property
    def subject(self) -> Subject:
        """What is fitted: method and parameters."""
        return self.method, self.parameters


HOST = "hosts/mesh.frag"
SUM = "vec4(scale * sum, 1.0)"
NOISE_FREE, PROBE = "image.noise_free.p999", "probe.agreement.p999"

FAULTS = (
    Fault(
        "cosine dropped",
        NOISE_FREE,
        "picture",
        edit=(HOST, "irradiance * btf", "irradiance / max(w_light.z, 1e-4) * btf"),
    ),
    Fault(
        "light and view swapped",
        NOISE_FREE,
        "picture",
        edit=(HOST, "btf_eval(uv, w_light, w_view", "btf_eval(uv, w_view, w_light"),
    ),
    Fault("v flipped", NOISE_FREE, "picture", edit=(HOST, "btf_eval(uv,", "btf_eval(vec2(uv.x, -uv.y),")),
    Fault(
        "half-texel shift",
        PROBE,
        "probes",
        edit=("lib/lookup/texels.glsl", "float(columns), 0.5)", "float(columns), 0.0)"),
    ),
    Fault("wrong gamma", NOISE_FREE, "picture", edit=(HOST, SUM, "vec4(pow(max(sum, 0.0), vec3(2.2)), 1.0)")),
    Fault(
        "tangent frame transposed",
        NOISE_FREE,
        "picture",
        edit=("lib/surface/frame.glsl", "return transpose(mat3(", "return (mat3("),
    ),
    Fault(
        "wrong sign in spherical harmonics",
        "environment.agreement.p999",
        "harmonics",
        edit=("lib/light/harmonics.glsl", "turn.x * q - turn.y * p;", "turn.x * q + turn.y * p;"),
    ),
    Fault(
        "cluster index off by one",
        PROBE,
        "probes",
        edit=(
            "representations/lpca.glsl",
            "int first = int(table_fetch(cluster, texel * CLUSTER_STRIDE).r) * BASIS_DIM1;",
            "int first = max(int(table_fetch(cluster, texel * CLUSTER_STRIDE).r) - 1, 0) * BASIS_DIM1;",
        ),
    ),
    Fault(
        "stale table of levels of detail",
        PROBE,
        "probes",
        "laplacian",
        (
            "representations/laplacian.glsl",
            "int at = (LEVEL_FIRST_TABLE[level] -",
            "int at = (LEVEL_FIRST_TABLE[max(level - 1, BASE_LEVEL)] -",
        ),
    ),
    Fault("sRGB read as linear", "image.eight_bit.code_p999", "eight_bits", change="linear"),
    Fault("the definition a hundredth too bright", PROBE, "evaluators", change="numpy"),
    Fault("a Dr.Jit port's evaluation a hundredth too bright", PROBE, "evaluators", change="drjit"),
    Fault("float16 overflow", "probe.finite.nonfinite", "overflow", "svd", change="overflow"),
    Fault(
        "negative values clamped",
        "image.negative.lost_negative",
        "picture",
        "svd",
        (HOST, SUM, "vec4(scale * max(sum, 0.0), 1.0)"),
        parameters=(("components", 4),),  # few enough to undershoot
    ),
    Fault(
        "division by zero",
        "image.finite.nonfinite",
        "picture",
        edit=(HOST, SUM, "vec4(scale * sum / step(0.5, fract(uv.x)), 1.0)"),
    ),
    Fault(
        "edges rasterized a third of a pixel off",
        "image.silhouette.relative_l2",
        "picture",
        edit=("hosts/mesh.vert", "vec4(position, 1.0);", "vec4(position, 1.0) + vec4(0.014, 0.0, 0.0, 0.0);"),
    ),
    Fault(
        "a quarter of the pixels left out", "image.judged.min_judged_share", "picture", change="silhouettes"
    ),
    Fault("light leaks into the background", "image.background.max_abs", "picture", change="background"),
    Fault(
        "the view meets the height field one cell off",
        "image.mesostructure.relative_l2",
        "picture",
        "gbrdf",
        (
            "lib/surface/heightfield.glsl",
            "vec2(hit.cell) + march.crossed);",
            "vec2(hit.cell) + march.crossed + 1.0);",
        ),
    ),
    Fault(
        "a shape lets the light through",
        NOISE_FREE,
        "shadows",
        edit=("lib/light/shadows.glsl", "if (inside && met.w > 0.0", "if (inside && met.w > 9.0"),
    ),
    Fault(
        "shadows fall a fiftieth of the scene off",
        "image.shadow_border.relative_l2",
        "shadows",
        edit=(
            "lib/light/shadows.glsl",
            "vec3 origin = point +",
            "vec3 origin = point + vec3(0.02, 0.0, 0.0) +",
        ),
    ),
    Fault(
        "v flipped in the browser",
        "image.browser.p999",
        "browser",
        edit=(HOST, "btf_eval(uv,", "btf_eval(vec2(uv.x, -uv.y),"),
    ),
    Fault(
        "edges rasterized a pixel off in the browser",
        "image.browser_edges.failing_fraction",
        "browser",
        edit=("hosts/mesh.vert", "vec4(position, 1.0);", "vec4(position, 1.0) + vec4(0.042, 0.0, 0.0, 0.0);"),
    ),
    Fault(
        "wrong sign in spherical harmonics in the browser",
        "image.browser_environment.p999",
        "browser_environment",
        edit=("lib/light/harmonics.glsl", "turn.x * q - turn.y * p;", "turn.x * q + turn.y * p;"),
    ),
    Fault(
        "a factor of pi in the irradiance in the browser",
        "image.browser_environment.max",
        "browser_environment",
        "rf_lobes",
        ("environment/rf_lobes.glsl", "own.a * irradiance;", "3.14159265 * own.a * irradiance;"),
    ),
    Fault(
        "edges a pixel off in eight bits", "image.eight_bit_silhouette.nrmse", "eight_bits", change="shifted"
    ),
    Fault(
        "five percent too bright against a noisy reference",
        "image.equivalence.relative_rmse",
        "noisy",
        change="bright",
    ),
    Fault(
        "views drawn with wrong weights",
        "image.equivalence.relative_rmse",
        "drawn",
        edit=("lib/lookup/draws.glsl", "number >= before &&", "number >= 0.25 * float(i) &&"),
    ),
    Fault(
        "environment mirrored",
        "image.environment_lights.relative_rmse",
        "environment",
        edit=(
            "lib/light/environment_lights.glsl",
            "table_fetch(environment_lights, 2 * i).xyz * to_world;",
            "(vec3(-1.0, 1.0, 1.0) * table_fetch(environment_lights, 2 * i).xyz) * to_world;",
        ),
    ),
    Fault(
        "a factor of pi in the irradiance",
        "image.environment.relative_rmse",
        "environment",
        "rf_lobes",
        ("environment/rf_lobes.glsl", "own.a * irradiance;", "3.14159265 * own.a * irradiance;"),
    ),
    Fault(
        "one region a tenth too bright",
        "image.environment_tiles.relative_tile_bias",
        "environment",
        "rf_lobes",
        change="tile",
    ),
    Fault(
        "mirrored textures lit for the other hand by both renderers",
        "image.witness.p999",
        "witness",
        change="hand",
    ),
    Fault("density of another view", "chi2.rejected.tests", "sampling", change="density"),
    Fault("weight that is not value over density", "sample.weight.max", "sampling", change="weight"),
    Fault("density that pdf() does not give", "sample.pdf.max", "sampling", change="pdf"),
    Fault("factors free between the samples", "fit.between_samples.peak", "between", "cmf", change="free"),
    Fault(
        "half of the light lost between the samples",
        "fit.between_samples.min_mean_ratio",
        "between",
        "cmf",
        change="dark",
    ),
    Fault(
        "below zero between the samples",
        "fit.between_samples.negative_fraction",
        "between",
        "cmf",
        change="negative",
    ),
    Fault("batches that share their random numbers", "waterfall.closure.z", "batches", change="shared"),
)
