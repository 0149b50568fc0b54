"""What the tests of faults do to files, limits and the machine before a command runs."""

import contextlib
import errno
import json
import os

import numpy as np

from btfref.representations.file.container import load, save


def with_meta(change):
    """A representation whose facts are changed."""

    def prepare(folder, patch):
        good = load(folder / "good.exr")
        meta = json.loads(json.dumps(good.meta))
        change(meta)
        save(type(good)(good.arrays(), meta), folder / "good.exr")

    return prepare


def with_array(name, change):
    """A representation one table of which is changed."""

    def prepare(folder, patch):
        good = load(folder / "good.exr")
        arrays = {key: array.copy() for key, array in good.arrays().items()}
        arrays[name] = change(arrays[name])
        save(type(good)(arrays, good.meta), folder / "good.exr")

    return prepare


def setting(*path, value):
    def change(meta):
        for key in path[:-1]:
            meta = meta[key]
        meta[path[-1]] = value

    return with_meta(change)


def without(name):
    return with_meta(lambda meta: meta.pop(name))


def failing(place, error):
    """A function of ours or of a library that raises."""

    def prepare(folder, patch):
        def fail(*_, **__):
            raise error

        patch.setattr(place, fail)

    return prepare


def full(place="btfref.representations.file.container.write"):
    return failing(place, OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "out.exr"))


def fifo(name):
    return lambda folder, patch: os.mkfifo(folder / name)


def link(name, target):
    return lambda folder, patch: (folder / name).symlink_to(target)


def other(folder, patch):
    """The good scene under a name that outputs have beside it."""
    save(load(folder / "good.exr"), folder / "other.exr")


def nothing(folder, patch):
    """No fault but the command itself."""


def strange_package(folder, patch):
    """A file of somebody's where a package would be made."""
    place = folder / "btfref-data/btf-1/toy/flat"
    place.mkdir(parents=True)
    (place / "mine.txt").write_text("mine")


def one_row(folder, patch):
    """A row for the board, with answers."""
    np.save(folder / "flat.npy", np.zeros((9, 3), np.float32))
    texts = {
        "method": "m",
        "setting": "",
        "set": "btf-1",
        "set_version": "1.0.0",
        "tier": "toy",
        "fitted": "none",
    }
    row = {"kind": "btfref-board-row", "schema": 1, **texts, "materials": {"flat": {"answers": "flat.npy"}}}
    (folder / "mine.row.json").write_text(json.dumps(row))


def locked(folder, patch):
    from btfref.sampling.store.lock import writing

    held = contextlib.ExitStack()
    held.enter_context(writing(folder / "busy.btf.zarr"))
    # Given back when the patches are.
    patch.setattr("btfref.cli.LONGEST", 2000)
    patch.held = held


def some_rows(folder, patch):
    """Four rows of the good representation."""
    from btfref.querying import query_file

    query_file(folder / "rows.queries.zarr", load(folder / "good.exr"), n=4)


def no_llvm(folder, patch):
    from btfref.platform import LLVMChoice

    patch.setattr("btfref.platform.choose_llvm", lambda *_: LLVMChoice(None, None, "none found", ()))


def points(**found):
    """Entry points of a package that do what `found` says."""

    def prepare(folder, patch):
        from btfref import registry

        class Point:
            dist = None
            group = registry.points.ENTRY_POINT_GROUP

            def __init__(self, name, load):
                self.name, self.value, self.load = name, f"{name}:ROW", load

        def entry_points(*, group, name=None):
            return [Point(n, load) for n, load in found.items() if group == registry.points.ENTRY_POINT_GROUP]

        patch.setattr(registry.points, "entry_points", entry_points)
        for cached in (registry.points.usable_points, registry.methods, registry._all_methods):
            cached.cache_clear()

    return prepare


def broken():
    raise ImportError("no module named 'gone'")


def read_only(folder, patch):
    patch.setattr("btfref.commands.shared.reading.os.access", lambda *_: False)


def folder_there(folder, patch):
    (folder / "folder.html").mkdir()


def bare_mesh(folder, patch):
    (folder / "bare.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")


def few_samplers(folder, patch):
    patch.setattr("btfref.rendering.ports.package.MOST_SAMPLERS", 1)


def interpolating(way):
    """The scene's BTF interpolates in some way."""

    def prepare(folder, patch):
        scene, line = folder / "good.xml", '<string name="filename" value="$btf"/>'
        further = f'{line}<string name="interpolation" value="{way}"/>'
        scene.write_text(scene.read_text().replace(line, further))

    return prepare


def full_once(folder, patch):
    """The disk of the output is full, that of temporary files is not."""
    from btfref.images import openexr

    def write(parts, path, channels=None):
        if str(folder) in str(path) and "elsewhere" not in str(path):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        openexr.write(parts, path, channels)

    (folder / "elsewhere").mkdir()
    patch.setattr("tempfile.tempdir", str(folder / "elsewhere"))
    patch.setattr("btfref.representations.file.container.write", write)
