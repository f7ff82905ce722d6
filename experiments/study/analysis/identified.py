"""Worlds that a study identified, parameter by parameter, beside the reality once it is opened."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mjx_tt.sim import model as models
from mjx_tt.sim.model import ModelFile


def estimates(world: ModelFile, truth: Mapping[str, float] | None = None) -> list[dict[str, Any]]:
    """A row for each parameter that the world moved or draws: its value, 90 % of what is drawn, and the truth if known.

    truth: values that differ from the nominal model, by dotted path.
    """
    nominal, values = models.paths(), models.paths(world.model)
    drawn = {path: ends for one in world.randomise for path, ends in one.ends().items()}
    rows = []
    for path, value in values.items():
        low, high = drawn.get(path, (value, value))
        if low == high == nominal[path] and (truth is None or path not in truth):
            continue
        row: dict[str, Any] = {"parameter": path, "believed": nominal[path], "low": low, "high": high}
        if truth is not None:
            row["truth"] = truth.get(path, nominal[path])
        rows.append(row)
    return rows
