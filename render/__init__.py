"""Articulated objects, their posing and rendering, and the generator behind `make data`."""
