"""Parameters of a model that are drawn anew for every episode: each from its range, or many together from samples.

In a model YAML:
    randomise:
      ball.paddle.restitution: [0.8, 0.95]    uniform between the ends
      samples: posterior.csv                  rows of parameters that belong together

Samples keep what a fit knows of several parameters at once: that restitution and height are each uncertain, and their
sum is not. The file has a column for each parameter, named by its dotted path, and if rows are not equally likely a
column ``weight``; in place of the file's name its content may stand, a list for each column.
"""

from __future__ import annotations

import csv
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Key

SAMPLES, WEIGHT = "samples", "weight"
Number: TypeAlias = Callable[[Any, str, str], float]  # (value, where, dotted path) -> the number, or ValueError


@partial(jax.tree_util.register_dataclass, data_fields=[], meta_fields=["path", "low", "high"])
@dataclass(frozen=True)
class Range:
    """A parameter that is drawn uniformly per episode, by its dotted path in SimModel."""

    path: str
    low: float
    high: float

    @property
    def paths(self) -> tuple[str, ...]:
        """The parameter's dotted path."""
        return (self.path,)

    def ends(self) -> dict[str, list[float]]:
        """Ends of the range by path."""
        return {self.path: [self.low, self.high]}

    def at(self, uniform: Float[Array, "*batch"]) -> dict[str, Array]:
        """The value for numbers drawn uniformly from [0, 1)."""
        return {self.path: self.low + (self.high - self.low) * uniform}

    def drawn(self, key: Key[Array, ""], shape: tuple[int, ...]) -> dict[str, Array]:
        """Values of a batch of ``shape`` episodes."""
        return {self.path: jax.random.uniform(key, shape, minval=self.low, maxval=self.high)}


@partial(jax.tree_util.register_dataclass, data_fields=["values", "share"], meta_fields=["paths"])
@dataclass(frozen=True, eq=False)
class Rows:
    """Samples as arrays that a program takes: compiled once, it serves all samples of these parameters."""

    paths: tuple[str, ...]
    values: Float[Array | np.ndarray, "P S"]
    share: Float[Array | np.ndarray, " S"]  # of the weight in the rows up to each

    def at(self, uniform: Float[Array, "*batch"]) -> dict[str, Array]:
        """The rows for numbers drawn uniformly from [0, 1)."""
        row = jnp.minimum(jnp.searchsorted(self.share, uniform, side="right"), self.share.shape[0] - 1)
        return {path: jnp.asarray(self.values)[i, row] for i, path in enumerate(self.paths)}

    def drawn(self, key: Key[Array, ""], shape: tuple[int, ...]) -> dict[str, Array]:
        """Values of a batch of ``shape`` episodes."""
        return self.at(jax.random.uniform(key, shape))


@dataclass(frozen=True, eq=False)
class Samples:
    """Parameters that are drawn together, a row for each episode; rows in proportion to their weight."""

    paths: tuple[str, ...]
    values: Float[np.ndarray, "S P"]
    weight: Float[np.ndarray, " S"]

    def ends(self) -> dict[str, list[float]]:
        """Between which values 90 % of each parameter's weight lies."""
        out = {}
        for path, column in zip(self.paths, self.values.T, strict=True):
            order = np.argsort(column)
            share = np.cumsum(self.weight[order]) / self.weight.sum()
            rows = np.minimum(np.searchsorted(share, [0.05, 0.95]), len(order) - 1)
            out[path] = [float(column[order[i]]) for i in rows]
        return out

    def at(self, uniform: Float[Array, "*batch"]) -> dict[str, Array]:
        """The rows for numbers drawn uniformly from [0, 1)."""
        return self.rows().at(uniform)

    def drawn(self, key: Key[Array, ""], shape: tuple[int, ...]) -> dict[str, Array]:
        """Values of a batch of ``shape`` episodes."""
        return self.rows().drawn(key, shape)

    def rows(self) -> Rows:
        """These samples as arrays of a program."""
        share = np.cumsum(self.weight) / self.weight.sum()
        return Rows(self.paths, self.values.T.astype(np.float32), share.astype(np.float32))

    def columns(self) -> dict[str, list[float]]:
        """Plain data: a list for each parameter, and the weights where they differ."""
        out = {p: [float(f"{v:.7g}") for v in column] for p, column in zip(self.paths, self.values.T, strict=True)}
        if np.ptp(self.weight) > 0.0:
            out[WEIGHT] = [float(f"{w:.7g}") for w in self.weight]
        return out


Randomised: TypeAlias = Range | Samples
Drawing: TypeAlias = Range | Rows


def drawn(key: Key[Array, ""], randomise: Sequence[Randomised | Drawing], shape: tuple[int, ...]) -> dict[str, Array]:
    """Values by dotted path for a batch of ``shape`` episodes."""
    keys = jax.random.split(key, max(len(randomise), 1))  # one is left over where nothing is randomised
    values: dict[str, Array] = {}
    for one, own in zip(randomise, keys, strict=False):
        values |= one.drawn(own, shape)
    return values


def ends(randomise: Sequence[Randomised]) -> dict[str, list[float]]:
    """Between which values each parameter is drawn, by dotted path; of samples 90 %."""
    return {path: pair for one in randomise for path, pair in one.ends().items()}


def to_dict(randomise: Sequence[Randomised]) -> dict[str, Any]:
    """Plain data as it stands in a model YAML."""
    out: dict[str, Any] = {}
    for one in randomise:
        out |= {SAMPLES: one.columns()} if isinstance(one, Samples) else one.ends()
    return out


def parse(data: Mapping[Any, Any], where: str, parameter: Callable[[Any, str], str], number: Number) -> tuple:
    """Ranges and samples of a mapping ``randomise``. Raises ValueError naming ``where`` and the key.

    parameter: (path, where) -> the dotted path of a number of the model, or ValueError. Samples stand as content.
    """
    parsed: list[Randomised] = []
    for path, given in data.items():
        if path == SAMPLES:
            parsed.append(_samples(given, f"{where}.{SAMPLES}", parameter, number))
            continue
        parameter(path, f"{where}.{path}")
        if not isinstance(given, list | tuple) or len(given) != 2:
            raise ValueError(f"{where}.{path} = {given!r}, a range is [low, high]")
        low, high = (number(end, f"{where}.{path}", path) for end in given)
        if low > high:
            raise ValueError(f"{where}.{path} = {given!r}, low must not exceed high")
        parsed.append(Range(path, low, high))
    paths = [path for one in parsed for path in one.paths]
    twice = {path for path in paths if paths.count(path) > 1}
    if twice:
        raise ValueError(f"{where}: {', '.join(sorted(twice))} is drawn twice, by its range and by the samples")
    return tuple(parsed)


def _samples(given: Any, where: str, parameter: Callable[[Any, str], str], number: Number) -> Samples:
    if not isinstance(given, dict) or not all(isinstance(column, list) for column in given.values()):
        raise ValueError(f"{where} = {str(given)[:80]!r}, the name of a CSV or a list for each parameter is needed")
    columns = dict(given)
    weight = columns.pop(WEIGHT, None)
    if not columns:
        raise ValueError(f"{where}: no parameter is in it")
    rows = {len(column) for column in (*columns.values(), *([] if weight is None else [weight]))}
    if len(rows) > 1 or rows == {0}:
        raise ValueError(f"{where}: the lists have {sorted(rows)} numbers, all must have as many, and one at least")
    values = []
    for path, column in columns.items():
        parameter(path, f"{where}.{path}")
        values.append([number(value, f"{where}.{path}[{i}]", path) for i, value in enumerate(column)])
    count = rows.pop()
    weights = np.ones(count) if weight is None else _weights(weight, f"{where}.{WEIGHT}")
    return Samples(tuple(columns), np.array(values, float).T, weights)


def _weights(given: list, where: str) -> Float[np.ndarray, " S"]:
    for i, value in enumerate(given):
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 <= value < float("inf"):
            raise ValueError(f"{where}[{i}] = {value!r}, a number of at least 0 is needed")
    if not sum(given) > 0.0:
        raise ValueError(f"{where}: all weights are 0")
    return np.array(given, float)


def with_content(data: Any, folder: str | os.PathLike) -> Any:
    """A model's plain data with the content of its samples' file in place of the name, relative to ``folder``.

    Raises ValueError naming file, row and column at fault, OSError where the file cannot be opened.
    """
    ranges = data.get("randomise") if isinstance(data, dict) else None
    if not isinstance(ranges, dict) or not isinstance(ranges.get(SAMPLES), str):
        return data
    return data | {"randomise": ranges | {SAMPLES: read_columns(Path(folder) / ranges[SAMPLES])}}


def read_columns(path: str | os.PathLike) -> dict[str, list[float]]:
    """Columns of a CSV by their header. Raises ValueError naming the file, the row (the header is 1) and column."""
    with open(path, newline="", encoding="utf-8-sig") as file:
        try:
            header, *rows = list(csv.reader(file)) or [[]]
        except (csv.Error, UnicodeDecodeError) as error:
            raise ValueError(f"{path}: not readable as CSV in UTF-8: {error}") from None
    names = [name.strip() for name in header]
    if not rows or len(set(names)) != len(names):
        raise ValueError(f"{path}: needs a header of different names and a row of numbers at least")
    columns: dict[str, list[float]] = {name: [] for name in names}
    for i, row in enumerate(rows, 2):
        if len(row) != len(names):
            raise ValueError(f"{path}: row {i}: {len(row)} columns, the header has {len(names)}")
        for name, text in zip(names, row, strict=True):
            try:
                columns[name].append(float(text))
            except ValueError:
                raise ValueError(f"{path}: row {i}: {name} = {text!r} is not a number") from None
    return columns
