"""Every physical, sensing and actuation parameter of the simulation in one pytree.

A diagnosis extends it, training consumes it. Fields are scalars, or arrays of the episodes' batch shape when
``randomise`` has drawn them per episode. The robot's rigid-body constants are the MJCF's and live in ``chain.Chain``.

YAML: the tree of field names, all of them optional, plus
    randomise: {"ball.table.restitution": [0.85, 0.95], ...}   drawn anew for every episode (``randomisation``); a
               range of a drive, "drives.joint_2.lag", gives the model drives
    provenance: {...}                                          free text, kept as it is
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import os
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import yaml
from jax import Array
from jaxtyping import Float, Key

from ballmodel.aerodynamics import INTEGRATORS
from ballmodel.flight import BallParams, ball_params
from ballmodel.io import yaml as yaml_file
from ballmodel.io.atomic_files import replacing
from mjx_tt.sim import bounds, randomisation
from mjx_tt.sim.actuators import drive_params
from mjx_tt.sim.randomisation import Drawing, Randomised
from mjx_tt.sim.randomisation import Range as Range
from mjx_tt.sim.randomisation import Samples as Samples
from mjx_tt.sim.sensors import SensingParams as SensingParams
from robot_io.contract import JOINT_NAMES


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class LatencyParams:
    """Gaussian delays, drawn per episode [s]. Means and deviations: the paper's table of sensor latencies.

    The table heads its second column sigma^2 with unit ms; 8.2 ms is a plausible deviation and 2.9 ms (its root) is not
    meant: a variance would have unit ms^2.
    """

    ball_observation: Float[Array, "*#batch"] | float = 0.040
    ball_observation_std: Float[Array, "*#batch"] | float = 0.0082
    abb_observation: Float[Array, "*#batch"] | float = 0.029
    abb_observation_std: Float[Array, "*#batch"] | float = 0.0082
    festo_observation: Float[Array, "*#batch"] | float = 0.033
    festo_observation_std: Float[Array, "*#batch"] | float = 0.009
    abb_action: Float[Array, "*#batch"] | float = 0.071
    abb_action_std: Float[Array, "*#batch"] | float = 0.0057
    festo_action: Float[Array, "*#batch"] | float = 0.0645
    festo_action_std: Float[Array, "*#batch"] | float = 0.0115


LATENCIES = ("ball_observation", "abb_observation", "festo_observation", "abb_action", "festo_action")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ActuationParams:
    """All drives alike: gain of the velocity command before the servo of the MJCF follows it."""

    velocity_gain: Float[Array, "*#batch"] | float = 1.0  # reached over commanded velocity


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class BallSpinParams:
    """Spin of the incoming balls at their start [rad/s], Gaussian and drawn per episode.

    The pool of balls is chosen without spin: those that spin much need not land where their distribution says.
    """

    mean_x: Float[Array, "*#batch"] | float = 0.0
    mean_y: Float[Array, "*#batch"] | float = 0.0
    mean_z: Float[Array, "*#batch"] | float = 0.0
    std_x: Float[Array, "*#batch"] | float = 0.0
    std_y: Float[Array, "*#batch"] | float = 0.0
    std_z: Float[Array, "*#batch"] | float = 0.0


def _ball() -> BallParams:
    # The paper's first-order step at 300 Hz moves landing points by up to 1.5 mm when halved; this one by 0.01 mm.
    ball = ball_params()
    return dataclasses.replace(ball, flight=dataclasses.replace(ball.flight, integrator="midpoint"))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SimModel:
    """The simulation's parameters; the paper's drag-only ball, integrated to second order.

    ``drives`` None is the nominal robot; its paths, such as drives.joint_2.lag, exist all the same. ``joints`` are
    those that have drives, by default the paper's robot's.
    """

    ball: BallParams = field(default_factory=_ball)
    ball_spin: BallSpinParams = field(default_factory=BallSpinParams)
    latency: LatencyParams = field(default_factory=LatencyParams)
    sensing: SensingParams = field(default_factory=SensingParams)
    actuation: ActuationParams = field(default_factory=ActuationParams)
    drives: Any | None = None  # as ``actuators.drive_params`` of the joints makes them
    joints: tuple[str, ...] = field(default=JOINT_NAMES, metadata={"static": True, "parameter": False})


class _Dumper(yaml.SafeDumper):
    """Lists of numbers along the line, mappings one below the other."""


_Dumper.add_representer(list, lambda dumper, data: dumper.represent_sequence("tag:yaml.org,2002:seq", data, True))


@dataclass(frozen=True)
class ModelFile:
    """Content of a model YAML."""

    model: SimModel
    randomise: tuple[Randomised, ...] = ()
    provenance: dict = field(default_factory=dict)

    @classmethod
    def load(cls, path: str | os.PathLike, nominal: SimModel | None = None) -> ModelFile:
        """Reads a model YAML; ``nominal``, by default the paper's robot's, has what it leaves out.

        Raises ValueError naming file, key, what was given and what is allowed.
        """
        data = randomisation.with_content(yaml_file.read(path), Path(path).parent)
        return from_dict(data or {}, str(path), nominal)

    def save(self, path: str | os.PathLike) -> None:
        """Writes parameters, ranges and provenance, whole or not at all. Drives only if the model has them."""
        tree: dict = {}
        for name, value in paths(self.model).items():
            if name.startswith("drives.") and self.model.drives is None:
                continue
            *groups, leaf = name.split(".")
            node = tree
            for group in groups:
                node = node.setdefault(group, {})
            node[leaf] = value if isinstance(value, str) else float(value)
        tree["randomise"] = randomisation.to_dict(self.randomise)
        tree["provenance"] = self.provenance
        with replacing(Path(path)) as temporary:
            temporary.write_text(yaml.dump(tree, Dumper=_Dumper, sort_keys=False, width=120), encoding="utf-8")


def paths(node: Any = None, prefix: str = "") -> dict[str, Any]:
    """Every leaf of a SimModel by its dotted path; of the nominal model by default. Absent drives are nominal ones."""
    node = SimModel() if node is None else node
    if isinstance(node, SimModel) and node.drives is None:
        node = dataclasses.replace(node, drives=drive_params(node.joints)())
    leaves: dict[str, Any] = {}
    for f in _parameters(node):
        value = getattr(node, f.name)
        if dataclasses.is_dataclass(value):
            leaves |= paths(value, f"{prefix}{f.name}.")
        else:
            leaves[prefix + f.name] = value
    return leaves


def with_values(model: SimModel, values: Mapping[str, Any]) -> SimModel:
    """The model with the leaves at the given dotted paths replaced; a path of the drives gives it drives.

    Raises ValueError for a path that does not exist.
    """
    known = paths(SimModel(joints=model.joints))
    for path in values:
        if path not in known:
            raise ValueError(f"unknown parameter {path!r}{nearest(path, known)}")
    if model.drives is None and any(path.startswith("drives.") for path in values):
        model = dataclasses.replace(model, drives=drive_params(model.joints)())
    return _with_values(model, values)


def _parameters(node: Any) -> list[dataclasses.Field]:
    """The fields that hold parameters or groups of them."""
    return [f for f in dataclasses.fields(node) if f.metadata.get("parameter", True)]


def _with_values(node: Any, values: Mapping[str, Any]) -> Any:
    changed = {}
    for f in _parameters(node):
        inner = {k.removeprefix(f.name + "."): v for k, v in values.items() if k.startswith(f.name + ".")}
        if inner:
            changed[f.name] = _with_values(getattr(node, f.name), inner)
        elif f.name in values:
            changed[f.name] = values[f.name]
    return dataclasses.replace(node, **changed)


def draw(
    key: Key[Array, ""], model: SimModel, randomise: tuple[Randomised | Drawing, ...], shape: tuple[int, ...]
) -> SimModel:
    """The model with all that is randomised drawn for a batch of ``shape`` episodes."""
    return with_values(model, randomisation.drawn(key, randomise, shape))


def draw_latencies(
    key: Key[Array, ""], latency: LatencyParams, shape: tuple[int, ...], longest: Float[Array, "5 *#batch"] | float
) -> Float[Array, "5 *batch"]:
    """Delays (5, *shape) [s] in the order of ``LATENCIES``, kept within [0, longest]."""
    mean = jnp.stack([jnp.broadcast_to(getattr(latency, n), shape) for n in LATENCIES])
    std = jnp.stack([jnp.broadcast_to(getattr(latency, f"{n}_std"), shape) for n in LATENCIES])
    return jnp.clip(mean + std * jax.random.normal(key, mean.shape), 0.0, longest)


def draw_spin(key: Key[Array, ""], spin: BallSpinParams, shape: tuple[int, ...]) -> Float[Array, "3 *batch"] | None:
    """Spin (3, *shape) [rad/s] of incoming balls; None where no ball spins, so that nothing is added."""
    values = dataclasses.astuple(spin)
    if all(isinstance(value, int | float) and value == 0.0 for value in values):
        return None
    mean, std = (jnp.stack([jnp.broadcast_to(v, shape) for v in part]) for part in (values[:3], values[3:]))
    return mean + std * jax.random.normal(key, mean.shape)


def nearest(name: str, known: Collection[str]) -> str:
    """', did you mean ...?' or the list of valid names."""
    close = difflib.get_close_matches(name, list(known), 1)
    return f"; did you mean {close[0]!r}?" if close else f"; known are {', '.join(sorted(known))}"


def from_dict(data: Any, where: str, nominal: SimModel | None = None) -> ModelFile:
    """A ModelFile from parsed YAML; ``where`` names its origin in errors, ``nominal`` has what the YAML leaves out."""
    nominal = SimModel() if nominal is None else nominal
    if not isinstance(data, dict):
        raise ValueError(f"{where}: a model is a mapping of parameter groups, got {type(data).__name__}")
    data = dict(data)
    ranges, provenance = (_mapping(data.pop(key, None), f"{where}: {key}") for key in ("randomise", "provenance"))
    known = paths(nominal)
    values = {}
    for path, value in _flatten(data, where, known):
        if isinstance(known[path], str):
            if value not in INTEGRATORS:
                raise ValueError(f"{where}: {path} = {value!r}, allowed are {INTEGRATORS}")
        else:
            value = _number(value, f"{where}: {path}", path)
        values[path] = value

    def parameter(path: Any, where: str) -> str:
        if path not in known or isinstance(known[path], str):
            raise ValueError(f"{where}: unknown parameter{nearest(str(path), known)}")
        return str(path)

    parsed = randomisation.parse(ranges, f"{where}: randomise", parameter, _number)
    return ModelFile(with_values(nominal, values), parsed, provenance)


def _flatten(data: dict, where: str, known: Collection[str], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in data.items():
        path = f"{prefix}{key}"
        if isinstance(value, dict):
            yield from _flatten(value, where, known, f"{path}.")
        elif path in known:
            yield path, value
        elif any(name.startswith(f"{path}.") for name in known):
            raise ValueError(f"{where}: {path} = {value!r}, a mapping of its parameters is needed")
        else:
            beside = {name for name in known if name.startswith(prefix)} if prefix else {n.split(".")[0] for n in known}
            hint = nearest(path, known) if difflib.get_close_matches(path, list(known), 1) else nearest(path, beside)
            raise ValueError(f"{where}: unknown parameter {path!r}{hint}")


def _mapping(value: Any, where: str) -> dict:
    if value is not None and not isinstance(value, dict):
        raise ValueError(f"{where} = {value!r}, a mapping is needed")
    return value or {}


def _number(value: Any, where: str, path: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"{where} = {value!r}, a finite number is needed")
    low, high = bounds.of(path)
    if not low <= value <= high:
        raise ValueError(f"{where} = {value!r}, allowed is {low:g} to {high:g} in SI units")
    return float(value)
