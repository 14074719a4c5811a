"""README's tables are what the cards of the shipped weights say."""

from pathlib import Path

import pytest

from articulate_ssl.cli import main
from articulate_ssl.pretrained.markdown_table import MARK, as_markdown
from articulate_ssl.training.shipped_weights import shipped_weights
from articulate_ssl.training.weights_card import CARD_SUFFIX, WeightsCard

README = Path(__file__).parents[3] / "README.md"


def _cards() -> list[WeightsCard]:
    return [WeightsCard.load(weights.file.with_suffix(CARD_SUFFIX)) for weights in shipped_weights()]


@pytest.mark.parametrize("view", ["complete", "depth"])
def test_readme_has_the_table_that_the_command_prints(view, capsys):
    assert main(["weights", "list", "--markdown", view]) == 0
    table = capsys.readouterr().out
    assert table.count("\n") == 2 + sum(card.view == view for card in _cards())
    assert f"\n{table}" in README.read_text(), f"put in README what `weights list --markdown {view}` prints"


def test_a_row_says_what_its_card_says():
    (card,) = [card for card in _cards() if (card.category, card.view) == ("drawer", "complete")]
    row = as_markdown([card], "complete").splitlines()[2]
    r_err, state = card.metrics["r_err_deg"], card.metrics["state_err"]
    assert row.startswith(f"| drawer {MARK} | {r_err['mean']:.1f} ({r_err['ci95'][0]:.1f}–")
    assert f"median {r_err['median']:.1f}" in row and f"| – | {state['mean']:.3f} |" in row
    assert "3.2 / 3.2 / 3.2 / 3.2; 39; 51" in row  # the paper's
    assert as_markdown([card], "depth").count("\n") == 2
