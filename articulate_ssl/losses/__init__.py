"""Self-supervised objectives: reconstruction (min over the group) and joint regularization."""
