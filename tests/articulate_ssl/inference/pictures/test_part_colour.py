import numpy as np

from articulate_ssl.inference.pictures.part_colour import PALETTE, part_colour


def test_part_colours_are_distinct_and_start_again():
    assert len(np.unique(PALETTE, axis=0)) == len(PALETTE)
    assert (part_colour(np.arange(2 * len(PALETTE))) == np.tile(PALETTE, (2, 1))).all()
