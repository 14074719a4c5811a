"""Progress of what Lightning's own bar does not cover: part discovery, calibration, learning of confidence."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from threading import Event, Thread

from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback, RichProgressBar
from rich.progress import Progress

from articulate_ssl.ops.progress import Listener, listening

_TICK = 1.0  # seconds; Lightning's display shows anything new, time included, only when told to


class ShowProgress(Callback):
    """Shows announced work beside Lightning's bar, in lines where the output is no terminal."""

    def __init__(self) -> None:
        self._open = ExitStack()

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Begin to listen, on the first process."""
        if trainer.is_global_zero:
            listener = Listener(lambda: _display(trainer))
            self._open.enter_context(listening(listener))
            self._open.enter_context(_ticking(trainer, listener))

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """End."""
        self._open.close()

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """End: Lightning calls no `teardown` then."""
        self._open.close()


@contextmanager
def _ticking(trainer: Trainer, listener: Listener) -> Iterator[None]:
    """Within the block, the display is drawn again every second while something is shown on it."""
    stopped = Event()

    def tick() -> None:
        while not stopped.wait(_TICK):
            display = _display(trainer)
            if listener.working and display is not None:
                display.refresh()

    thread = Thread(target=tick, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stopped.set()
        thread.join()


def _display(trainer: Trainer) -> Progress | None:
    bar = trainer.progress_bar_callback
    if not isinstance(bar, RichProgressBar) or bar.is_disabled or bar.progress is None:
        return None
    return bar.progress if bar.progress.console.is_terminal else None
