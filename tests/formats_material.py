"""Files of measured BTFs made for tests, written here from the formats' definitions and not by the library.

Pictures have row 0 at the top; the store has it at v = 0, so that rows are reversed between the two.
"""

import bz2
import io
import struct
from xml.sax.saxutils import quoteattr

import numpy as np

#: A pole and one ring: the smallest set that can be interpolated. Degrees (θ, φ).
ANGLES = ((0, 0), (30, 0), (30, 90), (30, 180), (30, 270))

YUV = np.array([[1, 0, 1.13983], [1, -0.39465, -0.5806], [1, 2.03211, 0]])
EPSILON = 1e-5


def pictures(rows=3, columns=4, n=5, seed=0, largest=2.0):
    """Colours (view, light, row, column, 3) of a smooth BTF whose values exceed 1; float64, exact in half floats."""
    rng = np.random.default_rng(seed)
    basis = rng.uniform(0.05, 1, (3, n * n)), rng.uniform(0.05, 1, (3, rows * columns * 3))
    values = (basis[0].T @ basis[1]).reshape(n, n, rows, columns, 3)
    return (values / values.max() * largest).astype(np.float16).astype(float)


def stored(values, *, cosine_included=True, scale=1.0, angles=ANGLES):
    """What a store must hold of such pictures."""
    cosine = 1 if cosine_included else np.cos(np.radians([theta for theta, _ in angles]))
    return values[:, :, ::-1] * (np.ones(len(angles)) * cosine)[:, None, None, None] * scale


def header(
    signature,
    values,
    *,
    cosine=1,
    version=4,
    channels=("R", "G", "B"),
    angles=ANGLES,
    texels=True,
    rotations=0,
):
    """Signature, measurement block, directions and, but for BDI, texels and rotations."""
    block = b"setup".ljust(80, b"\0") + b"sensor".ljust(80, b"\0") + b"light".ljust(80, b"\0")
    block += struct.pack("<4f", 10, 1, 1, 1)
    block += struct.pack("<I", cosine) if version > 1 else b""
    block += struct.pack("<I", 6) + b"<xml/>" if version > 2 else b""
    if version > 3:
        block += struct.pack("<I", len(channels))
        block += b"".join(struct.pack("<I", len(name)) + name.encode() for name in channels)
    result = signature + struct.pack("<II", len(block) + 8, version) + block
    return result + directions(angles) + (frame(values, signature, rotations) if texels else b"")


def directions(angles):
    table = np.radians(np.array(angles, float)).astype("<f4")
    lights = struct.pack("<I", len(table)) + table.tobytes()
    return struct.pack("<I", len(table)) + b"".join(row.tobytes() + lights for row in table)


def frame(values, signature, rotations=0):
    rows, columns = values.shape[2:4]
    turned = struct.pack("<I", rotations) + np.eye(3, dtype="<f4").tobytes() * rotations
    return struct.pack("<II", columns, rows) + (turned if signature.endswith(b"R") else b"")


def factored(matrix, scalar=4, rank=None):
    """Scalar size, K, rows, columns, S, U, SxV of a matrix."""
    u, s, vt = np.linalg.svd(matrix, full_matrices=False)
    rank = rank or max(1, int((s > 1e-12 * s[0]).sum()))
    kind = f"<f{scalar}"
    parts = s[:rank], u[:, :rank], vt[:rank].T * s[:rank]
    sizes = struct.pack("<BIII", scalar, rank, *matrix.shape)
    return sizes + b"".join(np.ascontiguousarray(part, kind).tobytes() for part in parts)


#: Colour model -> its forward transformation of linear colours (..., 3).
FORWARD = {
    0: lambda rgb: rgb,
    1: lambda rgb: rgb @ np.linalg.inv(YUV).T,
    3: lambda rgb: (rgb - MEAN) @ np.linalg.inv(MATRIX),
    4: lambda rgb: rgb @ np.linalg.inv([[1, 1, -1], [1, 0, 1], [1, -1, -1]]).T,
    5: lambda rgb: np.concatenate(
        [rgb.sum(-1, keepdims=True), rgb[..., 1:] / rgb.sum(-1, keepdims=True)], -1
    ),
    9: lambda rgb: _log_luma(rgb @ np.linalg.inv(YUV).T),
    10: lambda rgb: _log_all(rgb @ np.linalg.inv(YUV).T),
    11: lambda rgb: _log_ratio(rgb @ np.linalg.inv(YUV).T),
    12: lambda rgb: np.log(rgb + EPSILON),
}
MEAN = np.array([0.25, 0.5, 0.125])
MATRIX = np.array([[0.8, 0.5, 0.25], [-0.5, 0.75, 0.5], [0.25, -0.5, 1.0]])


def _log_luma(yuv):
    return np.concatenate([np.log(yuv[..., :1] + EPSILON), yuv[..., 1:]], -1)


def _log_all(yuv):
    chroma = np.sign(yuv[..., 1:]) * (np.log(np.abs(yuv[..., 1:])) - np.log(EPSILON))
    return np.concatenate([np.log(yuv[..., :1] + EPSILON), chroma], -1)


def _log_ratio(yuv):
    luma = yuv[..., :1] + EPSILON
    return np.concatenate([np.log(luma), yuv[..., 1:] / luma], -1)


def dfmf(values, *, model=0, transposed=False, scalar=4, rank=None, cosine=1, **options):
    """A DFMF file: rows are pairs (light fastest), columns texels (x fastest), or the other way round."""
    coded = values if model in (2, None) else FORWARD[model](values)
    coded = coded.reshape(values.shape[0] * values.shape[1], -1, values.shape[-1])
    head = header(b"!DFMF08FCR", values, cosine=cosine, **options)
    head += struct.pack("<Ii", 99, model) + MEAN.astype("<f4").tobytes() + MATRIX.astype("<f4").tobytes()
    planes = (coded[..., c] for c in range(coded.shape[-1]))
    return head + b"".join(factored(plane.T if transposed else plane, scalar, rank) for plane in planes)


def fmf(values, *, signature=b"!FMF12FCER", version=2, log=True, transposed=False, cosine=1, components=99):
    """An FMF file: rows are channel (fastest), light, view; or channel, x, y."""
    n_views, n_lights, _rows, _columns, channels = values.shape
    coded = np.log(values + EPSILON) if log and b"E" in signature and version else values
    if transposed:
        matrix = coded.reshape(n_views * n_lights, -1).T
    else:
        matrix = coded.transpose(0, 1, 4, 2, 3).reshape(n_views * n_lights * channels, -1)
    head = header(signature, values, cosine=cosine)
    if b"ER" in signature:
        head += struct.pack("<B", version) + (struct.pack("<I", int(log)) if version else b"")
        head += struct.pack("<II", 2, 3) + bytes(12) if version > 1 else b""
    return head + struct.pack("<I", components) + factored(matrix)


def pvf(values, *, signature=b"!PVF06FCR", of_lights=True, legacy=False, cosine=1):
    """A PVF file: per view a mean and components over channel (fastest) and light, or channel, x, y."""
    n_views, n_lights, rows, columns, channels = values.shape
    if legacy:
        head = signature + struct.pack("<i4I", 301074, 9, columns, rows, n_views) + directions(ANGLES)
    else:
        head = header(signature, values, cosine=cosine) + struct.pack("<II", 9, n_views)
    for view in values:
        table = view.reshape(n_lights, -1, channels)
        data = (
            table.transpose(1, 0, 2).reshape(rows * columns, -1) if of_lights else table.reshape(n_lights, -1)
        )
        mean = data.mean(0)
        u, s, vt = np.linalg.svd(data - mean, full_matrices=False)
        head += struct.pack("<BIII", 4, len(s), len(data), data.shape[1])
        for part in (s**2, mean, vt.T, u * s):
            head += np.ascontiguousarray(part, "<f4").tobytes()
    return head


def bdi(values, *, compression=0, lines=2, mask=None, cosine=1, filled=False):
    """A BDI file: chunks of texels, each with view, light, channel (fastest)."""
    _n_views, _n_lights, rows, columns, _channels = values.shape
    head = header(b"!BDIF06R2!", values, cosine=cosine, texels=False)
    head += struct.pack("<IIIB", columns, rows, lines, compression)
    mask = np.ones((rows, columns), np.uint8) if mask is None else mask
    head += mask.astype(np.uint8).tobytes() + struct.pack("<I", 0)
    texels = values.transpose(2, 3, 0, 1, 4).reshape(rows * columns, -1)
    texels = texels[mask.ravel() != 0] if compression == 2 else texels
    for first in range(0, len(texels), lines * columns):
        chunk = texels[first : first + lines * columns]
        if filled:
            chunk = np.concatenate([chunk, np.zeros((lines * columns - len(chunk), chunk.shape[1]))])
        data = chunk.astype("<f2").tobytes()
        data = bz2.compress(data) if compression == 1 else data
        head += struct.pack("<I", len(data)) + data
    return head


def mif(images, pairs, *, space="XYZ", extra=b"", order=None, reference=False):
    """A MIF container; pairs are (light, view) angles in degrees."""
    data = struct.pack("<8sQQ", b"MIF FILE", 8, 1)
    kinds = {"uint8": 1, "uint16": 2, "float16": 9, "float32": 10, "float64": 11}
    for index, image in enumerate(images):
        body = struct.pack("<6Q", index, 0, kinds[image.dtype.name], *image.shape) + image.tobytes()
        data += struct.pack("<QQ", 0, len(body)) + body + struct.pack("<QQ", 2**64 - 1, 5) + b"     "
    items = "".join(
        f'<directions-item index="{i}"><direction index="0" type="source" theta="{light[0]}" phi="{light[1]}"/>'
        f'<direction index="1" type="sensor" theta="{view[0]}" phi="{view[1]}"/></directions-item>'
        for i, (light, view) in enumerate(pairs)
    )
    table = f'<directions type="list" id="d" units="deg" count="{len(pairs)}">{items}</directions>'
    inner = '<directions reference="d"/>' if reference else table
    order = f"<index-map>{', '.join(map(str, order))}</index-map>" if order else ""
    text = (
        f'<?xml version="1.0"?><mif>{table if reference else ""}<btf id="b" name={quoteattr("t")}>{inner}{order}'
        f'<colors reference="c"/></btf><colors id="c"><color_space>{space}</color_space>'
        f'<white_point X="95.047" Y="100.0" Z="108.883"/></colors></mif>'
    ).encode()
    return data + struct.pack("<QQ", 1, len(text)) + text + extra


def merl(f, counts=(8, 8, 16)):
    """A MERL file of ``f(θ_h, θ_d, φ_d)`` -> (..., 3) in 1/sr at the cells' centres."""
    shares = [(np.arange(n) + 0.5) / n for n in counts]
    angles = shares[0] ** 2 * np.pi / 2, shares[1] * np.pi / 2, shares[2] * np.pi
    values = f(*np.meshgrid(*angles, indexing="ij")) * 1500 / np.array([1, 1.15, 1.66])
    return struct.pack("<3i", *counts) + np.moveaxis(values, -1, 0).astype("<f8").tobytes()


def picture(values, kind="png"):
    """One 8-bit picture as bytes."""
    from PIL import Image

    stream = io.BytesIO()
    settings = {"quality": 95, "subsampling": 0} if kind == "jpg" else {}
    codes = np.round(np.clip(values, 0, 1) * 255).astype(np.uint8)
    Image.fromarray(codes).save(stream, {"jpg": "JPEG", "png": "PNG"}[kind], **settings)
    return stream.getvalue()
