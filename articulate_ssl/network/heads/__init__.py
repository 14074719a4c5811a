"""One file per group of quantities of the paper: canonical shape, structure (chain, pivots, axes), pose."""
