"""Directions that are chosen for a surface: where pictures between the others are wrong most."""

import numpy as np
import pytest

from btfref.cli import main
from btfref.errors import InputError
from btfref.sampling import chosen_directions as module
from btfref.sampling import open_store
from btfref.sampling.chosen_directions import candidates, choose, chosen_directions


def test_the_candidates_are_rings_from_the_pole_on():
    given = candidates()
    assert given.rings is not None
    assert given.vectors[0].tolist() == [0, 0, 1]
    assert len(given) > 200


def test_they_lie_where_the_pictures_change():
    """Pictures that change fast on the side of +x alone: most of what is chosen beyond the first lies there."""
    given = candidates()
    x = given.vectors[:, 0]
    pictures = np.stack([np.cos(40 * np.maximum(x, 0)), np.ones(len(x))], 1)
    picked = choose(given, pictures @ pictures.T, 40)
    assert len(set(picked.tolist())) == 40
    assert picked[0] == 0
    beyond = x[picked[1 + module.FIRST :]]
    assert 4 * (beyond > 0).sum() > 3 * len(beyond)


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
    from btfref.numerics.sphere.directions import directions, ring_directions

    return directions(ring_directions([(0, 1, 0), (40, 8, 0), (80, 8, 0)]))


@pytest.mark.parametrize("n", [3, 10_000])
def test_numbers_that_cannot_be_chosen(n):
    with pytest.raises(InputError, match="directions to choose"):
        chosen_directions("flat", n)
