"""Final evaluation on a robot: a virtual player's rallies on the rig, or people's with policies under code names."""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from rich.console import Console

from experiments.deploy import play
from experiments.errors import ConfigError, RunError
from experiments.finetuning import loop
from experiments.options import RIG, RobotOptions
from experiments.runs import load_policy, run_dir
from experiments.runs.load_policy import TrainedPolicy
from experiments.runs.run_dir import Run
from experiments.study import blind_protocol
from experiments.study.analysis import scoring
from experiments.study.workflow import Step, Waiting
from experiments.training import finalize
from mjx_tt.rally.end_reasons import End
from robot_io.policy import artefact as artefacts

SESSIONS = 3  # on the rig at most in one go, until all rallies are played: a busy machine ends some by its own faults
PLAYED = "played.json"  # an evaluation's rallies so far, with the sessions that they are from


def derive_seed(name: str) -> int:
    """Seed of a step of that name."""
    return zlib.crc32(name.encode()) >> 1


def export_once(trained: TrainedPolicy, console: Console) -> Path:
    """The artefact of a run, exported if it has none. Raises ConfigError for a policy that the robot cannot run."""
    folder = Run(trained.source).artefact
    if not (folder / "manifest.json").exists():
        experiment = loop.experiment_of(trained.source)
        if not finalize.export_policy(folder, trained, experiment, None, console):
            raise ConfigError(f"{trained.source}: acts at another rate than the robot")
    return folder


@dataclass(frozen=True)
class Evaluation:
    """Rallies of one policy over all its sessions.

    artefact  digest of the policy
    begun     sessions, of which those with a report in ``reports`` are in ``rallies``
    """

    artefact: str
    begun: int = 0
    reports: tuple[str, ...] = ()
    rallies: tuple[dict[str, Any], ...] = ()

    @property
    def counted(self) -> int:
        return sum(not one["filtered"] for one in self.rallies)

    def newest_report(self, folder: Path) -> Path:
        """The newest session's report; the folder where no session has one."""
        return folder / self.reports[-1] if self.reports else folder

    def save(self, folder: Path) -> None:
        """Writes it, whole or not at all."""
        folder.mkdir(parents=True, exist_ok=True)
        run_dir.write_json(folder / PLAYED, asdict(self))


def _load(folder: Path, artefact: str) -> Evaluation:
    """The evaluation of a policy so far, with reports that are new in the folder, saved; an empty one at first.

    Raises ConfigError for a file that cannot be read.
    """
    path, found = folder / PLAYED, Evaluation(artefact)
    try:
        if path.exists():
            kept = json.loads(path.read_text(encoding="utf-8"))
            if kept["artefact"] == artefact:  # else of the policy before it was trained anew
                found = Evaluation(artefact, kept["begun"], tuple(kept["reports"]), tuple(kept["rallies"]))
        reports = sorted(p for p in folder.glob("[0-9]*.json") if "." not in p.stem and p.name not in found.reports)
        for path in reports:
            report = json.loads(path.read_text(encoding="utf-8"))
            if report["artefact_sha256"] == artefact:
                names = (*found.reports, path.name)
                rallies = (*found.rallies, *(report.get("rallies") or {"list": []})["list"])
                found = Evaluation(artefact, max(found.begun, len(names)), names, rallies)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error!r}; restore the file") from None
    found.save(folder)
    return found


def make_rally_step(
    folder: Path,
    who: tuple[int, str, str, str],
    run_of: Callable[[], Path],
    inputs: tuple[Path, ...],
    rallies: int,
    console: Console,
) -> Step:
    """Rallies of a virtual player with a policy on the rig. who: seed, trainer, evaluator, model.

    Rallies count however a session or the program ended, and the next run of the step goes on with them: to drop them
    would choose among a policy's sessions.
    """
    seed, trainer, evaluator, model = who
    name, counted = f"seed{seed}/rallies/{trainer}-{evaluator}-{model}", folder / blind_protocol.EVALUATIONS

    def run() -> str:
        artefact = export_once(load_policy.load(run_of()), console)
        digest = artefacts.load(artefact).digest
        found, status = _load(folder, digest), None
        for _ in range(SESSIONS):
            if found.counted >= rallies or status == 0:  # all are played, or somebody ended it by a key
                break
            if status is not None:
                left = f"{rallies - found.counted} of {rallies} rallies are left to play"
                console.print(f"{found.newest_report(folder)}: {left}", highlight=False, soft_wrap=True)
            chance = derive_seed(name) + found.begun
            found = replace(found, begun=found.begun + 1)
            found.save(folder)
            try:
                setup = RobotOptions(seed=chance, player=evaluator)
                missing = rallies - found.counted
                status = play.run(artefact, RIG, folder, console, setup, rallies=missing)
            finally:
                found = _load(folder, digest)
            if status == play.INTERRUPTED:
                raise KeyboardInterrupt(f"{name}: stopped")
        if found.counted < rallies:
            raise RunError(
                f"{name}: {rallies} rallies that count are needed, {rallies - found.counted} are missing; the last "
                f"session is {found.newest_report(folder)}. Make the machine quiet; the same command goes on with "
                "these rallies"
            )
        played = [(one["length"], End[one["end"]]) for one in found.rallies]
        scored = scoring.score_rallies(seed, trainer, evaluator, model, "", *zip(*played, strict=True))
        scoring.write(counted, scored)
        return f"{len(played)} rallies, {scored.length[~scored.filtered].mean():.1f} touches on average"

    return Step(name, "rallies", rallies, inputs, (counted,), run)


def make_blind_steps(
    folder: Path,
    seed: int,
    trainer: str,
    evaluator: str,
    runs_of: dict[str, Callable[[], Path]],
    inputs: tuple[Path, ...],
    robot: str,
    console: Console,
) -> list[Step]:
    """Two steps: policies under code names with a scoring sheet; then, the sheet filled in, its rallies.

    folder: of this evaluation; runs_of: each model's run. What is played is ``mjx-tt run FOLDER/policies/CODE``.
    """
    name = f"seed{seed}/blind/{trainer}-{evaluator}"
    key, sheet, counted = (folder / x for x in (blind_protocol.KEY, blind_protocol.SHEET, blind_protocol.EVALUATIONS))

    def make() -> str:
        if not key.exists():
            policies = {model: export_once(load_policy.load(run()), console) for model, run in runs_of.items()}
            # The ablation's oracle is a model of the loop under a second name.
            codes = blind_protocol.make(folder, policies, trainer, evaluator, seed, twice=True)
            return f"{len(codes)} policies as {', '.join(codes)}"
        blind_protocol.count_progress(folder)  # writes the sheet where it was killed in between
        return "policies under code names"

    def count() -> str:
        progress = blind_protocol.count_progress(folder)
        left = [f"{p.code} has {p.counted} of {scoring.KEEP}" for p in progress if not p.complete]
        if left:
            raise Waiting(
                f"{name}: {evaluator} plays rallies with "
                f"`mjx-tt run {folder / blind_protocol.POLICIES}/CODE --robot {robot}` and "
                f"writes each down in {sheet}; rallies that count: {', '.join(left)}. Then the same command continues"
            )
        return f"{len(blind_protocol.open_key(folder)):,} rallies"

    return [
        Step(name, "blind", 1, inputs, (key, sheet), make),
        Step(f"{name} counted", "blind", 1, (key,), (counted,), count),
    ]
