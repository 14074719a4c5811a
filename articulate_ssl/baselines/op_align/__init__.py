"""OP-Align (Che, Furukawa, Kanezaki, ECCV 2024) on our backbone and data."""

from articulate_ssl.baselines.op_align.method import OPAlign

__all__ = ["OPAlign"]
