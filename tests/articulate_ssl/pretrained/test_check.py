"""Whether fresh numbers reproduce a card's, as far as chance lets them differ."""

import json
import math

import pytest
from packable import made_up_metrics, shipped_in, stand_in_generator, trained

from articulate_ssl.inference.checkpoint_file import CheckpointError
from articulate_ssl.pretrained import check as module
from articulate_ssl.pretrained.check import Comparison, check, compare, more_than_chance
from articulate_ssl.training.weights_card import HEADLINES


def test_equal_numbers_are_reproduced_and_much_worse_ones_are_not():
    card = made_up_metrics()
    assert [one.quantity for one in compare("laptop", card, card)] == list(HEADLINES)
    assert not any(one.worse for one in compare("laptop", card, card))
    worse = {one.quantity for one in compare("laptop", card, made_up_metrics(scale=3.0)) if one.worse}
    assert {"r_err_deg", "t_err", "seg_miou", "flip_rate"} <= worse
    assert not any(one.worse for one in compare("laptop", made_up_metrics(scale=3.0), card))


def test_what_chance_allows_are_both_intervals_together():
    def quantity(mean: float, low: float, high: float) -> dict:
        return {"mean": mean, "median": mean, "ci95": [low, high]}

    def allowed(name: str, card: dict, fresh: dict) -> float:
        other = made_up_metrics()
        found = compare("x", other | {name: card}, other | {name: fresh})
        return next(one.allowed for one in found if one.quantity == name)

    assert allowed("r_err_deg", quantity(10, 5, 13), quantity(14, 10, 30)) == pytest.approx(math.hypot(3, 4))
    assert allowed("seg_miou", quantity(0.8, 0.5, 0.9), quantity(0.7, 0.6, 1.1)) == pytest.approx(math.hypot(0.3, 0.4))
    # No flip at all has no interval; one in a hundred is no other result.
    assert allowed("flip_rate", quantity(0, 0, 0), quantity(0.009, 0.009, 0.009)) == 0.01
    assert allowed("t_err", quantity(1, 1, 1), {"mean": 2, "median": 2, "ci95": None}) == math.inf


def test_quantities_that_do_not_exist_are_not_compared():
    sliding = made_up_metrics() | {"pivot_err": {"mean": None, "median": None, "ci95": None}}
    assert "pivot_err" not in {one.quantity for one in compare("drawer", sliding, sliding)}


def test_a_few_numbers_are_worse_by_chance_and_many_are_not():
    good, bad = Comparison("a", "t_err", 1, 1, 0.1), Comparison("a", "t_err", 1, 2, 0.1)
    assert not more_than_chance([good] * 50 + [bad] * 2)
    assert more_than_chance([good] * 50 + [bad] * 6)


@pytest.fixture
def shipped(tmp_path):
    """Weights of a tiny module with a card."""
    return shipped_in(
        tmp_path, trained(tmp_path), "python -m render.generate --category laptop --seed 11 --train-instances 73"
    )


def test_weights_are_tested_on_data_of_another_seed_once(shipped, tmp_path, monkeypatch):
    made = stand_in_generator(monkeypatch)
    found = check(shipped, 12, tmp_path / "build", print)
    assert check(shipped, 12, tmp_path / "build", print) == found and len(made) == 1
    words = made[0]
    assert words[words.index("--seed") + 1] == "12" and words[words.index("--train-instances") + 1] == "32"
    written = json.loads((tmp_path / "build/laptop-complete-seed-12/metrics.json").read_text())
    assert found[0].fresh == written["r_err_deg"]["mean"] and found[0].card == made_up_metrics()["r_err_deg"]["mean"]
    assert written["samples"] == 16


def test_the_seed_of_the_card_is_no_fresh_one(shipped, tmp_path):
    with pytest.raises(CheckpointError, match="seed 11 is that of the data behind laptop-complete"):
        check(shipped, 11, tmp_path, print)


def test_data_that_cannot_be_made_name_their_log(shipped, tmp_path, monkeypatch):
    monkeypatch.setattr(module.subprocess, "run", lambda *_, **__: type("Done", (), {"returncode": 3}))
    with pytest.raises(CheckpointError, match=r"exit code 3.*data\.log says why"):
        check(shipped, 12, tmp_path, print)
