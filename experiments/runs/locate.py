"""Folders that hold a policy, found and told apart without JAX."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path

from experiments.errors import RunError
from experiments.runs.run_dir import CONFIG, Run
from robot_io.policy.artefact import MANIFEST

SHIPPED = Path(__file__).parents[1] / "shipped" / "policies"
SELECTION = "selection.json"  # beside several trainings of one model: which was chosen
LISTED = 6  # folders that a message names
_RUNS = "* training/* */training/* player*/* player*/*/training/* seed*/player*/* seed*/player*/*/training/*".split()


def find_policy(folder: str | Path) -> Path:
    """The folder of a run or of an artefact, or a shipped policy by its name.

    Raises RunError for any other, naming those inside it.
    """
    folder = Path(folder)
    if folder.parent == Path() and not folder.exists() and (SHIPPED / folder).is_dir():
        folder = SHIPPED / folder
    if not (folder / CONFIG).is_file() and not (folder / MANIFEST).is_file():
        raise RunError(
            f"{folder}: neither a run (holding {CONFIG}) nor an artefact (holding {MANIFEST}){_inside(folder)}"
        )
    return folder


def run_of(folder: str | Path) -> Path:
    """The run that a folder is or that holds this artefact. Raises RunError where there is none."""
    folder = find_policy(folder)
    return folder if (folder / CONFIG).is_file() or not (folder.parent / CONFIG).is_file() else folder.parent


def artefact_of(folder: str | Path) -> Path:
    """The artefact that a folder is or that a run holds. Raises RunError where there is none."""
    folder = find_policy(folder)
    if (folder / MANIFEST).is_file():
        return folder
    if not (folder / "artefact" / MANIFEST).is_file():
        raise RunError(f"{folder}: a run that was not exported yet: `mjx-tt export {folder}`")
    return folder / "artefact"


def is_exported(folder: str | Path) -> bool:
    """True for an artefact, and for a run's folder that was passed on: with an artefact, without states of training."""
    folder = Path(folder)
    if (folder / CONFIG).is_file() and Run(folder).newest_checkpoint():
        return False
    return any((folder / place / MANIFEST).is_file() for place in ("", "artefact"))


def _inside(folder: Path) -> str:
    """Which runs or artefacts lie in a folder that is neither, for a message; of several trainings the chosen one."""
    if not folder.is_dir():
        return "; there is no such folder"
    marks = (f"*/{MANIFEST}", *(f"{place}/{CONFIG}" for place in _RUNS))
    found = [path.parent for mark in marks for path in sorted(folder.glob(mark)) if path.parent != folder]
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
