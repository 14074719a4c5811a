"""Recipes: ways to train the networks, one file with a class `TrainingRecipe` each; configurations name the file."""

from __future__ import annotations

from importlib import import_module
from pkgutil import iter_modules

from articulate_ssl.training.recipes.recipe import Recipe

RECIPES = tuple(sorted({module.name for module in iter_modules(__path__)} - {"recipe"}))


def recipe_class(name: str) -> type[Recipe]:
    """The recipe of that name.

    Raises:
        ValueError: if there is none.
    """
    if name not in RECIPES:
        raise ValueError(f"recipe must be one of {RECIPES}, got {name!r}")
    return import_module(f"{__name__}.{name}").TrainingRecipe
