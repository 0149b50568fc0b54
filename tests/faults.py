"""Commands and what may go wrong with them: the faults, the exit status and the words of the one line.

``test_faults.py`` runs all rows; ``page`` makes the table of the documentation of what they said.
"""

import errno
import re
import sys
from dataclasses import dataclass, field

import numpy as np
from fault_preparations import (
    bare_mesh,
    broken,
    failing,
    few_samplers,
    fifo,
    folder_there,
    full_once,
    interpolating,
    link,
    locked,
    no_llvm,
    nothing,
    one_row,
    other,
    points,
    read_only,
    setting,
    some_rows,
    strange_package,
    with_array,
    without,
)

from btfref.errors import MissingDependencyError

PAGE = "btfref/docs/pages/reference/faults.md"


@dataclass(frozen=True)
class Row:
    """A command under a fault.

    ``prepare(folder, monkeypatch)`` makes the fault; a string of `words` must be in the line.
    """

    item: str
    fault: str
    command: str
    words: tuple = ()
    status: int = 2
    prepare: object = field(default=lambda folder, patch: None)


PORT = "export good.exr --format gl -o"

RENDER, REALTIME = "render good.xml -o out.exr --grid 1", "realtime good.xml -o out.exr"

ROWS = [
    # 1
    Row("outputs", "a file of the scene", "render good.xml -o good.exr --grid 1", ("input", "good.exr")),
    Row("outputs", "the same", "realtime good.xml -o good.exr", ("input", "good.exr")),
    Row(
        "outputs",
        "a link to it",
        "realtime good.xml -o link.exr",
        ("input",),
        prepare=link("link.exr", "good.exr"),
    ),
    Row("outputs", "its input", "import image.exr --format photograph -o image.exr", ("input",)),
    Row("outputs", "in the input", "info good.btf.zarr --plot good.btf.zarr/plot.png", ("lies in",)),
    Row("outputs", "in the input", "export good.btf.zarr --format ubo -o good.btf.zarr/out", ("lies in",)),
    Row("outputs", "in the input", "fit raw good.btf.zarr -o good.btf.zarr/out.exr", ("lies in",)),
    Row("outputs", "a picture there", "fit raw good.btf.zarr -o image.exr", ("picture", "--overwrite")),
    Row(
        "outputs",
        "a representation there",
        RENDER.replace("out", "other"),
        ("representation",),
        prepare=other,
    ),
    Row(
        "outputs",
        "a representation there",
        REALTIME.replace("out", "other"),
        ("representation",),
        prepare=other,
    ),
    Row("outputs", "a store there", "demo -o good.btf.zarr", ("sampled BTF",)),
    Row("outputs", "a store there", "validate --quick -o good.btf.zarr", ("sampled BTF",)),
    Row(
        "outputs",
        "a scene there",
        "fit raw good.btf.zarr -o scene.exr",
        ("another kind",),
        prepare=lambda folder, patch: (folder / "scene.exr").write_text("<scene/>"),
    ),
    Row("outputs", "twice the same", RENDER + " --png --classes out.png", ("two outputs",)),
    Row("outputs", "a pipe", "fit raw good.btf.zarr -o pipe.exr", ("pipe",), prepare=fifo("pipe.exr")),
    # 2
    *(
        Row("contents", fault, command, ("good.exr", word), prepare=prepare)
        for fault, word, prepare in (
            ("texels=[1000, 1000]", "values", setting("texels", value=[1000, 1000])),
            ("texels=[4e9, 4e9]", "texels", setting("texels", value=[4_000_000_000, 4_000_000_000])),
            ("views.count=4e9", "views.count", setting("views", "count", value=4_000_000_000)),
            ("filter_type=cubic", "filter_type", setting("filter_type", value="cubic")),
            ("a foreign constant", "constants.values_dim0", setting("constants", "values_dim0", value=9)),
            ("view_cells=1e9", "view_cells", with_array("view_cells", lambda a: a * 0 + 1e9)),
            ("view_triangles=1e9", "view_triangles", with_array("view_triangles", lambda a: a * 0 + 1e9)),
            ("NaN", "values", with_array("values", lambda a: a * np.float32(np.nan))),
        )
        for command in (
            "info good.exr",
            RENDER,
            REALTIME,
            "demand good.xml",
            "export good.exr -o new --format maps",
        )
        if not (command.startswith("info") and fault in ("view_cells=1e9", "view_triangles=1e9", "NaN"))
        and (command.startswith(("info", "render")) or fault in ("texels=[1000, 1000]", "view_cells=1e9"))
    ),
    # 3
    *(
        Row("manifest", fault, "info good.exr", ("good.exr", word), prepare=prepare)
        for fault, word, prepare in (
            ("no filter_type", "filter_type", without("filter_type")),
            ("no views", "views", without("views")),
            ("texels of text", "texels", setting("texels", value="2x2")),
            ("texels=[-1, 2]", "texels", setting("texels", value=[-1, 2])),
            ("lights.count=true", "lights.count", setting("lights", "count", value=True)),
            ("a list of versions", "versions", setting("versions", value=[])),
            ("another method", "values", setting("method", value="svd")),
            ("no such method", "nonsense", setting("method", value="nonsense")),
        )
    ),
    # 4
    Row("place", "no LLVM", RENDER, ("LLVM",), prepare=no_llvm),
    Row("place", "no LLVM", "synth flat -o new.btf.zarr --texels 2 --spp 2", ("LLVM",), prepare=no_llvm),
    Row(
        "place",
        "no CUDA",
        f"{RENDER} --variant cuda_ad_rgb",
        ("CUDA",),
        prepare=failing("mitsuba.set_variant", ImportError("no CUDA")),
    ),
    Row(
        "place",
        "no OpenGL",
        REALTIME,
        ("OpenGL", "install"),
        prepare=failing(
            "btfref.rendering.gl.device.context", MissingDependencyError("no OpenGL", "install it")
        ),
    ),
    Row(
        "place",
        "disk full",
        "fit raw good.btf.zarr -o out.exr",
        ("No space left", "move it"),
        prepare=lambda folder, patch: full_once(folder, patch),
    ),
    Row(
        "place",
        "disk full",
        "export good.btf.zarr --format bonn -o new.btf",
        ("No space left",),
        prepare=failing(
            "btfref.formats.bonn.export.new_file", OSError(errno.ENOSPC, "No space left on device")
        ),
    ),
    Row("place", "read-only", "fit raw good.btf.zarr -o out.exr", ("read-only",), prepare=read_only),
    Row("place", "a pipe to read", "info pipe.exr", ("pipe",), prepare=fifo("pipe.exr")),
    Row(
        "place",
        "a pipe to read",
        "synth flat -o new.btf.zarr --views pipe.txt",
        ("pipe",),
        prepare=fifo("pipe.txt"),
    ),
    Row("place", "a name that is no text", "info bad\udcff.exr", ("UTF-8",)),
    Row(
        "place",
        "no memory",
        "fit raw good.btf.zarr -o out.exr",
        ("memory",),
        prepare=failing("btfref.representations.tabulated.raw.fit", MemoryError("Unable to allocate 9 TiB")),
    ),
    Row(
        "place",
        "an error of ours",
        "fit raw good.btf.zarr -o out.exr",
        ("internal error", "details"),
        70,
        prepare=failing("btfref.representations.tabulated.raw.fit", KeyError("nobody thought of it")),
    ),
    # 5
    *(
        Row("numbers", "more than there can be", command, (word,))
        for command, word in (
            ("synth flat -o new.btf.zarr --only-views 0-99999999999", "at most"),
            ("synth flat -o new.btf.zarr --views 9999x9999", "at most"),
            ("synth flat -o new.btf.zarr --texels 99999", "4096"),
            ("synth flat -o new.btf.zarr --spp 3000000000", "at most"),
            ("synth flat -o new.btf.zarr --workers 99999", "at most"),
            ("render good.xml -o out.exr --size 100000x100000", "at most"),
            ("render good.xml -o out.exr --spp 3000000000", "at most"),
            ("render good.xml -o out.exr --grid 100000", "at most"),
            ("render good.xml -o out.exr --seed 99999999999", "at most"),
            ("realtime good.xml -o out.exr --grid 1000", "at most"),
            ("realtime good.xml -o out.exr --lights 999999999", "at most"),
            ("realtime good.xml -o out.exr --transfer clusters=99999999", "4096"),
            ("demand good.xml --grid 1000", "at most"),
            ("demand good.xml --views 9999x9999", "at most"),
            ("info good.btf.zarr --plot new.png --texel 0,99999999999", "indices"),
            ("compare image.exr good.xml --size 100000x100000", "at most"),
        )
    ),
    Row("draws", "a noise-free picture", f"{RENDER} --interpolation drawn", ("--grid",)),
    Row("draws", "the same by the scene", RENDER, ("good.xml", "drawn"), prepare=interpolating("drawn")),
    Row("draws", "a word of the scene", REALTIME, ("blended or drawn",), prepare=interpolating("linear")),
    Row("draws", "frames that are all alike", f"{REALTIME} --frames 16", ("interpolation drawn",)),
    Row("draws", "a part of the grid", f"{REALTIME} --interpolation drawn --frames 10", ("multiple of 16",)),
    # 6
    Row(
        "memory",
        "too small a budget",
        "synth flat -o new.btf.zarr --texels 2 --spp 2 --memory 1M",
        ("memory",),
    ),
    Row("memory", "too small a budget", "fit svd good.btf.zarr -o out.exr --memory 100M", ("memory",)),
    Row("memory", "too small a budget", "import image.exr -o new.btf.zarr --memory 100M", ("memory",)),
    Row(
        "memory",
        "too small a budget",
        "export good.btf.zarr --format bonn -o new.btf --memory 100M",
        ("memory",),
    ),
    Row(
        "workers",
        "a method whose steps follow each other",
        "fit neural good.btf.zarr -o out.exr --scheduler dask",
        ("scheduler",),
    ),
    Row("workers", "no address", "fit svd good.btf.zarr -o out.exr --scheduler nowhere", ("scheduler",)),
    *(
        Row("workers", fault, command, words)
        for fault, command, words in (
            ("no address", "validate --only svd --no-report --scheduler nowhere", ("scheduler",)),
            ("in this process", "validate --self-test --scheduler dask", ("--self-test",)),
            ("no address", "bench fit --btf good.btf.zarr --scheduler nowhere", ("scheduler",)),
            ("of no plan", "bench offgrid --scheduler dask", ("plans",)),
        )
    ),
    # 7
    Row(
        "locks",
        "another writer",
        "synth flat -o busy.btf.zarr --texels 2 --spp 2",
        ("process",),
        prepare=locked,
    ),
    # 8
    Row(
        "packages",
        "a broken method",
        "fit gone good.btf.zarr -o out.exr",
        ("gone",),
        prepare=points(gone=broken),
    ),
    Row(
        "packages", "of another type", "fit odd good.btf.zarr -o out.exr", ("odd",), prepare=points(odd=dict)
    ),
    # 9
    *(
        Row("queries", fault, f"query {command}", words)
        for fault, command, words in (
            ("an unknown kind of file", "flat -o rows.csv", ("rows.csv", ".queries.zarr")),
            ("no such law", "flat -o rows.npz --light sideways", ("light", "halfdiff")),
            ("a law of both", "flat -o rows.npz --view halfdiff", ("both",)),
            ("no such radius", "flat -o rows.npz --radius wide", ("radius", "levels")),
            ("no whole number", "flat -o rows.npz --n 1.5", ("whole number",)),
            ("more than there can be", "flat -o rows.npz --n 1e12", ("at most",)),
            ("no whole pictures", "flat -o rows.h5 --n 10 --picture 3", ("multiple of 9",)),
            ("pictures wanted", "flat -o rows.h5 --n 9 --layout product", ("--picture",)),
            ("a layout of other files", "flat -o rows.npz --layout records", (".h5",)),
            ("an unknown surface", "velvet -o rows.npz --n 4", ("velvet",)),
            ("a parameter of a file", "good.exr -o rows.npz --n 4 --set k=1", ("no parameters",)),
            ("a scheduler for lookups", "good.exr -o rows.npz --n 4 --scheduler dask", ("scheduler",)),
            ("its input", "good.exr -o good.exr", ("input",)),
            ("a store there", "flat -o good.btf.zarr --n 4", ("good.btf.zarr",)),
        )
    ),
    Row(
        "queries",
        "no h5py",
        "query good.exr -o rows.h5 --n 4",
        ("h5py", "pip install"),
        prepare=lambda folder, patch: patch.setitem(sys.modules, "h5py", None),
    ),
    Row("queries", "no queries", "evaluate good.exr good.btf.zarr -o values.npy", ("no queries",)),
    Row(
        "queries",
        "no levels",
        "evaluate good.exr rows.queries.zarr -o values.npy --filter level",
        ("levels",),
        prepare=some_rows,
    ),
    Row(
        "queries",
        "its input",
        "evaluate good.exr rows.queries.zarr -o rows.queries.zarr/x.npy",
        ("lies in",),
        prepare=some_rows,
    ),
    # 10
    *(
        Row("data sets", fault, command, words, prepare=prepare)
        for fault, command, words, prepare in (
            ("no such material", "dataset make silk", ("silk", "knit"), nothing),
            ("no such set", "dataset make btf-9/knit", ("btf-9", "btf-1"), nothing),
            ("nothing named", "dataset make", ("NAME", "all"), nothing),
            ("another variant", "dataset make flat --variant cuda_ad_rgb", ("--variant",), nothing),
            ("no packages", "dataset verify --folder none", ("no packages", "none"), nothing),
            ("no package", "dataset card knit --folder none", ("no package", "knit"), nothing),
            ("a file there", "dataset make flat --folder image.exr", ("--folder", "image.exr"), nothing),
            ("other files there", "dataset make flat", ("other files", "mine.txt"), strange_package),
            ("a plan wanted", "bench offgrid --dataset btf-1 -o out", ("--dataset",), nothing),
            ("no folder for rows", "bench methods --dataset btf-1", ("-o",), nothing),
            ("both kinds of data", "bench methods --dataset btf-1 --btf good.btf.zarr -o out", ("--btf",), nothing),
            ("no such file", "board none -o site", ("none",), nothing),
            ("no rows", "board image.exr -o site", ("image.exr", "JSON"), nothing),
            ("no packages", "board mine.row.json -o site", ("no package", "flat"), one_row),
        )
    ),
    *(
        Row("refine", fault, f"refine good.exr {command}", words)
        for fault, command, words in (
            ("nothing to refine by", "--to image.png -o new.exr", ("queries", "sampled BTF")),
            ("no such data", "--to none.queries.zarr -o new.exr", ("none.queries.zarr",)),
            ("no such loss", "--to good.btf.zarr -o new.exr --loss l1", ("--loss", "delta_e")),
            ("too large a rate", "--to good.btf.zarr -o new.exr --rate 2", ("rate",)),
            ("parameters of no scene", "--to good.btf.zarr -o new.exr -D spp=4", ("--scene",)),
            ("its input", "--to good.btf.zarr -o good.exr", ("input",)),
            ("no such map", "--to good.btf.zarr -o new.exr --maps cluster", ("cluster", "values")),
        )
    ),
    Row("refine", "no representation", "refine good.btf.zarr --to good.btf.zarr -o new.exr", ("fit",)),
    Row("packages", "no such exporter", "export good.btf.zarr --format gone -o new", ("ubo", "utia", "bonn")),
    Row("ports", "a sampled BTF", f"{PORT.replace('.exr', '.btf.zarr')} new", ("good.btf.zarr",)),
    Row("ports", "a picture", f"{PORT.replace('good', 'image')} new", ("image.exr", "representation")),
    Row("ports", "no such file", f"{PORT.replace('good', 'none')} new", ("none.exr",)),
    Row("ports", "a folder there", f"{PORT} good.btf.zarr", ("exists already",)),
    Row("ports", "no folder for it", f"{PORT} none/new", ("no such folder", "none")),
    Row("ports", "settings", f"{PORT} new --quality 3", ("gl takes no settings", "quality")),
    Row(
        "ports", "NaN", f"{PORT} new", ("values", "good.exr"),
        prepare=with_array("values", lambda a: a * np.float32(np.nan)),
    ),
    Row("ports", "too many textures", f"{PORT} new", ("textures", "at most 1"), prepare=few_samplers),
    Row(
        "ports", "disk full", f"{PORT} new", ("No space left",),
        prepare=failing("btfref.rendering.ports.folder.ktx2", OSError(errno.ENOSPC, "No space left on device")),
    ),
    # 9
    Row("view", "a picture", "view image.exr -o page.html", ("image.exr", "representation")),
    Row("view", "no such file", "view gone.exr -o page.html", ("gone.exr",)),
    Row("view", "no page", "view good.exr -o page.txt", (".html",)),
    Row("view", "its input", "view good.exr -o good.exr", ("input",)),
    Row("view", "a folder there", "view good.exr -o folder.html", ("folder",), prepare=folder_there),
    Row("view", "no such mesh", "view good.exr --mesh gone.obj -o page.html", ("gone.obj",)),
    Row(
        "view", "a mesh without texture coordinates", "view good.exr --mesh bare.obj -o page.html",
        ("bare.obj", "texture coordinates"), prepare=bare_mesh,
    ),
    Row("view", "no such port", "view good.exr --port 99999", ("65535",)),
    Row("view", "more files than a page has", f"view {'good.exr ' * 9}-o page.html", ("at most 8",)),
]  # fmt: skip


def plain(line, folder):
    """A line without what differs from run to run."""
    line = line.removeprefix("btfref: error: ").replace(f"{folder}/", "").strip()
    line = re.sub(r"\S*btfref-[\w-]+\S*", "…", line)
    line = re.sub(r"process \d+ on \S+", "process … on …", line)
    return line.replace("|", "\\|").replace("\\x", "\\\\x")


def _ascii(text):
    return text.encode("ascii", "backslashreplace").decode()


def page(found):
    """The page of the documentation: a line for each row."""
    head = [
        "# What goes wrong, and what is said",
        "",
        "Every fault is one line on standard error. Exit status: 0 fine, 1 a gate failed, 2 bad input or usage or",
        "something that the machine lacks, 70 an error of btfref itself, whose details are in the file that the line",
        "names, 130 interrupted, 141 the reader of the output left, 143 terminated.",
        "",
        "`pytest tests/unit/commands/test_faults.py` runs all of these commands and makes this table.",
        "",
        "| | fault | command `btfref …` | status | line |",
        "|---|---|---|---|---|",
    ]
    rows = [
        f"| {row.item} | {row.fault} | `{_ascii(row.command)}` | {status} | {line} |"
        for row, status, line in found
    ]
    return "\n".join([*head, *rows, ""])
