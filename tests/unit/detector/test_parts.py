"""Parts of a detector are picked by number and by label."""

import dataclasses
import pickle

import pytest

from cgemit import load

DESIGN = load("besiii-cgem-design")


def test_parts_are_picked_by_number_and_by_label():
    assert DESIGN.cgem["L2"] is DESIGN.cgem[1] is DESIGN.cgem[-2]
    assert DESIGN.cgem[1:] == (DESIGN.cgem["L2"], DESIGN.cgem["L3"])
    assert [DESIGN.beam_pipe[part.label] for part in DESIGN.beam_pipe] == list(DESIGN.beam_pipe)
    assert [DESIGN.walls[part.label] for part in DESIGN.walls] == list(DESIGN.walls)
    with pytest.raises(KeyError, match="L1, L2, L3"):
        DESIGN.cgem["L4"]
    thin = dataclasses.replace(DESIGN, barrels=DESIGN.cgem[:2])
    again = pickle.loads(pickle.dumps(thin))
    assert again == thin
    assert again.cgem["L2"] == DESIGN.cgem["L2"]
    with pytest.raises(KeyError):
        again.cgem["L3"]
