"""The networks: equivariant backbone, part proposal, SO(3)-PointNet, heads, rigid alignment, articulated network."""
