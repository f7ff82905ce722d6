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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, PRNGKeyArray
from pydantic import AfterValidator
from typing_extensions import TypedDict

from ballmodel.io.ranges import Within
from ballmodel.io.validation import Increasing

SAMPLES, WEIGHT = "samples", "weight"


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

    def drawn(self, key: PRNGKeyArray, shape: tuple[int, ...]) -> dict[str, Array]:
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

    def drawn(self, key: PRNGKeyArray, shape: tuple[int, ...]) -> dict[str, Array]:
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


def drawn(key: PRNGKeyArray, randomise: Sequence[Randomised | Drawing], shape: tuple[int, ...]) -> dict[str, Array]:
    """Values by dotted path for a batch of ``shape`` episodes."""
    keys = jax.random.split(key, max(len(randomise), 1))  # one is left over where nothing is randomised
    values: dict[str, Array] = {}
    for one, its_key in zip(randomise, keys, strict=False):
        values |= (one.rows() if isinstance(one, Samples) else one).drawn(its_key, shape)
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


def parse(content: Mapping[str, Any]) -> tuple[Randomised, ...]:
    """Ranges and samples of a mapping ``randomise``, valid by ``file_type``."""
    parsed: list[Randomised] = []
    for path, given in content.items():
        if path == SAMPLES:
            columns = {name: column for name, column in given.items() if name != WEIGHT}
            values = np.array(list(columns.values()), float).T
            parsed.append(Samples(tuple(columns), values, np.array(given.get(WEIGHT, np.ones(len(values))), float)))
        else:
            parsed.append(Range(path, *given))
    return tuple(parsed)


def file_type(numbers: Mapping[str, Within]) -> Any:
    """Type of ``randomise`` in a YAML, by what is allowed for each number of the model; samples stand as content."""
    ends = {path: Annotated[float, note] for path, note in numbers.items()}
    columns = {path: list[end] for path, end in ends.items()} | {WEIGHT: list[Annotated[float, Within(0.0)]]}  # type: ignore[valid-type]
    samples = TypedDict("samples", columns, total=False)  # type: ignore[misc]
    ranges = {path: Annotated[tuple[end, end], Increasing] for path, end in ends.items()}  # type: ignore[valid-type]
    keys = ranges | {SAMPLES: Annotated[samples, AfterValidator(_check_samples)]}
    return Annotated[TypedDict("randomise", keys, total=False), AfterValidator(_check_once)]  # type: ignore[operator]


def _check_samples(columns: dict[str, list[float]]) -> dict[str, list[float]]:
    """Raises ValueError for lists that are no table of samples."""
    if not set(columns) - {WEIGHT}:
        raise ValueError("expected a list for a parameter at least, got none")
    counts = sorted({len(column) for column in columns.values()})
    if len(counts) > 1 or counts == [0]:
        raise ValueError(f"expected lists of one length and not empty, got {counts} numbers")
    if WEIGHT in columns and not sum(columns[WEIGHT]) > 0.0:
        raise ValueError(f"{WEIGHT}: expected a weight above 0, got none")
    return columns


def _check_once(content: dict[str, Any]) -> dict[str, Any]:
    """Raises ValueError for a parameter that has a range and samples."""
    if twice := sorted(set(content.get(SAMPLES, ())) & set(content)):
        raise ValueError(f"{', '.join(twice)}: expected a range or samples, got both")
    return content


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
