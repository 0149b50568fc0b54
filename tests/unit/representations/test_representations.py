"""Fits, files and definitions of the registered methods."""

import dataclasses
import json

import numpy as np
import pytest
from oracle import oracle_btf
from probes import probe_points

from btfref.conventions import texel_stencil
from btfref.errors import InputError
from btfref.gates.tolerances import tolerance
from btfref.numerics.solvers.clustering import local_pca
from btfref.numerics.solvers.lowrank import range_basis, texel_matrix
from btfref.numerics.solvers.streaming import array_columns, leading, orthonormal, principal
from btfref.registry import method, methods
from btfref.representations import load, read_info, save
from btfref.representations.file.container import payload_bytes


@pytest.fixture(scope="module")
def btf(fits):
    return fits.btf()


@pytest.fixture(scope="module")
def small():
    """A table that the definition can be asked for whole."""
    return oracle_btf((6, 4))


@pytest.fixture(params=methods())
def row(request):
    return method(request.param)


#: Methods that interpolate tables at the measured directions, and so reproduce what their fit says they keep; models
#: of reflectance with parameters of their own have tests of their own.
TABLES = ("raw", "svd", "lpca")

#: Settings that leave an error above the rounding of sums of squares, on few texels.
COARSE = {"lpca": {"clusters": 4, "components": 3}}


def at_samples(btf, representation):
    """The definition at every texel centre, view and light: the table that it stands for."""
    rows, columns = btf.values.shape[2:4]
    v, u = np.meshgrid((np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns, indexing="ij")
    uv = np.stack([u, v], -1)[None, None]
    w_light, w_view = btf.lights.vectors[None, :, None, None], btf.views.vectors[:, None, None, None]
    return representation.evaluate(uv, w_light, w_view)


def relative_error(test, reference):
    return np.sqrt(((test - reference) ** 2).sum() / (reference.astype(float) ** 2).sum())


def test_raw_returns_the_samples(small):
    value = at_samples(small, method("raw").fit(small))
    np.testing.assert_allclose(
        value, small.values, atol=tolerance("interpolation.float32.max") * small.values.max()
    )


@pytest.mark.parametrize("key", TABLES)
def test_fit_error_is_what_the_definition_shows(small, key):
    """The error that a fit reports is that of its stored maps, but for their rounding."""
    representation = method(key).fit(small, **COARSE.get(key, {}))
    stated = np.sqrt(representation.meta.get("fit", {}).get("error", 0.0))
    measured = relative_error(at_samples(small, representation), small.values)
    assert abs(measured - stated) <= tolerance("fit.stated.max")
    assert measured < tolerance("fit.oracle.max")


def test_more_components_are_never_worse(btf):
    for key in ("svd", "lpca"):
        errors = [
            method(key).fit(btf, components=n, storage="float").meta["fit"]["error"] for n in (1, 2, 4, 8)
        ]
        assert errors == sorted(errors, reverse=True)


def test_files_come_back_exactly(row, fits, tmp_path):
    representation = fits(row.key)
    path = tmp_path / f"x.{row.key}.exr"
    save(representation, path)
    again = load(path)
    assert again.meta == json.loads(json.dumps(representation.meta))
    for name, array in representation.arrays().items():
        np.testing.assert_array_equal(again.arrays()[name], array)
        assert again.arrays()[name].dtype == array.dtype
    points = probe_points(np.random.default_rng(0), 500, representation)
    np.testing.assert_array_equal(again.evaluate(*points), representation.evaluate(*points))
    assert list(tmp_path.iterdir()) == [path]


def test_info_reads_headers(row, fits):
    path = fits.path(row.key)
    info = read_info(path)
    assert info["kind"] == "representation"
    assert info["method"] == row.key
    assert info["shape"] == [81, 81, 16, 12, 3]
    assert info["raw_bytes"] == 81 * 81 * 16 * 12 * 3 * 4
    assert info["file_bytes"] == path.stat().st_size
    assert info["ratio"] == info["raw_bytes"] / info["payload_bytes"]
    assert info["parent"]["mesostructure"] == "oracle"


def test_payload_counts_the_maps_alone():
    """LPCA at 256² texels, 81² directions, 16 clusters with a mean and 4 components, one byte an index."""
    maps = {
        "basis": ((16, 5, 81, 81, 3), "float32"),
        "weights": ((256, 256, 4), "float32"),
        "cluster": ((256, 256, 1), "uint32"),
        "view_rings": ((6, 4), "float32"),
    }
    assert payload_bytes(maps, {"index_bytes": {"cluster": 1}}) == 16 * 5 * 6561 * 3 * 4 + 65536 * 17


def test_fits_are_deterministic(small, row):
    a, b = row.quick_fit(small), row.quick_fit(small)
    for name, array in a.arrays().items():
        np.testing.assert_array_equal(array, b.arrays()[name])


def test_every_method_has_a_paper_preset(row):
    assert "paper" in row.presets


@pytest.mark.parametrize(
    ("values", "shape"), [(0.0, (1, 1)), (0.3, (1, 1)), (0.0, (1, 5)), (0.3, (3, 3))], ids=str
)
def test_degenerate_data(values, shape, row):
    """Fewer texels than clusters or components, no variance, no energy: finite, and the constant comes back."""
    btf = oracle_btf(shape)
    btf = dataclasses.replace(btf, values=np.full_like(btf.values, values))
    representation = row.quick_fit(btf)
    for array in representation.arrays().values():
        assert np.isfinite(array).all()
    value = at_samples(btf, representation)
    assert np.isfinite(value).all()
    if row.key in TABLES:
        np.testing.assert_allclose(value, btf.values, atol=tolerance("fit.constant.max"))
    group, mean = representation.sampling_tables()
    assert group.shape == shape
    assert np.isfinite(mean).all()
    assert group.max() < len(mean)


def test_half_floats_never_overflow_in_silence(small):
    huge = dataclasses.replace(small, values=small.values.astype(np.float32) * 1e6)
    for key in ("svd", "lpca"):
        with pytest.raises(InputError, match="do not fit"):
            method(key).fit(huge)
        fitted = method(key).fit(huge, storage="float")
        assert relative_error(at_samples(huge, fitted), huge.values) < tolerance("fit.oracle.max")


@pytest.mark.parametrize(
    "parameters", [{"clusters": 0}, {"components": -1}, {"components": 2.5}, {"storage": "int"}]
)
def test_bad_parameters(btf, parameters):
    with pytest.raises(InputError):
        method("lpca").fit(btf, **parameters)


def test_unknown_method():
    with pytest.raises(InputError, match="one of raw"):
        method("nope")


def test_local_pca_finds_planted_subspaces(rng):
    """Points near three affine planes are told apart although their means coincide with none."""
    axes = [np.linalg.qr(rng.normal(size=(12, 2)))[0].T for _ in range(3)]
    offsets = rng.normal(size=(3, 12)) * 4
    truth = rng.integers(0, 3, 600)
    points = np.stack([offsets[k] + rng.normal(size=2) @ axes[k] for k in truth]) + 1e-3 * rng.normal(
        size=(600, 12)
    )
    labels, _ = local_pca(points, 3, 2, rng)
    table = np.zeros((3, 3))
    np.add.at(table, (truth, labels), 1)
    assert table.max(1).sum() == 600


def test_range_basis_spans_the_leading_space(rng):
    left, right = np.linalg.qr(rng.normal(size=(80, 30)))[0], np.linalg.qr(rng.normal(size=(200, 30)))[0]
    values = 0.5 ** np.arange(30)
    matrix = ((left * values) @ right.T).astype(np.float32)
    basis, coordinates = range_basis(matrix, 6, rng, iterations=2)
    np.testing.assert_allclose(coordinates, matrix @ basis.T, atol=tolerance("lowrank.basis.max"))
    np.testing.assert_allclose(
        np.abs(np.einsum("ij,ij->i", basis, right.T[:6])), 1, atol=tolerance("lowrank.basis.max")
    )


def test_leading_directions_are_found_by_blocks(rng):
    """From blocks of columns, what the whole matrix has; nothing beyond its rank."""
    left, right = np.linalg.qr(rng.normal(size=(80, 30)))[0], np.linalg.qr(rng.normal(size=(200, 30)))[0]
    values = 0.5 ** np.arange(30)
    matrix = ((left * values) @ right.T).astype(np.float32)
    found = leading(array_columns(matrix, 23), 6, rng, passes=3)
    np.testing.assert_allclose(found.coordinates, matrix @ found.basis.T, atol=tolerance("lowrank.basis.max"))
    np.testing.assert_allclose(
        np.abs(np.einsum("ij,ij->i", found.basis, right.T[:6])), 1, atol=tolerance("lowrank.basis.max")
    )
    np.testing.assert_allclose(found.squares, (matrix**2).sum(1), atol=tolerance("lowrank.basis.max"))
    flat = leading(array_columns(np.outer(left[:, 0], right[:, 0]), 50), 4, rng, passes=2)
    np.testing.assert_array_equal(flat.coordinates[:, 1:], 0)
    np.testing.assert_allclose(
        np.abs(flat.coordinates[:, 0]), np.abs(left[:, 0]), atol=tolerance("lowrank.basis.max")
    )


def test_principal_directions_have_no_more_than_the_rank(rng):
    rows = rng.normal(size=(9, 2)) @ rng.normal(size=(2, 40))
    span = orthonormal(np.concatenate([rows[:3].T, rng.normal(size=(40, 2))], 1))
    basis, coordinates = principal(span, rows @ span)
    np.testing.assert_array_equal(basis[2:], 0)
    np.testing.assert_allclose(basis[:2] @ basis[:2].T, np.eye(2), atol=tolerance("lowrank.basis.max"))
    np.testing.assert_allclose(
        coordinates @ basis, rows, atol=tolerance("lowrank.basis.max") * np.abs(rows).max()
    )


def test_texel_matrix(btf):
    matrix = texel_matrix(btf.values)
    np.testing.assert_array_equal(matrix[5 * 12 + 7], btf.values[:, :, 5, 7].ravel().astype(np.float32))


@pytest.mark.parametrize("filter_type", ["nearest", "bilinear"])
def test_texel_stencil(filter_type, rng):
    uv = rng.uniform(-5, 5, (1000, 2))
    index, weight = texel_stencil(uv, (6, 9), filter_type)
    np.testing.assert_allclose(weight.sum(-1), 1, atol=tolerance("interpolation.exact.max"))
    centre = (np.stack([index % 9, index // 9], -1) + 0.5) / [9, 6]
    # Around the wrap the distance is that on the torus.
    distance = np.abs(np.mod(centre - uv[:, None] + 0.5, 1) - 0.5) * [9, 6]
    reach = 1 / 2 if filter_type == "nearest" else 1
    assert distance.max() <= reach + tolerance("interpolation.exact.max")
    if filter_type == "bilinear":
        np.testing.assert_allclose(
            np.prod(1 - distance, -1), weight, atol=tolerance("interpolation.exact.max")
        )
