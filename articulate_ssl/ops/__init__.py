"""Fast group-equivariant operators; `ops.reference` holds their readable twins."""

import torch

# Soft correspondences of far points are denormal numbers, which make a CPU's matrix products several times slower.
torch.set_flush_denormal(True)
