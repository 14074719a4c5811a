"""Tiny articulated objects for the tests."""

from __future__ import annotations

from math import pi

import numpy as np
import trimesh

from articulate_ssl.geometry.screw import PRISMATIC, REVOLUTE
from render.articulated_object import ArticulatedObject, Joint


def box(lower, upper) -> trimesh.Trimesh:
    """An axis-aligned box."""
    return trimesh.creation.box(bounds=[lower, upper])


def box_laptop() -> ArticulatedObject:
    """A closed laptop of two boxes, 0.3 wide and 0.2 deep, each 0.02 thick, 0.001 apart."""
    return ArticulatedObject(
        name="box",
        category="laptop",
        part_names=("base", "lid"),
        meshes=(box([-0.15, 0, -0.1], [0.15, 0.02, 0.1]), box([-0.15, 0.021, -0.1], [0.15, 0.041, 0.1])),
        joints=(
            Joint(
                name="hinge",
                type=REVOLUTE,
                parent=0,
                child=1,
                axis=np.array([-1.0, 0, 0]),
                pivot=np.array([0, 0.0205, -0.1]),
                lower=0.0,
                upper=pi,
            ),
        ),
    ).validate()


def box_chain() -> ArticulatedObject:
    """Three boxes in a row: a cabinet, a drawer that slides out of it, and a flap that swings on the drawer."""
    return ArticulatedObject(
        name="chain",
        category="articulated",
        part_names=("cabinet", "drawer", "flap"),
        meshes=(
            box([-0.2, 0, -0.2], [0.2, 0.3, 0.2]),
            box([-0.15, 0.1, 0.21], [0.15, 0.2, 0.3]),
            box([-0.15, 0.1, 0.31], [0.15, 0.2, 0.33]),
        ),
        joints=(
            Joint("slide", PRISMATIC, 0, 1, np.array([0, 0, 1.0]), np.array([0, 0.15, 0.25]), 0.0, 0.4, 0.1),
            Joint("swing", REVOLUTE, 1, 2, np.array([0, 1.0, 0]), np.array([-0.15, 0.15, 0.32]), -1.5, 0.5, 0.2),
        ),
    ).validate()
