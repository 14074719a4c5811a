"""Weights by name: `from_pretrained`, `save_pretrained` and `push_to_hub`, by huggingface_hub's mixin."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from huggingface_hub import ModelCard, ModelHubMixin
from typing_extensions import Self

from articulate_ssl.training.shipped_weights import MODEL_FILE, find_weights
from articulate_ssl.training.weights_card import CARD_SUFFIX, WeightsCard, hub_card
from articulate_ssl.training.weights_file import write_weights


class HubWeights(ModelHubMixin, library_name="articulate-ssl", license="apache-2.0"):
    """What a module inherits to be saved and found by name.

    Attributes:
        card: How the weights were made and what they are worth; None where nobody has written it down.
    """

    card: WeightsCard | None = None

    @classmethod
    def from_pretrained(
        cls,
        pretrained_model_name_or_path: str | os.PathLike,
        *,
        view: str | None = None,
        **hub: Any,  # revision, token, cache_dir, local_files_only, force_download
    ) -> Self:
        """The module of shipped weights ("laptop", "laptop-depth"), of a file, of a folder, or from the hub.

        A shipped name, a file and a folder are read without touching the network (`shipped_weights.find_weights`).

        Args:
            view: `complete` or `depth`, of a shipped category; None takes `complete` if it is shipped.

        Raises:
            CheckpointError: if there are no such weights, the hub cannot be reached, or the file is no weights of ours.
        """
        return cls._from_pretrained(model_id=str(pretrained_model_name_or_path), view=view, **hub)

    @classmethod
    def _from_pretrained(cls, *, model_id: str, view: str | None = None, **hub: Any) -> Self:
        # Here, because that module imports the class that inherits this.
        from articulate_ssl.training.checkpoint import load_module

        file = find_weights(model_id, view, **hub)
        module = load_module(file)
        card = file.with_suffix(CARD_SUFFIX)
        module.card = WeightsCard.load(card) if card.is_file() else None
        return module

    def _save_pretrained(self, save_directory: Path) -> None:
        write_weights(self, save_directory / MODEL_FILE)
        if self.card is not None:
            self.card.save((save_directory / MODEL_FILE).with_suffix(CARD_SUFFIX))

    def generate_model_card(self, *_args: Any, **_kwargs: Any) -> ModelCard:
        """README.md of the hub: the card of the weights where there is one."""
        return ModelCard(hub_card(self.category, self.card))
