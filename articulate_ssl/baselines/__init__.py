"""Methods to compare with, scored by the same metrics on the same clouds.

A method is a `Method` (`method.py`) and one line of `METHODS`. `python -m articulate_ssl.baselines NAME --category …`
trains and tests it (`runner.py`); nothing else has to know of it. `perfect_oracle.py` is the ground truth, said as a
prediction.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from articulate_ssl.baselines.method import Method

# Module and class; modules are imported only to be used, because some need large libraries. Supervised first.
METHODS = {
    "npcs_epn": ("npcs", "NPCSEPN"),
    "npcs_kpconv": ("npcs", "NPCSKPConv"),
    "oracle_icp": ("oracle_icp", "OracleICP"),
    "oracle_epn": ("oracle_epn", "OracleEPN"),
    "epn_whole": ("epn_whole", "EPNWhole"),
    "bae_net": ("bae_net", "BAENet"),
    "nsd": ("nsd", "NSD"),
    "bsp_net": ("bsp_net", "BSPNet"),
    "op_align": ("op_align.method", "OPAlign"),
}


def method_class(name: str) -> type[Method]:
    """The method of that name.

    Raises:
        ValueError: if there is none.
    """
    if name not in METHODS:
        raise ValueError(f"method must be one of {', '.join(METHODS)}, got {name!r}")
    module, attribute = METHODS[name]
    return getattr(import_module(f"{__name__}.{module}"), attribute)
