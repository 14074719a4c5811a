"""Methods to compare with, scored by the same metrics."""
