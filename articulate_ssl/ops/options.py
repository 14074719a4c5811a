"""What options must at least be, in one place for all that have some."""

from __future__ import annotations

from typing import Any


def require_at_least(options: Any, prefix: str = "", **least: float) -> None:
    """Refuse what is less.

    Args:
        options: Holds the options as attributes: numbers, or lists of them that hold at least one.
        prefix: Of their names, as a command line has them: `network.`.
        least: By the option's name; the numbers of a list must each be as large.

    Raises:
        ValueError: naming the option, its value and what it must at least be.
    """
    for name, bound in least.items():
        value = getattr(options, name)
        numbers = value if isinstance(value, list | tuple) else [value]
        if not numbers or not all(number >= bound for number in numbers):
            each = "have one value or more, each at least" if numbers is value else "be at least"
            raise ValueError(f"{prefix}{name} is {value}, must {each} {bound:g}")
