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
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import yaml
from jax import Array
from jaxtyping import Float, PRNGKeyArray
from typing_extensions import TypedDict

from ballmodel.flight import BallParams, ball_params
from ballmodel.io import yaml as yaml_file
from ballmodel.io.atomic_files import replacing
from ballmodel.io.ranges import Within, find_note, type_hints
from ballmodel.io.validation import nearest, validate
from ballmodel.vec import Scalars
from mjx_tt.pytrees import pytree
from mjx_tt.sim import randomisation
from mjx_tt.sim.actuators import JointDrive, drive_params
from mjx_tt.sim.randomisation import Drawing, Randomised
from mjx_tt.sim.randomisation import Range as Range
from mjx_tt.sim.randomisation import Samples as Samples
from mjx_tt.sim.sensors import SensingParams as SensingParams
from robot_io.contract import JOINT_NAMES


@pytree
class LatencyParams:
    """Gaussian delays, drawn per episode [s]. Means and deviations: the paper's table of sensor latencies.

    The table heads its second column sigma^2 with unit ms; 8.2 ms is a plausible deviation and 2.9 ms (its root) is not
    meant: a variance would have unit ms^2.
    """

    ball_observation: Annotated[Scalars, Within(0.0, 1.0, "s")] = 0.040
    ball_observation_std: Annotated[Scalars, Within(0.0, 1.0, "s")] = 0.0082
    abb_observation: Annotated[Scalars, Within(0.0, 1.0, "s")] = 0.029
    abb_observation_std: Annotated[Scalars, Within(0.0, 1.0, "s")] = 0.0082
    festo_observation: Annotated[Scalars, Within(0.0, 1.0, "s")] = 0.033
    festo_observation_std: Annotated[Scalars, Within(0.0, 1.0, "s")] = 0.009
    abb_action: Annotated[Scalars, Within(0.0, 1.0, "s")] = 0.071
    abb_action_std: Annotated[Scalars, Within(0.0, 1.0, "s")] = 0.0057
    festo_action: Annotated[Scalars, Within(0.0, 1.0, "s")] = 0.0645
    festo_action_std: Annotated[Scalars, Within(0.0, 1.0, "s")] = 0.0115


LATENCIES = ("ball_observation", "abb_observation", "festo_observation", "abb_action", "festo_action")


@pytree
class ActuationParams:
    """All drives alike: gain of the velocity command before the servo of the MJCF follows it."""

    velocity_gain: Annotated[Scalars, Within(-3.0, 3.0)] = 1.0  # reached over commanded velocity


@pytree
class BallSpinParams:
    """Spin of the incoming balls at their start [rad/s], Gaussian and drawn per episode.

    The pool of balls is chosen without spin: those that spin much need not land where their distribution says.
    """

    mean_x: Annotated[Scalars, Within(-2000.0, 2000.0, "rad/s")] = 0.0
    mean_y: Annotated[Scalars, Within(-2000.0, 2000.0, "rad/s")] = 0.0
    mean_z: Annotated[Scalars, Within(-2000.0, 2000.0, "rad/s")] = 0.0
    std_x: Annotated[Scalars, Within(0.0, 2000.0, "rad/s")] = 0.0
    std_y: Annotated[Scalars, Within(0.0, 2000.0, "rad/s")] = 0.0
    std_z: Annotated[Scalars, Within(0.0, 2000.0, "rad/s")] = 0.0


def _ball() -> BallParams:
    # The paper's first-order step at 300 Hz moves landing points by up to 1.5 mm when halved; this one by 0.01 mm.
    ball = ball_params()
    return dataclasses.replace(ball, flight=dataclasses.replace(ball.flight, integrator="midpoint"))


@pytree
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
        tree = _nest(
            (name, value if isinstance(value, str) else float(value))
            for name, value in paths(self.model).items()
            if self.model.drives is not None or not name.startswith("drives.")
        )
        tree["randomise"] = randomisation.to_dict(self.randomise)
        tree["provenance"] = self.provenance
        with replacing(Path(path)) as temporary:
            temporary.write_text(yaml.dump(tree, Dumper=_Dumper, sort_keys=False, width=120), encoding="utf-8")


def paths(node: SimModel | None = None) -> dict[str, Any]:
    """Every leaf of a SimModel by its dotted path; of the nominal model by default. Absent drives are nominal ones."""
    return {path: value for path, value, _ in _leaves(SimModel() if node is None else node)}


def _leaves(node: Any, prefix: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Dotted path, value and annotation of every leaf."""
    if isinstance(node, SimModel) and node.drives is None:
        node = dataclasses.replace(node, drives=drive_params(node.joints)())
    owner: Any = type(node)
    for f in _parameters(node):
        value = getattr(node, f.name)
        if dataclasses.is_dataclass(value):
            yield from _leaves(value, f"{prefix}{f.name}.")
        else:
            yield prefix + f.name, value, find_note(type_hints(owner)[f.name])


def with_values(model: SimModel, values: Mapping[str, Any]) -> SimModel:
    """The model with the leaves at the given dotted paths replaced; a path of the drives gives it drives.

    Raises ValueError for a path that does not exist.
    """
    known = paths(SimModel(joints=model.joints))
    for path in values:
        if path not in known:
            raise ValueError(f"expected a parameter of the model, got {path!r}; {nearest(path, known)}")
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
    key: PRNGKeyArray, model: SimModel, randomise: tuple[Randomised | Drawing, ...], shape: tuple[int, ...]
) -> SimModel:
    """The model with all that is randomised drawn for a batch of ``shape`` episodes."""
    return with_values(model, randomisation.drawn(key, randomise, shape))


def draw_latencies(
    key: PRNGKeyArray, latency: LatencyParams, shape: tuple[int, ...], longest: Float[Array, "5 *#batch"] | float
) -> Float[Array, "5 *batch"]:
    """Delays (5, *shape) [s] in the order of ``LATENCIES``, kept within [0, longest]."""
    mean = jnp.stack([jnp.broadcast_to(getattr(latency, n), shape) for n in LATENCIES])
    std = jnp.stack([jnp.broadcast_to(getattr(latency, f"{n}_std"), shape) for n in LATENCIES])
    return jnp.clip(mean + std * jax.random.normal(key, mean.shape), 0.0, longest)


def draw_spin(key: PRNGKeyArray, spin: BallSpinParams, shape: tuple[int, ...]) -> Float[Array, "3 *batch"] | None:
    """Spin (3, *shape) [rad/s] of incoming balls; None where no ball spins, so that nothing is added."""
    values = dataclasses.astuple(spin)
    if all(isinstance(value, int | float) and value == 0.0 for value in values):
        return None
    mean, std = (jnp.stack([jnp.broadcast_to(v, shape) for v in part]) for part in (values[:3], values[3:]))
    return mean + std * jax.random.normal(key, mean.shape)


def bounds(path: str) -> tuple[float, float]:
    """Smallest and largest value of a number, by its dotted path: wide enough for everything measured, too narrow for
    another unit or a typing slip. Programs may set what they like."""
    _, _, name = path.rpartition(".")
    note = find_note(type_hints(JointDrive)[name]) if path.startswith("drives.") else _notes(JOINT_NAMES)[path]
    return note.low, note.high


def from_dict(data: Any, where: str, nominal: SimModel | None = None) -> ModelFile:
    """A ModelFile from parsed YAML; ``where`` names its origin in errors, ``nominal`` has what the YAML leaves out."""
    nominal = SimModel() if nominal is None else nominal
    # In the order of the file: what is drawn depends on it.
    content = _reorder(validate(file_type(nominal.joints), data, where), data)
    ranges = content.pop("randomise", None) or {}
    content.pop("provenance", None)
    provenance = data.get("provenance") or {}  # as it stands there
    return ModelFile(with_values(nominal, dict(_flatten(content))), randomisation.parse(ranges), provenance)


@cache
def file_type(joints: tuple[str, ...] = JOINT_NAMES) -> Any:
    """Type of a model YAML for a robot with these joints: the tree of parameters, none of which is required."""
    notes = _notes(joints)
    numbers = {path: note for path, note in notes.items() if isinstance(note, Within)}
    tree = _nest((path, Annotated[float, note] if path in numbers else note) for path, note in notes.items())
    extra = {"randomise": randomisation.file_type(numbers) | None, "provenance": dict[str, Any] | None}
    return _mapping_type("Model", tree | extra)


def _mapping_type(name: str, tree: dict[str, Any]) -> Any:
    keys = {key: _mapping_type(key, below) if isinstance(below, dict) else below for key, below in tree.items()}
    return TypedDict(name, keys, total=False)  # type: ignore[operator]


@cache
def _notes(joints: tuple[str, ...]) -> dict[str, Any]:
    """Annotations that say what is allowed, by dotted path."""
    return {path: note for path, _, note in _leaves(SimModel(joints=joints))}


def _reorder(content: Any, given: Any) -> Any:
    """Valid content with the keys of its mappings in the order in which they were given."""
    if not isinstance(content, dict):
        return content
    return {str(key): _reorder(content[str(key)], value) for key, value in given.items()}


def _nest(leaves: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    """The tree of the leaves with these dotted paths."""
    tree: dict[str, Any] = {}
    for path, value in leaves:
        *groups, leaf = path.split(".")
        node = tree
        for group in groups:
            node = node.setdefault(group, {})
        node[leaf] = value
    return tree


def _flatten(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from _flatten(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
