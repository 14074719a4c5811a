"""`make bench`: speed and memory of the operators, of the backbones and of the whole network."""
