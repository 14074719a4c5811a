"""The networks: equivariant backbone, part proposal, SO(3)-PointNet, heads, articulated network, rigid alignment."""
