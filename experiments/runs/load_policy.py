"""A trained policy from wherever it lies: a run's last checkpoint or an exported artefact."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from bgs import normalizer
from bgs.normalizer import ObservationStatistics
from experiments.config import build
from experiments.config.experiment import Config, parse
from experiments.errors import RunError
from experiments.runs import checkpoint
from experiments.runs.locate import artefact_of, find_policy, is_exported
from experiments.runs.run_dir import CONFIG, Run
from mjx_tt.env import user_defined
from mjx_tt.env.policy import Policy
from robot_io.policy import artefact as artefacts


@dataclass(frozen=True)
class TrainedPolicy:
    """A policy and its origin.

    policy  of a run: the moving average of theta
    source  folder of the run or artefact
    config  experiment that trained it; None where the artefact does not record it
    notes   update and training seconds, or the artefact's provenance
    """

    policy: Policy
    source: Path
    config: Config | None
    notes: dict[str, Any]


def load(folder: str | Path) -> TrainedPolicy:
    """Reads a run folder's newest checkpoint or an artefact; of a run that was passed on, its artefact.

    Raises RunError for a folder that is neither, CheckpointError or ArtefactError for a damaged one.
    """
    folder = find_policy(folder)
    return _from_artefact(artefact_of(folder)) if is_exported(folder) else _from_run(folder)


def load_statistics(folder: str | Path) -> tuple[np.ndarray, ObservationStatistics]:
    """Parameters (976,) and observation statistics to start another training from.

    An artefact keeps only the normaliser; its statistics then count as two observations that give this very normaliser,
    so that training soon replaces them by its own. Raises as ``load`` does.
    """
    folder = Path(folder)
    if (folder / CONFIG).is_file() and not is_exported(folder):
        arrays, _ = _read(folder)
        return arrays["bgs.average"], _statistics(arrays)
    policy = load(folder).policy
    std = np.where(policy.inv_std > 0, 1 / np.where(policy.inv_std > 0, policy.inv_std, 1), 0)
    count, m2 = jnp.array([0, 2], jnp.int32), jnp.asarray(std**2, jnp.float32)
    return policy.theta, ObservationStatistics(count, jnp.asarray(policy.mean, jnp.float32), m2)


def _from_run(folder: Path) -> TrainedPolicy:
    arrays, notes = _read(folder)
    mean, inv_std = (np.asarray(a) for a in normalizer.normaliser(_statistics(arrays)))
    config = Run(folder).config()
    policy = Policy(arrays["bgs.average"], mean, inv_std, build.network(config, str(folder)))
    return TrainedPolicy(policy, folder, config, notes)


def _from_artefact(folder: Path) -> TrainedPolicy:
    artefact = artefacts.load(folder)
    provenance = artefact.manifest["provenance"]
    recorded = provenance.get("config") if isinstance(provenance, dict) else None
    config = parse(recorded, f"{folder}: provenance.config") if recorded else None
    policy = user_defined.load_network(artefact.policy, str(folder), artefact.contract).astype(np.float32)
    return TrainedPolicy(policy, folder, config, provenance)


def _read(folder: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    found = checkpoint.read_latest(Run(folder).checkpoints)
    if found is None:
        raise RunError(f"{folder}: has no checkpoint yet; train it first")
    return found


def _statistics(arrays: dict[str, np.ndarray]) -> ObservationStatistics:
    parts = (arrays[f"statistics.{name}"] for name in ("count", "mean", "m2"))
    return ObservationStatistics(*(jnp.asarray(part) for part in parts))
