"""Directions that are chosen for a surface: where pictures between the others are wrong most."""

import numpy as np
import pytest

from btfref.cli import main
from btfref.errors import InputError
from btfref.gates.tolerances import tolerance
from btfref.numerics.sphere.directions import directions, ring_directions
from btfref.sampling import chosen_directions as module
from btfref.sampling import open_store
from btfref.sampling.chosen_directions import candidates, chosen_directions, error_of, vectors_of


def test_the_candidates_are_rings_from_the_pole_on():
    given = candidates()
    assert given.rings is not None
    assert given.vectors[0].tolist() == [0, 0, 1]
    assert len(given) > 200


@pytest.fixture(scope="module")
def given():
    """A hundred candidates."""
    return directions(ring_directions([(t, max(1, 8 * (t // 14)), 0) for t in (0, 15, 30, 45, 60, 75)]))


@pytest.fixture(autouse=True)
def _short(monkeypatch):
    """A short search is enough for small tables."""
    monkeypatch.setattr(module, "MOST", 40)


def test_rings_lie_where_the_pictures_change(given):
    """Fast beyond 45 degrees, or not beyond 45 degrees at all."""
    theta, phi = given.theta, given.phi
    found = []
    for wild in (theta > np.radians(45), theta < np.radians(45)):
        pictures = np.stack([np.where(wild, np.cos(3 * phi) * np.sin(theta), 0), np.ones(len(phi))], 1)
        _, rings = module._improved(given, pictures @ pictures.T, module._even(40, 5))
        assert sum(count for _, count in rings) == 40
        assert rings[0] == (0, 1)
        assert all(count >= module.LEAST for _, count in rings[1:])
        found.append(sum(count for angle, count in rings if angle > 45))
    assert found[0] > found[1]


def test_the_choice_has_less_error_than_other_sets(given):
    """Of pictures that are smooth but for highlights; the error of all candidates themselves is none."""
    pictures = np.concatenate([given.vectors, np.exp(-20 * (1 - given.vectors @ given.vectors[80:84].T))], 1)
    gram = pictures @ pictures.T
    error, rings = module._improved(given, gram, module._even(50, 5))
    assert error == pytest.approx(error_of(given, gram, vectors_of(rings)))
    assert error < error_of(given, gram, directions("10x5").vectors)
    assert error < error_of(given, gram, vectors_of(module._even(50, 5)))
    assert error_of(given, gram, given.vectors) <= tolerance("queries.rounding.length") * error


def test_a_synthesis_takes_them(tmp_path, monkeypatch, need):
    need("llvm")
    monkeypatch.setattr(module, "candidates", _few)
    out = tmp_path / "x.btf.zarr"
    command = f"synth flat -o {out} --texels 2 --spp 2 --views adaptive:12 --lights adaptive:12"
    assert main(command.split()) == 0
    store = open_store(out)
    assert len(store.views) == len(store.lights) == 12
    assert np.array_equal(store.views.vectors, chosen_directions("flat", 12).vectors)


def _few():
    """Few candidates."""
    return directions(ring_directions([(0, 1, 0), (40, 8, 0), (80, 8, 0)]))


@pytest.mark.parametrize("n", [3, 10_000])
def test_numbers_that_cannot_be_chosen(n):
    with pytest.raises(InputError, match="directions to choose"):
        chosen_directions("flat", n)
