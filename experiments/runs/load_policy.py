"""A trained policy from wherever it lies: a run's last checkpoint or an exported artefact."""

from __future__ import annotations

import contextlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from bgs import normalizer
from bgs.normalizer import ObservationStatistics
from experiments.config.experiment import Config, parse
from experiments.errors import RunError
from experiments.runs import checkpoint
from experiments.runs.run_dir import CONFIG, Run
from mjx_tt.env.policy import Policy
from robot_io.policy import artefact as artefacts

SELECTION = "selection.json"  # beside several trainings of one model: which was chosen
LISTED = 6  # folders that a message names
# Where runs and artefacts lie in a folder of trainings, a study's folder and those in it.
_MARKS = (
    f"*/{artefacts.MANIFEST}",
    *(
        f"{place}/{CONFIG}"
        for place in (
            "*",
            "training/*",
            "*/training/*",
            "player*/*",
            "player*/*/training/*",
            "seed*/player*/*",
            "seed*/player*/*/training/*",
        )
    ),
)


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
    """Reads a run folder's newest checkpoint or an artefact.

    Raises RunError for a folder that is neither, CheckpointError or ArtefactError for a damaged one.
    """
    folder = Path(folder)
    if (folder / CONFIG).is_file():
        return _from_run(folder)
    if (folder / artefacts.MANIFEST).is_file():
        return _from_artefact(folder)
    raise RunError(
        f"{folder}: neither a run (holding {CONFIG}) nor an artefact (holding {artefacts.MANIFEST}){_inside(folder)}"
    )


def _inside(folder: Path) -> str:
    """Which runs or artefacts lie in a folder that is neither, for a message; of several trainings the chosen one."""
    if not folder.is_dir():
        return "; there is no such folder"
    found = [path.parent for marks in _MARKS for path in sorted(folder.glob(marks)) if path.parent != folder]
    chosen = {}  # the folder with the choice: what was chosen
    for place in {folder, *(parent for run in found for parent in run.parents if folder in parent.parents)}:
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
            chosen[place] = place / json.loads((place / SELECTION).read_text(encoding="utf-8"))["best"]
    if folder in chosen and (chosen[folder] / CONFIG).is_file():
        return f"; of the trainings in it, {chosen[folder]} was chosen"
    left = [run for run in found if all(run == best for place, best in chosen.items() if place in run.parents)]
    if not left:
        return ""
    more = f" and {len(left) - LISTED} more" if len(left) > LISTED else ""
    return f"; in it are {', '.join(map(str, left[:LISTED]))}{more}"


def load_statistics(folder: str | Path) -> tuple[np.ndarray, ObservationStatistics]:
    """Parameters (976,) and observation statistics to start another training from.

    An artefact keeps only the normaliser; its statistics then count as two observations that give this very normaliser,
    so that training soon replaces them by its own. Raises as ``load`` does.
    """
    folder = Path(folder)
    if (folder / CONFIG).is_file():
        arrays, _ = _read(folder)
        return arrays["bgs.average"], _statistics(arrays)
    policy = load(folder).policy
    std = np.where(policy.inv_std > 0, 1 / np.where(policy.inv_std > 0, policy.inv_std, 1), 0)
    count, m2 = jnp.array([0, 2], jnp.int32), jnp.asarray(std**2, jnp.float32)
    return policy.theta, ObservationStatistics(count, jnp.asarray(policy.mean, jnp.float32), m2)


def _from_run(folder: Path) -> TrainedPolicy:
    arrays, notes = _read(folder)
    normaliser = (np.asarray(a) for a in normalizer.normaliser(_statistics(arrays)))
    return TrainedPolicy(Policy(arrays["bgs.average"], *normaliser), folder, Run(folder).config(), notes)


def _from_artefact(folder: Path) -> TrainedPolicy:
    artefact = artefacts.load(folder)
    provenance = artefact.manifest["provenance"]
    recorded = provenance.get("config") if isinstance(provenance, dict) else None
    config = parse(recorded, f"{folder}: provenance.config") if recorded else None
    return TrainedPolicy(artefact.policy.astype(np.float32), folder, config, provenance)


def _read(folder: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    found = checkpoint.read_latest(Run(folder).checkpoints)
    if found is None:
        raise RunError(f"{folder}: has no checkpoint yet; train it first")
    return found


def _statistics(arrays: dict[str, np.ndarray]) -> ObservationStatistics:
    parts = (arrays[f"statistics.{name}"] for name in ("count", "mean", "m2"))
    return ObservationStatistics(*(jnp.asarray(part) for part in parts))
