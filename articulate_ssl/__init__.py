"""Self-supervised category-level articulated object pose estimation with part-level SE(3) equivariance."""

__version__ = "0.1.0"
