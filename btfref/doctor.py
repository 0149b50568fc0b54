"""Examination of the machine: what works here, what is missing, and what mends it.

Whatever can abort or hang a process (an LLVM library, a GPU driver) is tried in a process of its own.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass

from btfref import platform, system
from btfref.provenance import RELEVANT, versions
from btfref.registry import broken_points
from btfref.types import Facts

#: Mitsuba variants that btfref uses, and whether it can do without.
VARIANTS = {"llvm_ad_rgb": True, "scalar_rgb": True, "cuda_ad_rgb": False}

#: Pins of pyproject.toml: images are comparable with this pair only.
PINNED = {"mitsuba": "3.9.1", "drjit": "1.5.0"}

#: Seconds that one probe may take before it counts as hanging.
PROBE_TIMEOUT = 60

_MITSUBA_PROBE = """
import json, sys
import mitsuba as mi
mi.set_variant(sys.argv[1])
import drjit as dr
# A whole render: compiling a kernel is where a wrong LLVM aborts, not loading it.
view = mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
film = {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}}
scene = mi.load_dict({
    "type": "scene", "integrator": {"type": "direct"}, "light": {"type": "constant"},
    "shape": {"type": "sphere"}, "sensor": {"type": "perspective", "to_world": view, "film": film}})
mean = sum(mi.render(scene, spp=4).numpy().ravel().tolist())
print(json.dumps({"finite": mean == mean and mean > 0}))
"""

_GL_PROBE = """
import json, struct
import moderngl
ctx = moderngl.create_context(standalone=True, backend="egl", require=330)
buffer = ctx.framebuffer([ctx.texture((1, 1), 4, dtype="f4")])
buffer.use()
buffer.clear(0.5, 1.5, -2.0, 1.0)
pixel = struct.unpack("4f", buffer.read(components=4, dtype="f4"))
print(json.dumps({
    "vendor": ctx.info["GL_VENDOR"], "renderer": ctx.info["GL_RENDERER"], "version": ctx.info["GL_VERSION"],
    "max_texture_size": ctx.info["GL_MAX_TEXTURE_SIZE"],
    "max_array_texture_layers": ctx.info["GL_MAX_ARRAY_TEXTURE_LAYERS"],
    "float_target": pixel == (0.5, 1.5, -2.0, 1.0)}))
"""

_WEBGL_PROBE = """
import json
from btfref.rendering.web import chromium, probe
with chromium.Browser(timeout=40) as browser:
    print(json.dumps(probe.Device(browser).facts))
"""


@dataclass(frozen=True)
class Check:
    """One line of the examination.

    Parameters
    ----------
    group, name : str
        Where the line stands.
    status : {"ok", "missing", "warning", "absent"}
        "missing" is needed and makes the examination fail; "absent" is optional and not there.
    value : str
        What was found.
    mend : str
        What to do about it; empty when all is well.
    """

    group: str
    name: str
    status: str
    value: str
    mend: str = ""


@dataclass(frozen=True)
class Examination:
    """What `examine` found.

    Parameters
    ----------
    checks : tuple of Check
    facts : dict
        The same for programs: ``versions``, ``llvm``, ``variants``, ``gl``, ``webgl``, ``gpu``, ``machine``.
    """

    checks: tuple[Check, ...]
    facts: Facts

    @property
    def ok(self) -> bool:
        """Whether nothing needed is missing."""
        return all(check.status != "missing" for check in self.checks)

    def to_dict(self) -> Facts:
        """JSON-able form."""
        return {"ok": self.ok, "checks": [asdict(check) for check in self.checks], **self.facts}


def probe(code: str, *arguments: str, environment: Mapping[str, str] | None = None) -> Facts:
    """Run Python code in a process of its own and read the JSON on the last line of its output.

    Returns
    -------
    dict
        What the code printed, with ``works`` True; or ``works`` False and ``error``, one line.
    """
    try:
        done = subprocess.run(
            [sys.executable, "-c", code, *arguments],
            capture_output=True,
            text=True,
            timeout=PROBE_TIMEOUT,
            env={**os.environ, **(environment or {})},
        )
    except subprocess.TimeoutExpired:
        return {"works": False, "error": f"no answer within {PROBE_TIMEOUT} s"}
    if done.returncode == 0:
        try:
            return {"works": True, **json.loads(done.stdout.strip().splitlines()[-1])}
        except (IndexError, ValueError):
            return {"works": False, "error": "unreadable answer"}
    # Of chained exceptions the first is the cause.
    cause = done.stderr.split("\nDuring handling of the above exception")[0]
    said = [line.strip() for line in cause.splitlines() if line.strip()]
    if done.returncode < 0:
        return {"works": False, "error": f"the process died of signal {-done.returncode}"}
    return {"works": False, "error": said[-1] if said else f"exit status {done.returncode}"}


def _gpu() -> list[str]:
    """Name and memory of each NVIDIA GPU that the driver lists."""
    if shutil.which("nvidia-smi") is None:
        return []
    command = ["nvidia-smi", "--query-gpu=name,memory.total", "--format=csv,noheader"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=20)
    except (OSError, subprocess.TimeoutExpired):
        return []
    return [line.strip() for line in done.stdout.splitlines() if line.strip()] if done.returncode == 0 else []


def _memory() -> tuple[int, int] | None:
    """Total and available memory in bytes, or None where the kernel does not say."""
    try:
        with open("/proc/meminfo") as file:
            fields = dict(line.split(":", 1) for line in file)
        total, available = (int(fields[key].split()[0]) * 1024 for key in ("MemTotal", "MemAvailable"))
        return total, available
    except (OSError, KeyError, ValueError):
        return None


def machine() -> Facts:
    """Cores this process may use, memory and operating system.

    Returns
    -------
    dict
        ``cores`` int, ``memory_total`` and ``memory_available`` bytes or None, ``system`` str.
    """
    import platform as python_platform

    memory = _memory() or (None, None)
    try:
        release = python_platform.freedesktop_os_release()["PRETTY_NAME"]
    except (OSError, KeyError):
        release = python_platform.system()
    return {
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "memory_total": memory[0],
        "memory_available": memory[1],
        "system": f"{release}, {python_platform.machine()}",
    }


def examine() -> Examination:
    """Look at the machine: variants, LLVM, OpenGL, GPU, versions, programs.

    Returns
    -------
    Examination
        A few seconds; each probe runs beside the others in a process of its own.
    """
    llvm = platform.choose_llvm()
    installed = versions(RELEVANT)  # LLVM has checks of its own
    with ThreadPoolExecutor() as pool:
        waiting = {
            name: pool.submit(probe, _MITSUBA_PROBE, name, environment=_llvm_environment(llvm))
            for name in VARIANTS
            # Without a usable LLVM Dr.Jit would pick one of the refused ones by itself.
            if not (name.startswith("llvm") and llvm.path is None)
        }
        drawing = pool.submit(probe, _GL_PROBE, environment={"GALLIVM_PERF": "no_aos_sampling"})
        browser = system.chromium()
        page = pool.submit(probe, _WEBGL_PROBE) if browser else None
        cards = pool.submit(_gpu)
        variants = {name: result.result() for name, result in waiting.items()}
        gl, gpu = drawing.result(), cards.result()
        webgl = page.result() if page else {"works": False, "error": "no Chromium"}
    for name in VARIANTS:
        variants.setdefault(name, {"works": False, "error": "no usable LLVM library"})
    programs = {
        "glslangValidator": shutil.which("glslangValidator"),
        "chromium": browser,
    }
    facts = {
        "machine": machine(),
        "versions": installed,
        "llvm": {
            "chosen": llvm.path,
            "version": llvm.version,
            "reason": llvm.reason,
            "refused": [{"version": version, "path": path} for version, path in llvm.refused],
        },
        "variants": variants,
        "gl": gl,
        "webgl": webgl,
        "gpu": gpu,
        "programs": programs,
        "broken_packages": [asdict(point) for point in broken_points()],
        "missing": [requirement.name for requirement in system.missing()],
    }
    return Examination(tuple(_checks(facts)), facts)


def _llvm_environment(llvm: platform.LLVMChoice) -> dict[str, str]:
    return {"DRJIT_LIBLLVM_PATH": llvm.path} if llvm.path else {}


def _checks(facts: Facts) -> Iterator[Check]:
    """The lines for a reader, from the facts."""
    yield from _version_checks(facts["versions"])
    yield from _package_checks(facts["broken_packages"])
    yield from _library_checks(facts["missing"])
    yield from _llvm_checks(facts["llvm"])
    yield from _variant_checks(facts["variants"], facts["gpu"])
    yield from _gl_checks(facts["gl"])
    yield from _program_checks(facts["programs"])
    yield from _webgl_checks(facts["webgl"], facts["programs"]["chromium"])


def _version_checks(installed: Mapping[str, str | None]) -> Iterator[Check]:
    reinstall = "run make setup, or pip install btfref again"
    for name, version in installed.items():
        if version is None:
            yield Check("versions", name, "missing", "not installed", reinstall)
        elif name in PINNED and version != PINNED[name]:
            value = f"{version}, made for {PINNED[name]}"
            yield Check("versions", name, "warning", value, f"pip install {name}=={PINNED[name]}")
        else:
            yield Check("versions", name, "ok", version)


def _package_checks(broken: Sequence[Facts]) -> Iterator[Check]:
    """Packages that would add methods, formats or mesostructures, and cannot."""
    for point in broken:
        mend = f"mend or remove the package {point['package']}; everything else works without it"
        value = f"{point['group']} of {point['package']}: {point['reason']}"
        yield Check("other packages", point["name"], "warning", value, mend)


def _library_checks(missing: Collection[str]) -> Iterator[Check]:
    for requirement in system.REQUIREMENTS:
        # LLVM has its own lines.
        if not requirement.for_tests and requirement is not system.LLVM:
            if requirement.name in missing:
                mend = system.mend_command([requirement])
                yield Check("system libraries", requirement.name, "missing", "not found", mend)
            else:
                yield Check("system libraries", requirement.name, "ok", "found")


def _llvm_checks(llvm: Facts) -> Iterator[Check]:
    mend = system.mend_command([system.LLVM])
    if llvm["chosen"] is None:
        yield Check("Mitsuba", "LLVM", "missing", llvm["reason"], mend)
    else:
        version = f"{llvm['version']} " if llvm["version"] else ""
        yield Check("Mitsuba", "LLVM", "ok", f"{version}{llvm['chosen']} ({llvm['reason']})")
    if llvm["refused"]:
        old = ", ".join(f"{item['version']}" for item in llvm["refused"])
        # No mend: Mesa brings an old LLVM of its own, and leaving it unloaded is all that is needed.
        yield Check("Mitsuba", "LLVM refused", "ok", f"{old} (older ones abort the process; never loaded)")


def _variant_checks(variants: Mapping[str, Facts], gpu: Sequence[str]) -> Iterator[Check]:
    for name, needed in VARIANTS.items():
        result = variants[name]
        if result["works"] and result["finite"]:
            yield Check("Mitsuba", name, "ok", "renders")
        elif result["works"]:
            yield Check("Mitsuba", name, "missing", "renders black or NaN", "reinstall mitsuba and drjit")
        elif needed:
            mend = "mend the system libraries above first; if none is missing, reinstall mitsuba and drjit"
            yield Check("Mitsuba", name, "missing", result["error"], mend)
        elif gpu:
            mend = "update the NVIDIA driver; until then the llvm variant is used"
            yield Check("Mitsuba", name, "warning", result["error"], mend)
        else:
            yield Check("Mitsuba", name, "absent", "no NVIDIA GPU; the llvm variant is used")
    yield Check("Mitsuba", "GPU", "ok" if gpu else "absent", "; ".join(gpu) or "none")


def _gl_checks(gl: Facts) -> Iterator[Check]:
    if not gl["works"]:
        mend = "mend the system libraries above first; if none is missing, install the driver of your GPU"
        yield Check("OpenGL", "EGL context", "missing", gl["error"], mend)
        return
    yield Check("OpenGL", "renderer", "ok", gl["renderer"])
    yield Check("OpenGL", "vendor", "ok", gl["vendor"])
    yield Check("OpenGL", "version", "ok", gl["version"])
    value = f"{gl['max_texture_size']}² × {gl['max_array_texture_layers']} layers"
    if gl["max_texture_size"] < 4096:
        yield Check("OpenGL", "textures", "missing", value, "another driver: tables need rows of 4096 texels")
    else:
        yield Check("OpenGL", "textures", "ok", value)
    if not gl["float_target"]:
        yield Check("OpenGL", "float32 target", "missing", "clamps or rounds", "another OpenGL driver")


def _program_checks(programs: Mapping[str, str | None]) -> Iterator[Check]:
    for requirement in system.REQUIREMENTS:
        if requirement.for_tests:
            path = programs["chromium" if requirement.name == "Chromium" else requirement.name]
            use = "the tests and WebGL 2" if requirement is system.CHROMIUM else "the tests only"
            mend = "" if path else f"for {use}: {system.mend_command([requirement])}"
            yield Check("programs", requirement.name, "ok" if path else "absent", path or "not found", mend)


def _webgl_checks(webgl: Facts, program: str | None) -> Iterator[Check]:
    """Nothing needs a browser but the third renderer of validation, stress and tests."""
    if webgl["works"]:
        yield Check("programs", "WebGL 2", "ok", f"{webgl['webgl_renderer']} in {webgl['browser']}")
    elif program:
        mend = "another Chromium; without it shaders are not run in a browser"
        yield Check("programs", "WebGL 2", "warning", webgl["error"], mend)
    else:
        yield Check("programs", "WebGL 2", "absent", "no Chromium")
