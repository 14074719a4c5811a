"""Random streams depend on what is drawn alone."""

from __future__ import annotations

from render.seeds import generator_for


def test_same_key_same_stream():
    assert generator_for(3, "train", "a", 1).random() == generator_for(3, "train", "a", 1).random()


def test_any_difference_gives_another_stream():
    keys = [(3, "train", "a", 1), (4, "train", "a", 1), (3, "test", "a", 1), (3, "train", "b", 1), (3, "train", "a", 2)]
    keys += [(3, "train", "a1"), (3, "traina", 1), (3, "train", "a", "1")]
    assert len({generator_for(*key).random() for key in keys}) == len(keys)


def test_streams_stay_the_same_between_versions():
    """Data sets made before must be repairable: their bytes may not change silently."""
    assert generator_for(0, "train", "laptop-0000", "states").integers(10**6) == 945990
