"""Mutated files through every importer: one clear error or a correct result, nothing else.

"Correct" means: finite values of the promised shape, and a complete store. A case fails when it raises anything but
InputError, takes longer than 5 s, lets the process grow by more than the budget, or leaves a store behind.
"""

import resource
import shutil
import signal
import struct
import time
import zipfile

import formats_material as material
import numpy as np
import pytest

from btfref.errors import InputError
from btfref.formats import import_btf, open_source
from btfref.images import decoding, radiance
from btfref.numerics.colour import RGB_TO_XYZ
from btfref.sampling import open_store

#: Seconds of processor time for one case: a busy machine is no hang. Ten times that on the clock is one.
LONGEST = 5

#: Growth of the process over all cases, in bytes: the importers' own budget here plus what a test process collects.
MEMORY = 64 << 20
GROWTH = 4 * MEMORY

#: Numbers that headers stumble over.
ODD = [0, 1, 2, 3, 127, 128, 255, 256, 65535, 65536, 2**31 - 1, 2**31, 2**32 - 1, 2**63, 2**64 - 1]


def small():
    return material.pictures(2, 3)


def ubo_archive(make, end):
    import io

    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as target:
        for view, row in zip(material.ANGLES, small(), strict=True):
            for light, image in zip(material.ANGLES, row, strict=True):
                name = "tl{:03d} pl{:03d} tv{:03d} pv{:03d}".format(*light, *view)
                target.writestr(f"{name}.{end}", make(image))
    return stream.getvalue()


def exr_picture(names):
    import tempfile

    def make(image):
        with tempfile.NamedTemporaryFile(suffix=".exr") as stream:
            planes = {name: image[..., c % 3] for c, name in enumerate(names)}
            decoding.write_exr(planes, stream.name)
            return stream.read()

    return make


def long_line(image):
    """A Radiance picture with run lengths."""
    line = b"\x02\x02\x00\x08" + b"".join(
        b"\x84" + bytes([c]) + b"\x04\x01\x02\x03\x04" for c in (9, 8, 7, 130)
    )
    return b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2 +X 8\n" + 2 * line


def mif():
    values = small() @ RGB_TO_XYZ.T * 100
    pairs = [(light, view) for view in material.ANGLES for light in material.ANGLES]
    return material.mif([image.astype(np.float16) for image in values.reshape(25, 2, 3, 3)], pairs)


SEEDS = {
    "dfmf.btf": lambda: material.dfmf(small(), model=11),
    "dfmf_pca.btf": lambda: material.dfmf(small(), model=3, transposed=True, scalar=2),
    "fmf.btf": lambda: material.fmf(small()),
    "fmf_old.btf": lambda: material.fmf(small(), signature=b"!FMF06FCR", transposed=True),
    "pvf.btf": lambda: material.pvf(small()),
    "pvf_legacy.btf": lambda: material.pvf(small(), legacy=True, of_lights=False),
    "bdi.btf": lambda: material.bdi(small()),
    "bdi_sparse.btf": lambda: material.bdi(small(), compression=2, mask=np.eye(2, 3)),
    "bdi_bzip.btf": lambda: material.bdi(small(), compression=1),
    "spectral.btf": lambda: material.dfmf(small(), channels=("450", "550", "650")),
    "x.mif": mif,
    "x.binary": lambda: material.merl(lambda h, d, p: np.ones((*h.shape, 3)), (3, 4, 5)),
    "jpg.zip": lambda: ubo_archive(lambda image: material.picture(image, "jpg"), "jpg"),
    "png.zip": lambda: ubo_archive(material.picture, "png"),
    "hdr.zip": lambda: ubo_archive(long_line, "hdr"),
    "exr.zip": lambda: ubo_archive(exr_picture("RGB"), "exr"),
}

#: Single pictures, which an archive's checksum would shield: each is decoded as it is.
PICTURES = {
    "picture.jpg": lambda: material.picture(small()[0, 0], "jpg"),
    "picture.png": lambda: material.picture(small()[0, 0]),
    "picture.hdr": lambda: long_line(None),
    "flat.hdr": lambda: radiance.encode(small()[0, 0], reversed_line=True),
    "picture.exr": lambda: exr_picture("RGB")(small()[0, 0]),
    "spectral.exr": lambda: exr_picture(("450", "550", "650"))(small()[0, 0]),
}


def mutated(data, rng):
    """One to four changes: bits, bytes, numbers of 32 and 64 bits, cuts, insertions, repetitions, swaps."""
    data = bytearray(data)
    for _ in range(rng.integers(1, 5)):
        n = len(data)
        if n < 16:
            break
        # Headers matter more than their share of the bytes.
        reach = n if rng.random() < 0.4 else min(n, int(rng.choice([16, 64, 400, 900])))
        at, kind = int(rng.integers(0, reach)), int(rng.integers(0, 8))
        if kind == 0:
            data[at] ^= 1 << int(rng.integers(0, 8))
        elif kind == 1:
            data[at] = int(rng.integers(0, 256))
        elif kind == 2 and at + 4 <= n:
            data[at : at + 4] = struct.pack("<I", int(rng.choice(ODD[:13])) & 0xFFFFFFFF)
        elif kind == 3 and at + 8 <= n:
            data[at : at + 8] = struct.pack("<Q", ODD[int(rng.integers(0, len(ODD)))])
        elif kind == 4:
            del data[at:]
        elif kind == 5:
            data[at:at] = rng.bytes(int(rng.integers(1, 9)))
        elif kind == 6:
            del data[at : at + int(rng.integers(1, 33))]
        else:
            other = int(rng.integers(0, n))
            length = int(rng.integers(1, 17))
            data[at : at + length] = data[other : other + length]
    return bytes(data)


def late(*_):
    raise TimeoutError(f"longer than {LONGEST} s")


def resident():
    with open("/proc/self/statm") as stream:
        return int(stream.read().split()[1]) * resource.getpagesize()


def through(path, out, whole):
    """Import one file; True when it was taken. A store is written when ``whole``, else values are only read."""
    # The default grid of 81 x 81 pairs would make every table the slowest case.
    options = {"views": "2x4", "lights": "2x4"} if path.suffix == ".binary" else {}
    try:
        if not whole:
            source = open_source(path, **options)
            shape = (len(source.lights), *source.texels, 3)
            if np.prod([float(n) for n in shape]) * 96 > MEMORY:
                return False  # the conversion refuses this by the same rule
            source.memory = MEMORY
            for view in range(min(len(source.views), 8)):
                values = source.colours(view, 0, len(source.lights))
                assert values.shape == shape
                assert values.dtype == np.float32
            return True
        import_btf(path, out, memory=MEMORY, **options)
    except InputError as error:
        message = str(error)
    else:
        message = None
    if message is not None:
        assert message
        assert "\n" not in message
        assert not out.exists()
        return False
    store = open_store(out)
    assert store.complete
    store.read(views=0)
    shutil.rmtree(out)
    return True


def run(cases, tmp_path, seed, every):
    """``cases`` files through the importers in turn; returns (refused, taken, slowest in seconds)."""
    rng = np.random.default_rng(seed)
    seeds = [(name, make()) for name, make in {**SEEDS, **PICTURES}.items()]
    refused = taken = 0
    slowest, start = 0.0, None
    before = [signal.signal(number, late) for number in (signal.SIGALRM, signal.SIGPROF)]
    try:
        for case in range(cases):
            name, data = seeds[case % len(seeds)]
            changed = mutated(data, rng)
            path = tmp_path / name
            begun = time.process_time()
            signal.setitimer(signal.ITIMER_PROF, LONGEST)
            signal.setitimer(signal.ITIMER_REAL, 10 * LONGEST)
            try:
                if name in PICTURES:
                    try:
                        shape = decoding.header(changed, path)[1:3]
                        if shape[0] * shape[1] < 1 << 20:
                            pixels, channels = decoding.decode(changed, path, shape)
                            assert pixels.shape == (*shape, len(channels))
                        ok = True
                    except InputError:
                        ok = False
                else:
                    path.write_bytes(changed)
                    # Reading shows crashes; that nothing is left behind takes a store, which costs more.
                    ok = through(path, tmp_path / "out.btf.zarr", case // len(seeds) % every == 0)
            except BaseException:
                (tmp_path / f"failing_{name}").write_bytes(changed)
                raise
            finally:
                signal.setitimer(signal.ITIMER_PROF, 0)
                signal.setitimer(signal.ITIMER_REAL, 0)
            slowest = max(slowest, time.process_time() - begun)
            refused, taken = refused + (not ok), taken + ok
            if case == min(cases, 500) - 1:
                start = resident()
        assert resident() - start < GROWTH
    finally:
        for number, handler in zip((signal.SIGALRM, signal.SIGPROF), before, strict=True):
            signal.signal(number, handler)
    return refused, taken, slowest


def test_the_seeds_are_good(tmp_path):
    """What is mutated below works when whole: otherwise its refusals would prove nothing."""
    for name, make in SEEDS.items():
        (tmp_path / name).write_bytes(make())
        assert through(tmp_path / name, tmp_path / "out.btf.zarr", True), name
    for name, make in PICTURES.items():
        assert decoding.decode(make(), name, decoding.header(make(), name)[1:3])[0].size


@pytest.mark.filterwarnings("ignore")  # Pillow warns of what it then refuses or reads
def test_mutated_files(tmp_path):
    refused, taken, _ = run(1100, tmp_path, 0, 10)
    assert refused > 250
    assert taken > 100


@pytest.mark.long
@pytest.mark.filterwarnings("ignore")
def test_many_mutated_files(tmp_path):
    """10⁵ cases; prints what they came to."""
    refused, taken, slowest = run(110_000, tmp_path, 1, 10)
    print(f"{refused} refused, {taken} taken, slowest {slowest:.2f} s, {resident() >> 20} MiB")  # noqa: T201
    assert refused > 20_000
    assert taken > 5_000
