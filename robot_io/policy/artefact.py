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
from robot_io.policy.numpy_policy import StreamingPolicy
from robot_io.policy.policy import Policy

SCHEMA_VERSION = 1
NORMALISER_FORMULA = "(observation - mean) * inverse_scale"
GOLDEN_TOLERANCE = 1e-6  # of the reference forward pass in float64, which repeats itself to about 1e-15

MANIFEST = "manifest.json"
MANIFEST_DIGEST = "manifest.sha256"
PARAMETERS = "params.npz"
GOLDEN = "golden.npz"
ONNX = "policy.onnx"
JAX_EXPORT = "policy.jaxexport"
HASHED_FILES = (PARAMETERS, GOLDEN, ONNX, JAX_EXPORT)  # by the manifest, which has a digest of its own
FILES = (MANIFEST, MANIFEST_DIGEST, *HASHED_FILES)

MANIFEST_KEYS = (
    "schema_version",
    "contract",
    "architecture",
    "normaliser",
    "golden",
    "files",
    "provenance",
    "written_with",
)

_REEXPORT = "export the policy again with this version of the program"
_RECOPY = "copy the artefact again from where it was exported"


class ArtefactError(ValueError):
    """An artefact cannot be written or must not be used: the message names the file, what was found and what to do."""


@dataclass(frozen=True)
class Artefact:
    """A verified policy.

    folder          where it was loaded from
    digest          SHA-256 of manifest.json: identifies the policy and everything about it
    manifest        the manifest as plain data
    policy          theta float32, normaliser float64
    golden_history  (8, 11, G) float32
    golden_action   (8, G) float64: the reference's answer to ``golden_history``
    """

    folder: Path
    digest: str
    manifest: dict[str, Any]
    policy: Policy
    golden_history: np.ndarray
    golden_action: np.ndarray

    def streaming(self) -> StreamingPolicy:
        """The policy for the control loop, at the start of an episode."""
        return StreamingPolicy(self.policy)


def load(folder: str | Path) -> Artefact:
    """Reads and verifies an artefact: files, every hash, schema, contract, finite numbers, golden outputs.

    Raises ArtefactError naming the file, what was found, what was expected and what to do.
    """
    folder = Path(folder)
    contents = _read_files(folder)
    manifest = _verified_manifest(folder, contents)
    for name in HASHED_FILES:
        found, expected = sha256(contents[name]), manifest["files"].get(name)
        if found != expected:
            raise ArtefactError(f"{folder / name}: SHA-256 is {found}, the manifest says {expected}; {_RECOPY}")
    parameters = _arrays(
        folder / PARAMETERS,
        contents[PARAMETERS],
        {name: (shape, "float32") for name, shape in contract.parameter_shapes().items()},
    )
    golden_count = manifest["golden"].get("count")
    golden = _arrays(
        folder / GOLDEN,
        contents[GOLDEN],
        {
            "history": ((contract.HISTORY, contract.N_OBSERVATION, golden_count), "float32"),
            "action": ((contract.N_JOINTS, golden_count), "float64"),
        },
    )
    mean, inv_std = _normaliser(folder / MANIFEST, manifest["normaliser"])
    artefact = Artefact(
        folder=folder,
        digest=sha256(contents[MANIFEST]),
        manifest=manifest,
        policy=Policy(
            np.concatenate([parameters[name].ravel() for name in contract.parameter_shapes()]), mean, inv_std
        ),
        golden_history=golden["history"],
        golden_action=golden["action"],
    )
    difference = float(np.max(np.abs(artefact.policy.apply(artefact.golden_history) - artefact.golden_action)))
    if not difference <= GOLDEN_TOLERANCE:
        raise ArtefactError(
            f"{folder / GOLDEN}: this machine's policy differs from the golden outputs by {difference:.3g}, allowed is "
            f"{GOLDEN_TOLERANCE:g}; do not run it: the forward pass or NumPy changed since the export, so {_REEXPORT}"
        )
    return artefact


load_artefact = load  # its name in ``robot_io``


def sha256(content: bytes) -> str:
    """SHA-256 in lower-case hexadecimal digits."""
    return hashlib.sha256(content).hexdigest()


def digest_line(manifest: bytes) -> bytes:
    """Content of manifest.sha256, in the form that ``sha256sum --check`` reads."""
    return f"{sha256(manifest)}  {MANIFEST}\n".encode()


def architecture() -> dict[str, Any]:
    """The network of ``robot_io.contract`` as plain data, with the formulas that its numbers stand for."""
    return {
        "kernel": contract.KERNEL,
        "filters": list(contract.FILTERS),
        "dilations": list(contract.DILATIONS),
        "gated": list(contract.GATED),
        "gated_layer": "tanh(first half of the outputs) * sigmoid(second half)",
        "plain_layer": "tanh(outputs)",
        "kernel_axes": "(tap, input, output), tap 0 is the older observation",
        "n_parameters": contract.n_parameters(),
    }


def differences(found: Any, expected: Any, path: str) -> list[str]:
    """Differences of two pieces of JSON-like data, one line a leaf: "contract.version: found 2, expected 1"."""
    if isinstance(found, dict) and isinstance(expected, dict):
        lines = []
        for key in [*expected, *(k for k in found if k not in expected)]:
            if key not in found:
                lines.append(f"{path}.{key}: missing, expected {expected[key]!r}")
            elif key not in expected:
                lines.append(f"{path}.{key}: found {found[key]!r}, not expected")
            else:
                lines += differences(found[key], expected[key], f"{path}.{key}")
        return lines
    if isinstance(found, list) and isinstance(expected, list) and len(found) == len(expected):
        return [
            line
            for i, (f, e) in enumerate(zip(found, expected, strict=True))
            for line in differences(f, e, f"{path}[{i}]")
        ]
    return [] if found == expected else [f"{path}: found {found!r}, expected {expected!r}"]


def _read_files(folder: Path) -> dict[str, bytes]:
    if not folder.is_dir():
        raise ArtefactError(f"{folder}: no such folder; an artefact is a folder holding {', '.join(FILES)}")
    present = {entry.name for entry in folder.iterdir()}
    missing, extra = sorted(set(FILES) - present), sorted(present - set(FILES))
    if missing:
        raise ArtefactError(f"{folder}: {', '.join(missing)} missing, an artefact holds {', '.join(FILES)}; {_RECOPY}")
    if extra:
        raise ArtefactError(f"{folder}: holds {', '.join(extra)}, which no artefact does; remove it or {_RECOPY}")
    try:
        # Read once: what is hashed is what is used.
        return {name: (folder / name).read_bytes() for name in FILES}
    except OSError as error:
        raise ArtefactError(f"{error.filename}: cannot be read ({error.strerror}); {_RECOPY}") from error


def _verified_manifest(folder: Path, contents: dict[str, bytes]) -> dict[str, Any]:
    path, raw = folder / MANIFEST, contents[MANIFEST]
    if contents[MANIFEST_DIGEST] != digest_line(raw):
        stated = contents[MANIFEST_DIGEST][:80]
        raise ArtefactError(f"{path}: SHA-256 is {sha256(raw)}, but {MANIFEST_DIGEST} says {stated!r}; {_RECOPY}")
    try:
        manifest = json.loads(raw)
    except ValueError as error:
        raise ArtefactError(f"{path}: not JSON ({error}); {_REEXPORT}") from error
    version = manifest.get("schema_version") if isinstance(manifest, dict) else None
    if version != SCHEMA_VERSION:
        raise ArtefactError(f"{path}: schema_version: found {version!r}, expected {SCHEMA_VERSION}; {_REEXPORT}")
    if set(manifest) != set(MANIFEST_KEYS):
        raise ArtefactError(f"{path}: keys are {sorted(manifest)}, expected {sorted(MANIFEST_KEYS)}; {_REEXPORT}")
    for key in ("normaliser", "golden", "files"):
        if not isinstance(manifest[key], dict):
            raise ArtefactError(f"{path}: {key}: found {manifest[key]!r}, expected an object; {_REEXPORT}")
    for key, expected in (("contract", contract.describe()), ("architecture", architecture())):
        lines = differences(manifest[key], json.loads(json.dumps(expected)), key)
        if lines:
            raise ArtefactError(f"{path}: made for another robot interface: {'; '.join(lines)}; {_REEXPORT}")
    return manifest


def _arrays(path: Path, content: bytes, expected: dict[str, tuple[tuple[int, ...], str]]) -> dict[str, np.ndarray]:
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise ArtefactError(f"{path}: not a NumPy archive ({error}); {_REEXPORT}") from error
    if set(arrays) != set(expected):
        raise ArtefactError(f"{path}: holds {sorted(arrays)}, expected {sorted(expected)}; {_REEXPORT}")
    for name, (shape, dtype) in expected.items():
        array = arrays[name]
        if array.shape != shape or array.dtype != dtype:
            raise ArtefactError(f"{path}: {name} is {array.dtype} {array.shape}, expected {dtype} {shape}; {_REEXPORT}")
        if not np.all(np.isfinite(array)):
            raise ArtefactError(f"{path}: {name} has a non-finite number; export an earlier checkpoint")
    return arrays


def _normaliser(path: Path, normaliser: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    formula = normaliser.get("formula")
    if formula != NORMALISER_FORMULA:
        raise ArtefactError(
            f"{path}: normaliser.formula: found {formula!r}, expected {NORMALISER_FORMULA!r}; {_REEXPORT}"
        )
    arrays = []
    for key in ("mean", "inverse_scale"):
        found = normaliser.get(key)
        try:
            array = np.asarray(found, np.float64)
        except (TypeError, ValueError):
            array = np.empty(0)
        if array.shape != (contract.N_OBSERVATION,) or not np.all(np.isfinite(array)):
            wanted = f"{contract.N_OBSERVATION} finite numbers"
            raise ArtefactError(f"{path}: normaliser.{key}: found {found!r}, expected {wanted}; {_REEXPORT}")
        arrays.append(array)
    return arrays[0], arrays[1]
