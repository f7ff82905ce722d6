"""Simulate, play, refine: the iterative loop of the paper with its baselines, as a resumable list of steps.

For every seed and player: balls without a robot, a human model, training in simulation, fine-tuning in reality while
the player's balls are measured, the next human model, and so on; then rallies of all models, and the report. Reality is
a virtual one (``target_domain.finetuning``) or a robot with its operator (``target_domain.on_robot``).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from ballmodel.distribution import load_distribution, save_distribution
from ballmodel.fit_distribution import fit_human
from ballmodel.flight import ball_params
from ballmodel.registry import Balls
from ballmodel.trajectory import Dataset
from experiments import measurements
from experiments.config import build
from experiments.config.study import RIG, Identification, Study
from experiments.errors import RunError, checked
from experiments.runs import load_policy, run_dir
from experiments.runs.locate import SELECTION
from experiments.runs.run_dir import Run
from experiments.study import evaluation, identification, training
from experiments.study.analysis import effect_costs, scoring
from experiments.study.analysis import study_folder as study_data
from experiments.study.analysis.identified import estimates
from experiments.study.blind import protocol
from experiments.study.places import Places
from experiments.study.schedule import (
    ORACLE,
    PRIOR,
    REALITY,
    Human,
    Identified,
    Item,
    Real,
    Simulated,
    items,
    pairings,
    updates,
)
from experiments.study.target_domain import hidden_effects as realities
from experiments.study.target_domain import on_robot
from experiments.study.target_domain.evaluation_on_robot import blind_steps, rally_step
from experiments.study.target_domain.finetuning import VirtualReality
from experiments.study.target_domain.world import VirtualWorld, World
from experiments.study.training import POLICY
from experiments.study.workflow import Step
from mjx_tt.diagnosis.logs import ROBOT_FILES
from mjx_tt.env.policy import Policy
from mjx_tt.sim.model import ModelFile

CONVERGENCE = "convergence.json"
JOINTS = "joints"
REPORT = Path("report") / "index.html"


class Loop(Places):
    """All steps of a study in a folder."""

    def __init__(self, study: Study, folder: Path, console: Console) -> None:
        super().__init__(folder)
        self.study, self.console = study, console
        self._virtual: dict[int, VirtualWorld] = {}
        self._world: dict[int, World] = {}
        if study.robot is None:
            shared = VirtualReality(study, study.seeds[0])
            self._virtual = {seed: VirtualWorld(study, seed, shared) for seed in study.seeds}
            self._world.update(self._virtual)
        else:
            self._world = dict.fromkeys(study.seeds, on_robot.RobotWorld(study, study.robot, console))

    # -- steps ---------------------------------------------------------------------------------------------------------

    def steps(self) -> list[Step]:
        """Everything in the order in which it is done, the report at the end."""
        played = self.steps_of_play()
        return [*played, self._report(played)]

    def _report(self, played: list[Step]) -> Step:
        path = self.folder / REPORT
        inputs = tuple(p for step in played for p in step.outputs if p.suffix in (".csv", ".yaml", ".json"))

        def run() -> str:
            from experiments.study.report import page as study_report

            return str(study_report.write(self.folder))

        return Step("report", "report", 1, inputs, (path,), run)

    def steps_of_play(self) -> list[Step]:
        """All that makes data."""
        found: list[Step] = []
        for seed in self.study.seeds:
            if self.study.robot is None:
                found.append(self._seal(seed))
                if self.study.identification is not None:
                    found.append(self._joints(seed, self.study.identification.seconds))
            if self.study.randomised:
                found.append(self._prior(seed))
            for player in self.study.players:
                found.append(self._first_balls(seed, player))
                if self.study.bound:
                    found.append(self._bound(seed, player))
                for item in items(self.study, player):
                    found.append(self._step(seed, player, item))
                if self.study.baselines:
                    found.append(self._convergence(seed, player))
            if self.study.robot is None:
                found.append(self._evaluate(seed))
            else:
                found += self._rallies(seed) if self.study.robot == RIG else self._blind(seed, self.study.robot)
            if self.study.robot is None and self.study.evaluation.effects:
                found.append(self._effects(seed))
        found.append(self._collect(found))
        if self.study.robot is None:
            found += map(self._open, self.study.seeds)
        return found

    def _seal(self, seed: int) -> Step:
        path = self.seed_folder(seed) / "reality.sealed"

        def run() -> str:
            path.parent.mkdir(parents=True, exist_ok=True)
            return f"sealed with SHA-256 {protocol.seal(path, self._reality(seed))[:16]}..."

        return Step(f"seed{seed}/reality", "seal", 1, (), (path,), run)

    def _reality(self, seed: int) -> dict[str, Any]:
        without, outside = tuple(self.study.reality.without), tuple(self.study.reality.outside)
        return realities.content(realities.draw(seed, without, outside), seed, without, outside)

    def _open(self, seed: int) -> Step:
        sealed, path = (self.seed_folder(seed) / f"reality.{kind}" for kind in ("sealed", "yaml"))

        def run() -> str:
            content = protocol.unseal(sealed)
            if content != self._reality(seed):
                raise RunError(f"{sealed}: holds another reality than the one of seed {seed} in which was played")
            run_dir.write_yaml(path, content)
            return "opened"

        return Step(
            f"seed{seed}/reality opened", "seal", 1, (sealed, self.folder / evaluation.EVALUATIONS), (path,), run
        )

    def _prior(self, seed: int) -> Step:
        path, settings = self.world(seed, "", PRIOR), self.study.identification or Identification()

        def run() -> str:
            path.parent.mkdir(parents=True, exist_ok=True)
            world = identification.unknown(self.study.simulation.model, settings.prior)
            world.save(path)
            return f"{len(world.randomise)} parameters drawn"

        return Step(f"seed{seed}/{PRIOR}", "worlds", 1, (), (path,), run)

    def _bound(self, seed: int, player: str) -> Step:
        path, name = self.world(seed, player, REALITY), f"seed{seed}/{player}/{REALITY} as a world"

        def run() -> str:
            path.parent.mkdir(parents=True, exist_ok=True)
            ModelFile(self._virtual[seed].with_spin(player, name)).save(path)
            return "for the bound alone"

        return Step(name, "worlds", 1, (), (path,), run)

    def _first_balls(self, seed: int, player: str) -> Step:
        path, name = self.data(seed, player, "D0"), f"seed{seed}/{player}/D0"

        def run() -> str:
            measured = self._world[seed].first_balls(player, name)
            path.parent.mkdir(parents=True, exist_ok=True)
            measurements.write_csv(path, measured)
            return f"{len(measured):,} balls without a robot"

        return Step(name, "first balls", 1, (), (path,), run)

    def _step(self, seed: int, player: str, item: Item) -> Step:
        if isinstance(item, Human):
            return self._fit(seed, player, item)
        if isinstance(item, Identified):
            return self._identified(seed, player, item)
        return self._simulated(seed, player, item) if isinstance(item, Simulated) else self._real(seed, player, item)

    def _fit(self, seed: int, player: str, item: Human) -> Step:
        path, sources = self.human(seed, player, item.name), tuple(self.data(seed, player, name) for name in item.data)

        def run() -> str:
            found = measurements.read_trajectories(list(sources))
            measured = Dataset(found.trajectories, " + ".join(item.data))  # wherever the study's folder lies
            fit = partial(fit_human, name=f"{player}/{item.name}, seed {seed}", short_balls=self.study.short_balls)
            distribution, report = checked(str(path), fit, measured, ball_params())
            save_distribution(path, distribution)
            return f"fitted to {report.landing.shape[1]:,} of {report.measured:,} balls"

        return Step(f"seed{seed}/{player}/{item.name}", "human model", len(sources), sources, (path,), run)

    def _joints(self, seed: int, seconds: float) -> Step:
        folder, name = self.seed_folder(seed) / JOINTS, f"seed{seed}/{JOINTS}"

        def run() -> str:
            records = self._virtual[seed].joint_log(seconds, name)
            identification.write_joints(folder, records)
            return f"{seconds:g} s of {len(records)} joints"

        return Step(name, "joints", 1, (), tuple(folder / file for file in ROBOT_FILES), run)

    def _identified(self, seed: int, player: str, item: Identified) -> Step:
        settings = self.study.identification
        assert settings is not None  # its items are made with it alone
        path, name = self.world(seed, player, item.name), f"seed{seed}/{player}/{item.name}"
        data, hits = (
            tuple(place(seed, player, d) for d in names)
            for place, names in ((self.data, item.data), (self.hits, item.hits))
        )
        joints = self._joints_of(seed, hits, settings)
        moved = () if joints is None else tuple(joints / file for file in ROBOT_FILES)

        def run() -> str:
            believed = build.believed(self.study.simulation.model)
            before = identification.prior(settings.prior, "identification.prior")
            found = checked(
                name, identification.identify, [*data, *moved], settings.balls, believed, before, hits, settings.seconds
            )
            path.parent.mkdir(parents=True, exist_ok=True)
            found.world.save(path)
            count = len(estimates(found.world))
            doubt = "" if found.settled else "; the balls' fit did not settle: its intervals are wider by its last step"
            return f"{found.flights} flights, {found.hits} hits; {count} parameters moved or drawn{doubt}"

        inputs = (*data, *moved, *(folder / identification.BALLS for folder in hits))
        return Step(name, "identification", len(data), inputs, (path,), run)

    def _joints_of(self, seed: int, hits: tuple[Path, ...], settings: Identification) -> Path | None:
        """The log of the joints for an identification: from before the first ball; on a robot the newest play's."""
        if self.study.robot is None:
            return self.seed_folder(seed) / JOINTS
        if hits:
            return hits[-1]
        return None if settings.joints is None else Path(settings.joints)

    def _simulated(self, seed: int, player: str, item: Simulated) -> Step:
        folder, name = self.model_folder(seed, player, item.key), f"seed{seed}/{player}/{item.key}"
        human = self.human(seed, player, item.balls) if item.balls.startswith("M") else None
        world = None if item.world is None else self.world(seed, player, item.world)
        inputs: tuple[Path, ...] = tuple(path for path in (human, world) if path is not None)
        if item.source is not None:
            inputs += (self.model_folder(seed, player, item.source) / POLICY,)

        def run() -> str:
            source = None if item.source is None else self.run_of(seed, player, item.source)
            score = self._world[seed].score(player, name)
            return training.simulate(self.study, item, folder, human, source, name, self.console, score, world)

        optimiser = self.study.simulation.optimiser
        work = updates(self.study, item) * optimiser.num_directions * optimiser.repeats * self.study.simulation.seeds
        own = item.world not in (None, PRIOR)  # a world of one player is in the program
        program = None if own else f"training of round {item.round} in {item.world or 'the world as believed'}"
        compiled = Run(folder / "training" / "seed0").metrics
        return Step(name, "training", work, inputs, (folder / POLICY, folder / SELECTION), run, program, compiled)

    def _real(self, seed: int, player: str, item: Real) -> Step:
        folder, name = self.model_folder(seed, player, item.key), f"seed{seed}/{player}/{item.key}"
        data = None if item.data is None else self.data(seed, player, item.data)
        hits = self.hits(seed, player, item.data) if item.hits and item.data is not None else None

        def run() -> str:
            source = self.run_of(seed, player, item.source)
            strokes, text = self._world[seed].fine_tune(player, source, updates(self.study, item), folder, name)
            if hits is not None:
                log = self._world[seed].hits(player, source, folder, f"{name}/hits")
                identification.write_hits(hits, log.balls, log.joints)
            if data is not None:
                measurements.write_csv(data, strokes)
            load_policy.load(folder).policy.save(folder / training.POLICY)
            return text

        written = None if hits is None else hits / identification.BALLS
        outputs = (folder / POLICY, *(path for path in (data, written) if path is not None))
        inputs = (self.model_folder(seed, player, item.source) / POLICY,)
        return Step(name, "fine-tuning", updates(self.study, item), inputs, outputs, run, "fine-tuning")

    def _convergence(self, seed: int, player: str) -> Step:
        sources = {name: self.human(seed, player, name) for name in ("M0", "M1", "M2")}
        path = self.seed_folder(seed) / player / CONVERGENCE

        def run() -> str:
            fitted = {name: load_distribution(source) for name, source in sources.items()}
            scale, pairs = study_data.widths(fitted), (("M0", "M1"), ("M1", "M2"))
            first, second = (study_data.change(fitted[a], fitted[b], scale) for a, b in pairs)
            content = {"mean change of the 16 numbers over their ranges": {"M0-M1": first, "M1-M2": second}}
            run_dir.write_json(path, content | {"converging": second < first})
            return f"human model changed by {first:.1%}, then by {second:.1%} of its range"

        return Step(f"seed{seed}/{player}/convergence", "convergence", 1, tuple(sources.values()), (path,), run)

    def _evaluate(self, seed: int) -> Step:
        pairs = pairings(self.study)
        places = [self._policy_of(seed, trainer, model) for trainer, _, model in pairs]
        path = self.seed_folder(seed) / evaluation.EVALUATIONS
        logs = self.folder / evaluation.LOGS

        def run() -> str:
            lanes, reality = self.study.evaluation.lanes, self._virtual[seed].reality
            policies = [Policy.load(place.parent / training.POLICY) for place in places]
            boxes = [self._box(seed, trainer, model) for trainer, _, model in pairs]
            result = evaluation.play(self.study, reality, seed, pairs, policies, boxes)
            codes = evaluation.code_names(seed, pairs)
            evaluation.save_logs(logs, seed, pairs, result, lanes)
            rallies = evaluation.rallies_of(seed, pairs, codes, result, lanes)
            scoring.write(path, rallies)
            lengths = ", ".join(f"{model} {length:.1f}" for model, length in evaluation.summary(rallies).items())
            return f"{len(rallies):,} rallies; mean length: {lengths}"

        boxes_of = {self._human_of(trainer, model) for trainer, _, model in pairs}
        human = tuple(self.human(seed, *one) for one in sorted(boxes_of) if one[1].startswith("M"))
        inputs = (*dict.fromkeys(places), *human)
        return Step(f"seed{seed}/evaluation", "evaluation", len(pairs), inputs, (path,), run)

    def _effects(self, seed: int) -> Step:
        models: list[tuple[str, str]] = [
            (player, model) for player in self.study.players for model in effect_costs.MODELS
        ]
        places = [self._policy_of(seed, player, model) for player, model in models]
        path = self.seed_folder(seed) / effect_costs.FILE

        def run() -> str:
            policies = [Policy.load(place.parent / training.POLICY) for place in places]
            boxes = [self._box(seed, player, model) for player, model in models]
            found = evaluation.play_without(self.study, self._virtual[seed].reality, seed, models, policies, boxes)
            effect_costs.write(path, found)
            return f"{sum(o.rallies for o in found):,} rallies in {len(effect_costs.WORLDS)} worlds"

        human = tuple(self.human(seed, player, name) for player in self.study.players for name in ("M0", "M1", "M2"))
        work = len(models) * len(effect_costs.WORLDS)
        return Step(f"seed{seed}/effects", "effects", work, (*places, *human), (path,), run)

    def _policy_of(self, seed: int, trainer: str, model: str) -> Path:
        return self.model_folder(seed, trainer, "oracle-sim" if model == ORACLE else model) / POLICY

    def _box(self, seed: int, trainer: str, model: str) -> Balls:
        """The balls that a policy was last trained on in simulation."""
        _, balls = self._human_of(trainer, model)
        human = self.human(seed, trainer, balls)
        return load_distribution(human) if balls.startswith("M") else build.distribution(balls, model)

    def _human_of(self, trainer: str, model: str) -> tuple[str, str]:
        """The trainer, and the name of the balls that a policy was last trained on in simulation."""
        made = {item.key: item for item in items(self.study, trainer) if isinstance(item, Simulated | Real)}
        item = made["oracle-sim" if model == ORACLE else model]
        while isinstance(item, Real):
            item = made[item.source]
        return trainer, item.balls

    def _rallies(self, seed: int) -> list[Step]:
        """The evaluation on the rig, by its virtual players."""
        found = []
        for trainer, evaluator, model in pairings(self.study):
            policy, who = self._policy_of(seed, trainer, model), (seed, trainer, evaluator, model)
            run_of = partial(self.run_of, seed, trainer, policy.parent.name)
            folder = self.seed_folder(seed) / "rallies" / "-".join(who[1:])
            rallies = self.study.evaluation.rallies
            found.append(rally_step(folder, who, run_of, (policy,), rallies, self.console))
        return found

    def _blind(self, seed: int, robot: str) -> list[Step]:
        """The evaluation by people: for every trainer and evaluator a folder with code names and a scoring sheet."""
        found: list[Step] = []
        pairs = pairings(self.study)
        for trainer, evaluator in dict.fromkeys((t, e) for t, e, _ in pairs):
            models = [m for t, e, m in pairs if (t, e) == (trainer, evaluator)]
            places = {m: self._policy_of(seed, trainer, m) for m in models}
            runs_of: dict[str, Callable[[], Path]] = {
                m: partial(self.run_of, seed, trainer, place.parent.name) for m, place in places.items()
            }
            folder = self.seed_folder(seed) / "blind" / f"{trainer}-{evaluator}"
            inputs = tuple(dict.fromkeys(places.values()))
            found += blind_steps(folder, seed, trainer, evaluator, runs_of, inputs, robot, self.console)
        return found

    def _collect(self, before: list[Step]) -> Step:
        path = self.folder / evaluation.EVALUATIONS
        sources = tuple(p for step in before for p in step.outputs if p.name == evaluation.EVALUATIONS)

        def run() -> str:
            rallies = scoring.join(map(scoring.read, sources))
            scoring.write(path, rallies)
            return f"{len(rallies):,} rallies"

        return Step("evaluations", "evaluations", len(sources), sources, (path,), run)
