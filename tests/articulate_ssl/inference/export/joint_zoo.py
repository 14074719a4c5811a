"""Predictions whose joints catch what an exporter can get wrong: signs, oblique axes, order and numbering."""

import synthetic_predictions as synthetic

from articulate_ssl.geometry.screw import PRISMATIC, REVOLUTE


def star(seed=0):
    """Three parts on part 2: the root is not the first part, and axes are oblique with negative components."""
    boxes = [
        ((0.3, 0.2, 0.05), (0.3, 0.1, 0.1)),
        ((0.1, 0.3, 0.2), (-0.3, 0.0, 0.1)),
        ((0.4, 0.4, 0.3), (0, 0, 0)),
        ((0.2, 0.1, 0.2), (0.0, 0.35, 0.0)),
    ]
    joints = [
        (REVOLUTE, 2, 0, (-1 / 3, 2 / 3, -2 / 3), (0.2, 0.1, 0.1)),
        (PRISMATIC, 2, 1, (-2 / 3, -1 / 3, 2 / 3), (-0.25, 0.05, 0.1)),
        (REVOLUTE, 2, 3, (-1.0, 0, 0), (0.0, 0.3, -0.1)),
    ]
    return synthetic.chain_of_boxes(boxes, joints, [0.2, -0.05, 0.1], seed=seed)


def snake(seed=0):
    """A serial chain 3 - 1 - 0 - 2 whose joints are listed from its tip, with turned axes after turning joints."""
    boxes = [
        ((0.3, 0.1, 0.08), (0.6, 0, 0)),
        ((0.3, 0.1, 0.1), (0.3, 0, 0)),
        ((0.2, 0.06, 0.06), (0.9, 0, 0)),
        ((0.4, 0.2, 0.2), (0, 0, 0)),
    ]
    joints = [
        (REVOLUTE, 0, 2, (2 / 3, -2 / 3, -1 / 3), (0.8, 0, 0.02)),
        (PRISMATIC, 1, 0, (-0.8, 0, -0.6), (0.45, 0, 0)),
        (REVOLUTE, 3, 1, (0, -0.6, 0.8), (0.2, 0.02, 0)),
    ]
    return synthetic.chain_of_boxes(boxes, joints, [-0.08, 0.1, 0.25], seed=seed)


ZOO = [synthetic.laptop, synthetic.drawer, synthetic.arm, star, snake]
