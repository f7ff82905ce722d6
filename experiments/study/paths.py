"""Files of a study, by their paths below its folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from experiments.config.files import read_yaml
from experiments.runs.locate import SELECTION

SETTINGS, SESSIONS, JOURNAL = "study.yaml", "study.json", "steps.jsonl"
EVALUATIONS, JOINTS, POLICY = "evaluations.csv", "joints", "policy.npz"
REPORT = Path("report") / "index.html"


@dataclass(frozen=True)
class StudyPaths:
    """Paths below a study's folder. Only ``run`` reads a file."""

    folder: Path

    def seed(self, seed: int) -> Path:
        return self.folder / f"seed{seed}"

    def model(self, seed: int, player: str, model: str) -> Path:
        return self.seed(seed) / player / model

    def balls(self, seed: int, player: str, name: str) -> Path:
        """Measured balls of a data set."""
        return self.seed(seed) / player / "balls" / f"{name}.csv"

    def hits(self, seed: int, player: str, name: str) -> Path:
        """Folder of the hits that were logged in the play of a data set."""
        return self.seed(seed) / player / "hits" / name

    def human(self, seed: int, player: str, name: str) -> Path:
        return self.seed(seed) / player / "balls" / f"human_{name}.yaml"

    def world(self, seed: int, player: str, name: str) -> Path:
        """An identified world as a model YAML."""
        return self.seed(seed) / player / "identified" / f"{name}.yaml"

    def run(self, seed: int, player: str, model: str) -> Path:
        """The run that holds a model's policy: of several trainings the chosen one."""
        folder = self.model(seed, player, model)
        chosen = folder / SELECTION
        if not chosen.exists():
            return folder
        return folder / read_yaml(chosen.read_text(encoding="utf-8"), str(chosen))["best"]
