"""A trained policy from wherever it lies: a run's last checkpoint or an exported artefact."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from bgs import normalizer
from bgs.normalizer import ObservationStatistics
from experiments import checkpoint
from experiments.config import Config, parse
from experiments.errors import RunError
from experiments.runs import CONFIG, Run
from robot_io import artefact as artefacts
from robot_io import contract


@dataclass(frozen=True)
class Policy:
    """A policy that can be played.

    theta          (976,) parameters: a run's moving average
    mean           (11,) of the normaliser, in the observation's units
    inverse_scale  (11,) of the normaliser
    source         folder that it came from
    config         experiment that trained it; None when the artefact does not tell
    notes          update and training seconds, or the artefact's provenance
    """

    theta: np.ndarray
    mean: np.ndarray
    inverse_scale: np.ndarray
    source: Path
    config: Config | None
    notes: dict[str, Any]


def load(folder: str | Path) -> Policy:
    """Reads a run folder's newest checkpoint or an artefact.

    Raises RunError for a folder that is neither, CheckpointError or ArtefactError for a damaged one.
    """
    folder = Path(folder)
    if (folder / CONFIG).is_file():
        return _from_run(folder)
    if (folder / artefacts.MANIFEST).is_file():
        return _from_artefact(folder)
    raise RunError(f"{folder}: neither a run (holding {CONFIG}) nor an artefact (holding {artefacts.MANIFEST})")


def load_statistics(folder: str | Path) -> tuple[np.ndarray, ObservationStatistics]:
    """Parameters (976,) and observation statistics to start another training from.

    An artefact keeps only the normaliser; its statistics then count as two observations that give this very normaliser,
    so that training soon replaces them by its own. Raises as ``load`` does.
    """
    folder = Path(folder)
    if (folder / CONFIG).is_file():
        arrays, _ = _read(folder)
        return arrays["bgs.average"], _statistics(arrays)
    policy = load(folder)
    std = np.where(policy.inverse_scale > 0, 1 / np.where(policy.inverse_scale > 0, policy.inverse_scale, 1), 0)
    count, m2 = jnp.array([0, 2], jnp.int32), jnp.asarray(std**2, jnp.float32)
    return policy.theta, ObservationStatistics(count, jnp.asarray(policy.mean, jnp.float32), m2)


def _from_run(folder: Path) -> Policy:
    arrays, notes = _read(folder)
    mean, inverse_scale = (np.asarray(a) for a in normalizer.normaliser(_statistics(arrays)))
    return Policy(arrays["bgs.average"], mean, inverse_scale, folder, Run(folder).config(), notes)


def _from_artefact(folder: Path) -> Policy:
    artefact = artefacts.load(folder)
    theta = np.concatenate([artefact.parameters[name].ravel() for name in contract.parameter_shapes()])
    provenance = artefact.manifest["provenance"]
    recorded = provenance.get("config") if isinstance(provenance, dict) else None
    config = parse(recorded, f"{folder}: provenance.config") if recorded else None
    mean, inverse_scale = (a.astype(np.float32) for a in (artefact.normaliser_mean, artefact.normaliser_inverse_scale))
    return Policy(theta, mean, inverse_scale, folder, config, provenance)


def _read(folder: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    found = checkpoint.read_latest(Run(folder).checkpoints)
    if found is None:
        raise RunError(f"{folder}: has no checkpoint yet; train it first")
    return found


def _statistics(arrays: dict[str, np.ndarray]) -> ObservationStatistics:
    parts = (arrays[f"statistics.{name}"] for name in ("count", "mean", "m2"))
    return ObservationStatistics(*(jnp.asarray(part) for part in parts))
