"""The weights that are in the package now."""

import json
import re
import zlib
from pathlib import Path

import pytest

from articulate_ssl.training.checkpoint import load_module
from articulate_ssl.training.shipped_weights import WEIGHTS_FOLDER, shipped_weights
from articulate_ssl.training.weights_card import CARD_SUFFIX, HEADLINES, VIEWS, WeightsCard

MAX_BYTES = 29_000_000  # in the wheel, which deflates them; 28 until washing machines kept views of closed doors, too
ROOT = Path(__file__).parents[3]


def test_all_weights_together_are_small() -> None:
    assert 0 < sum(len(zlib.compress(file.read_bytes())) for file in WEIGHTS_FOLDER.iterdir()) <= MAX_BYTES


def test_every_file_is_weights_with_a_card_and_part_of_the_wheel() -> None:
    files = set(WEIGHTS_FOLDER.iterdir())
    assert files == {file for w in shipped_weights() for file in (w.file, w.file.with_suffix(CARD_SUFFIX))}
    listed = re.search(r'"articulate_ssl\.pretrained" = (\[.*\])', (ROOT / "pyproject.toml").read_text())[1]
    packed = {file for pattern in json.loads(listed) for file in WEIGHTS_FOLDER.parent.glob(pattern)}
    assert files <= packed


@pytest.mark.parametrize("weights", shipped_weights(), ids=lambda weights: weights.name)
def test_weights_load_and_are_what_their_card_says(weights) -> None:
    module, card = load_module(weights.file), WeightsCard.load(weights.file.with_suffix(CARD_SUFFIX))
    assert (card.category, card.view) == (module.category, weights.view) == (weights.category, weights.view)
    assert module.orientation.limited == (weights.view == "depth")
    assert module.num_parts == len(card.part_names) and module.confidence.learnt
    assert (ROOT / "configs" / f"{card.category}.yaml").is_file() and card.view in VIEWS
    assert all(card.metrics[name]["ci95"] is not None for name in HEADLINES if card.metrics[name]["mean"] is not None)
    assert card.weaknesses and card.training["commit"] and weights.name.split("-")[0] in card.data["command"]
