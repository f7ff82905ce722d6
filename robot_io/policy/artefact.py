"""An exported policy on disk: load it, or say exactly why not. The format is described in docs/reference/artefact.md.

NumPy only: this module runs on the robot. ``robot_io.policy.export`` makes artefacts.
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from robot_io import contract
from robot_io.contract import Contract
from robot_io.errors import ContractError
from robot_io.policy.backends import make_policy
from robot_io.policy.policy import ExportedNetwork, LoopPolicy, Policy

SCHEMA_VERSION = 1
NORMALISER_FORMULA = "(observation - mean) * inverse_scale"
GOLDEN_TOLERANCE = 1e-6  # of the reference forward pass in float64, which repeats itself to about 1e-15

MANIFEST = "manifest.json"
MANIFEST_DIGEST = "manifest.sha256"
PARAMETERS = "params.npz"
GOLDEN = "golden.npz"
ONNX = "policy.onnx"
JAX_EXPORT = "policy.jaxexport"
NETWORK = "network.py"  # of a user-defined network: the file that defines it, which the robot does not run
HASHED_FILES = (PARAMETERS, GOLDEN, ONNX, JAX_EXPORT)  # by the manifest, which has a digest of its own
FILES = (MANIFEST, MANIFEST_DIGEST, *HASHED_FILES)
USER_DEFINED_HASHED_FILES = (PARAMETERS, GOLDEN, NETWORK, JAX_EXPORT)  # where the network is user-defined
USER_DEFINED_FILES = (MANIFEST, MANIFEST_DIGEST, *USER_DEFINED_HASHED_FILES)
USER_DEFINED_TOLERANCE = 1e-5  # of the exported step in float32 on another machine

USER_DEFINED_ARCHITECTURE = ("network", "parameters", "n_parameters", "step")  # of a user-defined network
MANIFEST_KEYS = {"schema_version", "contract", "architecture", "normaliser", "golden", "files", "provenance"}
MANIFEST_KEYS |= {"written_with"}

_RECOPY = "copy the artefact again from where it was exported"


class ArtefactError(ValueError):
    """An artefact cannot be written or must not be used: the message names the file, what was found and what to do."""


@dataclass(frozen=True)
class Artefact:
    """A verified policy.

    folder          where it was loaded from
    digest          SHA-256 of manifest.json: identifies the policy and everything about it
    manifest        the manifest as plain data
    policy          theta float32, normaliser float64; its ``network`` is None for the paper's
    golden_history  (8, 11, G) float32; of a user-defined network one episode's observations (G, 11)
    golden_action   (8, G) float64: the reference's answer to ``golden_history``; (G, 8) of a user-defined network
    """

    folder: Path
    digest: str
    manifest: dict[str, Any]
    policy: Policy
    golden_history: np.ndarray
    golden_action: np.ndarray

    @property
    def contract(self) -> Contract:
        """Of the robot that the policy was trained for."""
        return contract.from_description(self.manifest["contract"])

    def streaming(self) -> LoopPolicy:
        """The policy for the control loop, at the start of an episode."""
        return make_policy("numpy" if self.policy.network is None else "jit", self.policy, self.contract)


def load(folder: str | Path, standing: contract.Contract | None = None) -> Artefact:
    """Reads and verifies an artefact: files, every hash, schema, contract, finite numbers, golden outputs.

    standing  of the robot that it shall move; None: whatever the artefact says

    Raises ArtefactError naming the file, what was found, what was expected and what to do.
    """
    folder = Path(folder)
    contents = _read_files(folder)
    manifest = _verified_manifest(folder, contents)
    for name in set(contents) - {MANIFEST, MANIFEST_DIGEST}:
        found, expected = sha256(contents[name]), manifest["files"].get(name)
        if found != expected:
            raise ArtefactError(f"{folder / name}: SHA-256 is {found}, the manifest says {expected}; {_RECOPY}")
    robot = contract.from_description(manifest["contract"])
    check_robot(folder, robot, standing or robot)
    network, shapes = None, contract.parameter_shapes(robot.n_joints)
    count, seen, answered = manifest["golden"].get("count"), robot.n_observation, robot.n_joints
    wanted = {"history": ((contract.HISTORY, seen, count), "float32"), "action": ((answered, count), "float64")}
    if NETWORK in contents:
        described = manifest["architecture"]
        shapes = {name: tuple(shape) for name, shape in described["parameters"].items()}
        source = contents[NETWORK].decode()
        network = ExportedNetwork(described["network"], tuple(shapes.items()), contents[JAX_EXPORT], source)
        wanted = {"observation": ((count, seen), "float32"), "action": ((count, answered), "float64")}
    parameters = _arrays(folder, PARAMETERS, contents, {name: (shape, "float32") for name, shape in shapes.items()})
    golden_input, golden_action = _arrays(folder, GOLDEN, contents, wanted)
    theta = np.concatenate([parameter.ravel() for parameter in parameters])
    policy = Policy(theta, *_normaliser(folder / MANIFEST, manifest["normaliser"], seen), network)
    try:
        action = answer(policy, golden_input, robot)
    except Exception as error:  # JAX absent, or of a version that reads the export no more
        if network is None:
            raise
        age = f"it takes a JAX at most six months from {manifest['written_with']}"
        what = f"the network {network.name!r} cannot be run here ({type(error).__name__}: {error}); {age}"
        raise _stale(folder / JAX_EXPORT, what) from error
    difference, allowed = float(np.max(np.abs(action - golden_action))), tolerance(network)
    if not difference <= allowed:
        what = f"this machine's policy differs from the golden outputs by {difference:.3g}, allowed is {allowed:g}"
        why = "do not run it: the forward pass, NumPy or JAX changed since the export"
        raise _stale(folder / GOLDEN, f"{what}; {why}")
    return Artefact(folder, sha256(contents[MANIFEST]), manifest, policy, golden_input, golden_action)


load_artefact = load  # its name in ``robot_io``


def answer(policy: Policy, golden_input: np.ndarray, robot: Contract) -> np.ndarray:
    """The reference's actions, as ``Artefact`` has them, by the form of the policy that the robot runs."""
    if policy.network is None:
        return policy.apply(golden_input)
    return make_policy("jit", policy, robot).episode(golden_input)


def tolerance(network: ExportedNetwork | None) -> float:
    """Largest difference allowed between a policy's answers and its golden outputs."""
    return GOLDEN_TOLERANCE if network is None else USER_DEFINED_TOLERANCE


def sha256(content: bytes) -> str:
    """SHA-256 in lower-case hexadecimal digits."""
    return hashlib.sha256(content).hexdigest()


def digest_line(manifest: bytes) -> bytes:
    """Content of manifest.sha256, in the form that ``sha256sum --check`` reads."""
    return f"{sha256(manifest)}  {MANIFEST}\n".encode()


def architecture(robot: Contract = contract.PAPER) -> dict[str, Any]:
    """The network of a robot's contract as plain data, with the formulas that its numbers stand for."""
    return {
        "kernel": contract.KERNEL,
        "filters": list(robot.filters),
        "dilations": list(contract.DILATIONS),
        "gated": list(contract.GATED),
        "gated_layer": "tanh(first half of the outputs) * sigmoid(second half)",
        "plain_layer": "tanh(outputs)",
        "kernel_axes": "(tap, input, output), tap 0 is the older observation",
        "n_parameters": contract.n_parameters(robot.n_joints),
    }


def check_robot(source: str | Path, robot: contract.Contract, standing: contract.Contract) -> None:
    """Raise ArtefactError naming every field in which a policy's robot is not the one that stands there."""
    found, expected = (json.loads(json.dumps(contract.describe(one))) for one in (robot, standing))
    lines = [line if len(line) <= 200 else f"{line[:200]} ..." for line in differences(found, expected, "contract")]
    if lines:
        raise ArtefactError(
            f"{source}: a policy for {robot.robot}, and robot.yaml is of {standing.robot}: {'; '.join(lines)}; name "
            "the policy's robot there (key robot), if that is what stands there, or export a policy for this one"
        )


def differences(found: Any, expected: Any, path: str) -> list[str]:
    """Differences of two pieces of JSON-like data, one line a leaf: "contract.version: found 2, expected 1"."""
    if isinstance(found, dict) and isinstance(expected, dict):
        lines = [f"{path}.{key}: missing, expected {expected[key]!r}" for key in expected if key not in found]
        lines += [f"{path}.{key}: found {found[key]!r}, not expected" for key in found if key not in expected]
        shared = [(f"{path}.{key}", found[key], expected[key]) for key in expected if key in found]
    elif isinstance(found, list) and isinstance(expected, list) and len(found) == len(expected):
        lines = []
        shared = [(f"{path}[{i}]", f, e) for i, (f, e) in enumerate(zip(found, expected, strict=True))]
    else:
        return [] if found == expected else [f"{path}: found {found!r}, expected {expected!r}"]
    return lines + [line for place, one, other in shared for line in differences(one, other, place)]


def _read_files(folder: Path) -> dict[str, bytes]:
    if not folder.is_dir():
        raise ArtefactError(f"{folder}: no such folder; an artefact is a folder holding {', '.join(FILES)}")
    present = {entry.name for entry in folder.iterdir()}
    files = USER_DEFINED_FILES if NETWORK in present else FILES
    missing, extra = sorted(set(files) - present), sorted(present - set(files))
    if missing:
        raise ArtefactError(f"{folder}: {', '.join(missing)} missing, an artefact holds {', '.join(files)}; {_RECOPY}")
    if extra:
        raise ArtefactError(f"{folder}: holds {', '.join(extra)}, which no artefact does; remove it or {_RECOPY}")
    try:
        # Read once: what is hashed is what is used.
        return {name: (folder / name).read_bytes() for name in files}
    except OSError as error:
        raise ArtefactError(f"{error.filename}: cannot be read ({error.strerror}); {_RECOPY}") from error


def _stale(path: Path, what: str) -> ArtefactError:
    return ArtefactError(f"{path}: {what}; export the policy again with this version of the program")


def _verified_manifest(folder: Path, contents: dict[str, bytes]) -> dict[str, Any]:
    path, raw = folder / MANIFEST, contents[MANIFEST]
    if contents[MANIFEST_DIGEST] != digest_line(raw):
        stated = contents[MANIFEST_DIGEST][:80]
        raise ArtefactError(f"{path}: SHA-256 is {sha256(raw)}, but {MANIFEST_DIGEST} says {stated!r}; {_RECOPY}")
    try:
        manifest = json.loads(raw)
    except ValueError as error:
        raise _stale(path, f"not JSON ({error})") from error
    version = manifest.get("schema_version") if isinstance(manifest, dict) else None
    if version != SCHEMA_VERSION:
        raise _stale(path, f"schema_version: found {version!r}, expected {SCHEMA_VERSION}")
    if set(manifest) != MANIFEST_KEYS:
        raise _stale(path, f"keys are {sorted(manifest)}, expected {sorted(MANIFEST_KEYS)}")
    for key in ("normaliser", "golden", "files"):
        if not isinstance(manifest[key], dict):
            raise _stale(path, f"{key}: found {manifest[key]!r}, expected an object")
    try:
        robot = contract.from_description(manifest["contract"])
    except ContractError as error:
        raise _stale(path, f"contract: {error}") from error
    expectations, described = {"contract": contract.describe(robot)}, manifest["architecture"]
    if NETWORK not in contents:
        expectations["architecture"] = architecture(robot)
    elif not isinstance(described, dict) or set(described) != set(USER_DEFINED_ARCHITECTURE):
        raise _stale(path, f"architecture: found {described!r}, expected {USER_DEFINED_ARCHITECTURE}")
    for key, expected in expectations.items():
        lines = differences(manifest[key], json.loads(json.dumps(expected)), key)
        if lines:
            raise _stale(path, f"made for another robot interface: {'; '.join(lines)}")
    return manifest


def _arrays(
    folder: Path, file: str, contents: dict[str, bytes], expected: dict[str, tuple[tuple[int, ...], str]]
) -> list[np.ndarray]:
    """A file's arrays in the order of ``expected``, which has their shapes and types."""
    path = folder / file
    try:
        with np.load(io.BytesIO(contents[file]), allow_pickle=False) as archive:
            arrays = dict(archive)
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise _stale(path, f"not a NumPy archive ({error})") from error
    if set(arrays) != set(expected):
        raise _stale(path, f"holds {sorted(arrays)}, expected {sorted(expected)}")
    for name, (shape, dtype) in expected.items():
        array = arrays[name]
        if array.shape != shape or array.dtype != dtype:
            raise _stale(path, f"{name} is {array.dtype} {array.shape}, expected {dtype} {shape}")
        if not np.all(np.isfinite(array)):
            raise ArtefactError(f"{path}: {name} has a non-finite number; export an earlier checkpoint")
    return [arrays[name] for name in expected]


def _normaliser(path: Path, normaliser: dict[str, Any], size: int) -> tuple[np.ndarray, np.ndarray]:
    formula = normaliser.get("formula")
    if formula != NORMALISER_FORMULA:
        raise _stale(path, f"normaliser.formula: found {formula!r}, expected {NORMALISER_FORMULA!r}")
    arrays = []
    for key in ("mean", "inverse_scale"):
        found = normaliser.get(key)
        try:
            array = np.asarray(found, np.float64)
        except (TypeError, ValueError):
            array = np.empty(0)
        if array.shape != (size,) or not np.all(np.isfinite(array)):
            raise _stale(path, f"normaliser.{key}: found {found!r}, expected {size} finite numbers")
        arrays.append(array)
    return arrays[0], arrays[1]
