"""Files of a study in its folder."""

from __future__ import annotations

from pathlib import Path

from experiments.config.files import read_yaml
from experiments.runs.locate import SELECTION
from experiments.study.schedule import PRIOR


class Places:
    """Paths below a study's folder; nothing is looked up but what ``run_of`` reads."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def seed_folder(self, seed: int) -> Path:
        return self.folder / f"seed{seed}"

    def model_folder(self, seed: int, player: str, model: str) -> Path:
        return self.seed_folder(seed) / player / model

    def data(self, seed: int, player: str, name: str) -> Path:
        return self.seed_folder(seed) / player / "balls" / f"{name}.csv"

    def hits(self, seed: int, player: str, name: str) -> Path:
        """Folder of the hits that were logged in the play of a data set."""
        return self.seed_folder(seed) / player / "hits" / name

    def human(self, seed: int, player: str, name: str) -> Path:
        return self.seed_folder(seed) / player / "balls" / f"human_{name}.yaml"

    def world(self, seed: int, player: str, name: str) -> Path:
        """A world of the study by name, as a model YAML: the player's own where it was identified."""
        if name == PRIOR:
            return self.seed_folder(seed) / f"{name}.yaml"
        return self.seed_folder(seed) / player / "identified" / f"{name}.yaml"

    def run_of(self, seed: int, player: str, model: str) -> Path:
        """The run that holds a model's policy: of several trainings the chosen one."""
        folder = self.model_folder(seed, player, model)
        chosen = folder / SELECTION
        if not chosen.exists():
            return folder
        return folder / read_yaml(chosen.read_text(encoding="utf-8"), str(chosen))["best"]
