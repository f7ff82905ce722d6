"""The simulation's clearances from the gate's geometry: the table without the space under it."""

import numpy as np

from ballmodel.contact import TABLE
from robot_io.safety.capsules import measure_all


def clearances(geometry, q):
    """Smallest gaps [m] to the table, of pairs, and of the blade to the table, each (B,), at positions q (n, B)."""
    watched, first, second, radius, _, floor = geometry._watch
    top = np.stack([np.subtract(TABLE.centre, TABLE.half), np.add(TABLE.centre, TABLE.half)])
    gaps = measure_all(geometry.ends(q), (watched, first, second, radius, top, floor))
    table, own = gaps[: len(watched)], gaps[len(watched) : -len(watched)]
    return {"table": table.min(0), "own": own.min(0, initial=np.inf), "blade": table[geometry._blade_rows].min(0)}
