"""Our files in other people's readers, and other people's decoding against ours.

Each peer lives in an environment of its own, which these variables name; a test whose peer is not there is skipped
and says so:

BTFREF_BTF_EXTRACTOR  a Python (3.8 or 3.9) with btf-extractor 1.7 (NumPy < 1.20, Cython 0.29, C++) and OpenCV
BTFREF_PYSMTB         a Python with pysmtb 0.4
BTFREF_MIFDUMP        a program built with UTIA's MIFlib 0.4 (its header wants mending for GCC): for each pair of
                      the BTF "b" a line with index, θ_l, φ_l, θ_v, φ_v in degrees and all values of its image
BTFREF_BTFLIB         the folder ``matlab/@btf/private`` of the data owners' btflib, run by Octave

Their known differences from the data's definition are asserted here, so that they stay explained: see README.
"""

import os
import shutil
import subprocess
import zipfile

import formats_material as material
import numpy as np
import pytest

from btfref.formats import export_btf, import_btf, open_source
from btfref.gates import tolerance
from btfref.images import radiance
from btfref.numerics.sphere.directions import directions
from btfref.sampling import SampledBTF

EXTRACT = """
import sys, numpy, btf_extractor
kind, path, out = sys.argv[1:]
if kind == "AtriumHdr":
    # Its decoder of pictures fetches a binary; OpenCV's serves, the handling of the file stays its own.
    import cv2, imageio
    imageio.imread = lambda data, format: cv2.imdecode(numpy.frombuffer(data, numpy.uint8), cv2.IMREAD_UNCHANGED)
btf = getattr(btf_extractor, kind)(path)
angles = sorted(btf.angles_set)
numpy.savez(out, angles=numpy.array(angles, float), images=numpy.stack([btf.angles_to_image(*a) for a in angles]))
"""

PARSE = """
import importlib.util, sys, types, numpy
# The package's own __init__ brings in a viewer.
package = types.ModuleType("pysmtb")
package.__path__ = importlib.util.find_spec("pysmtb").submodule_search_locations
sys.modules["pysmtb"] = package
from pysmtb.btf import read_ubo_btf_dfmf
meta, data = read_ubo_btf_dfmf(sys.argv[1])
numpy.savez(sys.argv[2], *[numpy.asarray(x, float) for x in (*data.U, *data.SxV)], size=[meta.width, meta.height],
            model=meta.color_model, cosine=meta.cosine_in_data)
"""

DECODE = """
function y = halfprecision(x, varargin)
  x = double(x); s = floor(x / 32768); e = floor(mod(x, 32768) / 1024); m = mod(x, 1024);
  y = single((1 - 2 * s) .* ((e == 0) .* (m * 2^-24) + (e > 0) .* (2 .^ (e - 15)) .* (1 + m / 1024)));
end
names = {NAMES};
for i = 1 : numel(names)
  fid = fopen([names{i} '.btf'], 'r');
  s = fread(fid, 10, '*char')'; frewind(fid);
  switch s(2 : 3)
    case 'DF', [data, meta] = read_ubo_dfmf(fid, s, 1); decode = @decode_dfmf_texture;
    case 'FM', sig = regexp(s, '^!FMF..FC(ER|R|)', 'match'){1}; decode = @decode_fmf_texture;
      [data, meta] = read_ubo_fmf(fid, sig, strcmp(sig, '!FMF12FCER'), 1);
    case 'PV', sig = regexp(s, '^!PVF..FC(R|)', 'match'){1}; decode = @decode_pvf_texture;
      [data, meta] = read_ubo_pvf(fid, sig, 1);
    case 'BD', [data, meta] = read_ubo_bdi(fid, s, true); decode = @decode_bdi_texture;
      data.chunks = zeros(meta.chunk_size, meta.num_chunks, 'uint16');
      for c = 1 : meta.num_chunks
        fseek(fid, double(meta.chunk_offset(c)) + 4, 'bof');
        left = (meta.num_stored_abrdfs - (c - 1) * meta.abrdfs_per_chunk) * meta.abrdf_size;
        chunk = fread(fid, min(meta.chunk_size, left), '*uint16');
        data.chunks(1 : numel(chunk), c) = chunk;
      end
      data.chunks_buffered = true(1, meta.num_chunks);
  end
  fclose(fid);
  if ~isfield(meta, 'num_channels') meta.num_channels = 3; end
  if ~isfield(data, 'class') data.class = 'single'; end
  obj = struct('data', data, 'meta', meta);
  out = zeros(3, meta.width, meta.height, meta.nL, meta.nV);
  for v = 1 : meta.nV
    for l = 1 : meta.nL
      out(:, :, :, l, v) = permute(restore_dynamic_range(obj, undecorrelate(obj, squeeze(decode(obj, l, v)))), [3 2 1]);
    end
  end
  fid = fopen([names{i} '.out'], 'w'); fwrite(fid, out, 'double'); fclose(fid);
end
"""


def peer(variable):
    """What a variable names, or a skip with the reason."""
    value = os.environ.get(variable)
    if not value or not os.path.exists(value):
        pytest.skip(f"{variable} names no peer (see this file's first lines)")
    return value


def run(*command, cwd=None):
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, cwd=cwd)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


def extracted(kind, path, tmp_path):
    """(angles (n, 4) tl pl tv pv, images as RGB) as btf-extractor has them."""
    python = peer("BTFREF_BTF_EXTRACTOR")
    run(python, "-c", EXTRACT, kind, str(path), str(tmp_path / "peer.npz"))
    with np.load(tmp_path / "peer.npz") as found:
        return found["angles"], found["images"][..., ::-1]


def smooth(rows, columns, n, largest):
    rng = np.random.default_rng(5)
    values = rng.uniform(0.1, 1, (4, n * n)).T @ rng.uniform(0.1, 1, (4, rows * columns * 3))
    return (values * (largest / values.max())).reshape(n, n, rows, columns, 3)


def by_angles(source, angles):
    """Index of (view, light) of each tl, pl, tv, pv in degrees."""
    result = []
    for tl, pl, tv, pv in np.radians(angles):
        pair = []
        for grid, theta, phi in ((source.views, tv, pv), (source.lights, tl, pl)):
            w = np.array([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
            pair.append(int(np.argmax(grid.vectors @ w)))
        result.append(tuple(pair))
    return result


def test_extractor_reads_our_ubo2003(tmp_path):
    """Every code of every picture, and all 6561 directions."""
    grid = directions("ubo81")
    btf = SampledBTF(smooth(8, 16, 81, 1).astype(np.float16), grid, grid, None, {})
    export_btf(btf, tmp_path / "x.zip", "ubo", image="jpg")
    angles, images = extracted("Ubo2003", tmp_path / "x.zip", tmp_path)
    assert len(angles) == 6561
    source = open_source(tmp_path / "x.zip", gamma=1.0)
    pairs = by_angles(source, angles)
    assert len(set(pairs)) == 6561
    for number in range(0, 6561, 37):
        view, light = pairs[number]
        ours = source.colours(view, light, light + 1)[0] * 255
        # Two decoders of one JPEG may round a code differently.
        assert np.abs(ours - images[number]).max() <= tolerance("formats.peer_jpeg.codes")


def test_extractor_reads_atrium_as_we_do(tmp_path):
    """It overwrites bytes 53 to 66 and turns the rows over; so does our reading of that line. It adds no half code."""
    values = smooth(256, 256, 2, 4.0)
    name = "tl{:03d} pl000 tv{:03d} pv000.hdr"
    path = tmp_path / "x.zip"
    with zipfile.ZipFile(path, "w") as target:
        for view in range(2):
            for light in range(2):
                data = radiance.encode(values[view, light], reversed_line=True)
                at = data.index(b"\n\n") + 1
                data = data[:11] + b"#".ljust(53 - at - 2, b"x") + b"\n" + data[11:]
                assert data.index(b"+X 256 -Y 256") == 53
                target.writestr(name.format(15 * light, 15 * view), data)
    angles, images = extracted("AtriumHdr", path, tmp_path)
    for (tl, _, tv, _), image in zip(angles, images, strict=True):
        view, light = int(tv) // 15, int(tl) // 15
        with zipfile.ZipFile(path) as source:
            ours = radiance.decode(source.read(name.format(int(tl), int(tv))), "x")
        half = 0.5 * 2.0 ** (np.frexp(ours.max(-1, keepdims=True))[1] - 8.0)
        # The one difference: the middle of a code instead of its lower end.
        np.testing.assert_allclose(ours - half, image, rtol=tolerance("formats.peer_radiance.rtol"))
        assert np.abs(ours - values[view, light]).max() < tolerance("formats.peer_radiance.max_abs")


@pytest.mark.parametrize("model", [0, 11])
def test_extractor_reads_our_dfmf(model, tmp_path):
    """Ours against theirs: rows turned over by them, chroma of model 11 U·Y + ε by them, colours clipped by them."""
    grid = directions("ubo81")
    values = smooth(8, 16, 81, 0.9)
    btf = SampledBTF(values.astype(np.float16), grid, grid, None, {})
    export_btf(btf, tmp_path / "x.btf", "bonn", components=8, colour_model=model)
    angles, images = extracted("Ubo2014", tmp_path / "x.btf", tmp_path)
    source = open_source(tmp_path / "x.btf")
    worst = 0.0
    for number, (view, light) in enumerate(by_angles(source, angles)):
        if number % 37:
            continue
        ours = source.colours(view, light, light + 1)[0]
        if model == 11:
            ours = np.clip(ours, 0, 1)
        worst = max(worst, float(np.abs(ours[::-1] - images[number]).max()))
    assert worst <= tolerance("formats.peer_dfmf.max")


def test_extractor_clips_what_we_keep(tmp_path):
    """Reflectance above 1 in colour model 11: theirs ends at 1, ours does not."""
    grid = directions("ubo81")
    btf = SampledBTF(smooth(4, 8, 81, 3.0).astype(np.float16), grid, grid, None, {})
    export_btf(btf, tmp_path / "x.btf", "bonn", components=8, colour_model=11)
    _, images = extracted("Ubo2014", tmp_path / "x.btf", tmp_path)
    store = import_btf(tmp_path / "x.btf", tmp_path / "x.btf.zarr")
    assert images.max() == 1
    assert SampledBTF.load(store.path).values.max() > tolerance("formats.above_one")


def test_pysmtb_parses_our_dfmf(tmp_path):
    """It reads factors only, and leaves colour as it is: the products agree with ours of colour model 0."""
    python = peer("BTFREF_PYSMTB")
    grid = directions("2x4")
    btf = SampledBTF(smooth(3, 5, 8, 1).astype(np.float16), grid, grid, None, {})
    export_btf(btf, tmp_path / "x.btf", "bonn", components=5)
    run(python, "-c", PARSE, str(tmp_path / "x.btf"), str(tmp_path / "peer.npz"))
    with np.load(tmp_path / "peer.npz") as found:
        parts = [found[f"arr_{i}"] for i in range(6)]
        assert (found["size"].tolist(), int(found["model"]), int(found["cosine"])) == ([5, 3], 0, 1)
    theirs = np.stack([u @ v.T for u, v in zip(parts[:3], parts[3:], strict=True)], -1).reshape(8, 8, 3, 5, 3)
    source = open_source(tmp_path / "x.btf")
    ours = np.stack([source.colours(view, 0, 8) for view in range(8)])
    np.testing.assert_allclose(ours, theirs, atol=tolerance("formats.float_factors.max"))


@pytest.mark.parametrize("reference", [False, True])
def test_owners_library_reads_mif_as_we_do(reference, tmp_path):
    """Images, index map and directions; MIFlib decodes float32 images only."""
    program = peer("BTFREF_MIFDUMP")
    values = material.pictures()
    pairs = [(light, view) for view in material.ANGLES for light in material.ANGLES]
    order = np.random.default_rng(0).permutation(25)
    images = [None] * 25
    for pair, index in enumerate(order):
        images[index] = values.reshape(25, 3, 4, 3)[pair].astype(np.float32)
    path = tmp_path / "x.mif"
    path.write_bytes(material.mif(images, pairs, space="RGB", order=order.tolist(), reference=reference))
    theirs = np.array([line.split() for line in run(program, str(path)).splitlines()], float)
    assert theirs.shape == (25, 5 + 36)
    source = open_source(path)
    for (view, light), row in zip(by_angles(source, theirs[:, 1:5]), theirs, strict=True):
        np.testing.assert_allclose(
            source.colours(view, light, light + 1).ravel(), row[5:], rtol=tolerance("formats.float32.rtol")
        )


def test_owners_code_decodes_as_we_do(tmp_path):
    """Every family and colour model that btflib reads under Octave, file by file."""
    private = peer("BTFREF_BTFLIB")
    octave = shutil.which("octave")
    if octave is None:
        pytest.skip("Octave is not installed")
    values = material.pictures()
    files = {f"dfmf{model}": material.dfmf(values, model=model) for model in material.FORWARD}
    files |= {
        "dfmf_transposed": material.dfmf(values, transposed=True),
        "dfmf_half": material.dfmf(values, scalar=2),
        "fmf": material.fmf(values),
        "fmf_transposed": material.fmf(values, transposed=True),
        "fmf_linear": material.fmf(values, log=False),
        "fmf_few": material.fmf(values, components=7),
        "fmf06r": material.fmf(values, signature=b"!FMF06FCR"),
        "fmf06": material.fmf(values, signature=b"!FMF06FC"),
        "pvf": material.pvf(values),
        "pvf_images": material.pvf(values, of_lights=False),
        "pvf06": material.pvf(values, signature=b"!PVF06FC"),
        "pvf_legacy": material.pvf(values, legacy=True),
        "bdi": material.bdi(values),
        "bdi_filled": material.bdi(values, filled=True),
        "bdi_sparse": material.bdi(values, compression=2),
    }
    for name, data in files.items():
        (tmp_path / f"{name}.btf").write_bytes(data)
    # A copy: their folder lies in a class, whose private functions Octave would hide; and +utils beside it.
    for entry in os.listdir(private):
        shutil.copy(os.path.join(private, entry), tmp_path)
    names = " ".join(f"'{name}'" for name in files)
    (tmp_path / "decode.m").write_text("1;\n" + DECODE.replace("NAMES", names))
    package = os.path.dirname(os.path.dirname(private))
    run(
        octave,
        "--no-gui",
        "--quiet",
        "--eval",
        f"addpath('{package}'); cd('{tmp_path}'); source decode.m",
        cwd=tmp_path,
    )
    for name in files:
        theirs = np.fromfile(tmp_path / f"{name}.out").reshape(values.shape)
        source = open_source(tmp_path / f"{name}.btf")
        ours = np.stack([source.colours(view, 0, 5) for view in range(5)])
        assert np.abs(ours - theirs).max() <= tolerance("formats.float_factors.max"), name
