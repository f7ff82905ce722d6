"""Simulate, play, refine: the iterative loop of the paper with its baselines, as a resumable list of steps.

For every seed and player: balls without a robot, a human model, training in simulation, fine-tuning in reality while
the player's balls are measured, the next human model, and so on; then rallies of all models, and the report. Reality is
a virtual one (``target_domain.virtual``) or a robot with its operator (``target_domain.on_robot``).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from rich.console import Console

from ballmodel.distribution import load_distribution, save_distribution
from ballmodel.fit_distribution import fit_human
from ballmodel.flight import ball_params
from ballmodel.registry import Balls
from ballmodel.trajectory import Dataset
from experiments import measurements
from experiments.config import build
from experiments.config.study import RIG, Identification, Study
from experiments.errors import error_context
from experiments.runs import load_policy, run_dir
from experiments.runs.locate import SELECTION
from experiments.runs.run_dir import Run
from experiments.study import identification, training
from experiments.study.analysis import scoring
from experiments.study.paths import EVALUATIONS, JOINTS, POLICY, REPORT, StudyPaths
from experiments.study.schedule import (
    Human,
    Identified,
    Item,
    Real,
    Simulated,
    count_updates,
    list_items,
    list_pairings,
)
from experiments.study.target_domain import hidden_effects, on_robot
from experiments.study.target_domain.play_on_robot import make_blind_steps, make_rally_step
from experiments.study.target_domain.virtual import VirtualReality, VirtualWorld, play_rallies
from experiments.study.workflow import Step
from mjx_tt.diagnosis.logs import ROBOT_FILES
from mjx_tt.env.policy import Policy


class Pipeline:
    """All steps of a study in a folder."""

    def __init__(self, study: Study, folder: Path, console: Console) -> None:
        self.study, self.paths, self.console = study, StudyPaths(folder), console
        self._virtual: dict[int, VirtualWorld] = {}
        self._world: dict[int, VirtualWorld | on_robot.RobotWorld] = {}
        if study.robot is None:
            shared = VirtualReality(study, study.seeds[0])
            self._virtual = {seed: VirtualWorld(study, seed, shared) for seed in study.seeds}
            self._world.update(self._virtual)
        else:
            self._world = dict.fromkeys(study.seeds, on_robot.RobotWorld(study, study.robot, console))

    def steps(self) -> list[Step]:
        """Everything in the order in which it is done, the report at the end."""
        played = self.steps_of_play()
        return [*played, self._report(played)]

    def steps_of_play(self) -> list[Step]:
        """All that makes data."""
        study, found = self.study, []
        for seed in study.seeds:
            found += self._steps_of_seed(seed)
        found.append(self._join_evaluations(found))
        return found + ([] if study.robot else [self._open_reality(seed) for seed in study.seeds])

    def _steps_of_seed(self, seed: int) -> list[Step]:
        study, found = self.study, []
        if study.robot is None and study.identification is not None:
            found.append(self._log_joints(seed, study.identification.seconds))
        for player in study.players:
            found.append(self._first_balls(seed, player))
            found += [self._make_item(seed, player, item) for item in list_items(study, player)]
        if study.robot is None:
            found.append(self._evaluate(seed))
        else:
            found += self._play_on_rig(seed) if study.robot == RIG else self._play_blind(seed, study.robot)
        return found

    # -- realities and worlds

    def _open_reality(self, seed: int) -> Step:
        path, settings = self.paths.seed(seed) / "reality.yaml", self.study.reality

        def run() -> str:
            without, outside = tuple(settings.without), tuple(settings.outside)
            model = hidden_effects.draw(seed, without, outside)
            run_dir.write_yaml(path, hidden_effects.describe(model, seed, without, outside))
            return "opened"

        return Step(f"seed{seed}/reality", (self.paths.folder / EVALUATIONS,), (path,), run)

    def _log_joints(self, seed: int, seconds: float) -> Step:
        folder, name = self.paths.seed(seed) / JOINTS, f"seed{seed}/{JOINTS}"

        def run() -> str:
            records = self._virtual[seed].joint_log(seconds, name)
            identification.write_joints(folder, records)
            return f"{seconds:g} s of {len(records)} joints"

        return Step(name, (), tuple(folder / file for file in ROBOT_FILES), run)

    # -- the items of a player

    def _first_balls(self, seed: int, player: str) -> Step:
        path, name = self.paths.balls(seed, player, "D0"), f"seed{seed}/{player}/D0"

        def run() -> str:
            measured = self._world[seed].first_balls(player, name)
            measurements.write_csv(path, measured)
            return f"{len(measured):,} balls without a robot"

        return Step(name, (), (path,), run)

    def _make_item(self, seed: int, player: str, item: Item) -> Step:
        if isinstance(item, Human):
            return self._fit_human(seed, player, item)
        if isinstance(item, Identified):
            return self._identify(seed, player, item)
        return self._train(seed, player, item) if isinstance(item, Simulated) else self._fine_tune(seed, player, item)

    def _fit_human(self, seed: int, player: str, item: Human) -> Step:
        path = self.paths.human(seed, player, item.name)
        sources = tuple(self.paths.balls(seed, player, name) for name in item.data)

        def run() -> str:
            found = measurements.read_trajectories(list(sources))
            measured = Dataset(found.trajectories, " + ".join(item.data))  # wherever the study's folder lies
            label, short = f"{player}/{item.name}, seed {seed}", self.study.short_balls
            with error_context(str(path)):
                distribution, report = fit_human(measured, ball_params(), name=label, short_balls=short)
            save_distribution(path, distribution)
            return f"fitted to {report.landing.shape[1]:,} of {report.measured:,} balls"

        return Step(f"seed{seed}/{player}/{item.name}", sources, (path,), run)

    def _identify(self, seed: int, player: str, item: Identified) -> Step:
        settings = self.study.identification
        assert settings is not None  # its items are made with it alone
        path, name = self.paths.world(seed, player, item.name), f"seed{seed}/{player}/{item.name}"
        data = tuple(self.paths.balls(seed, player, d) for d in item.data)
        hits = tuple(self.paths.hits(seed, player, d) for d in item.hits)
        joints = self._joints_of(seed, hits, settings)
        motion = () if joints is None else tuple(joints / file for file in ROBOT_FILES)

        def run() -> str:
            believed = build.believed(self.study.simulation.model)
            prior = identification.read_prior(settings.prior, "identification.prior")
            with error_context(name):
                world = identification.identify(
                    [*data, *motion], settings.balls, believed, prior, hits, settings.seconds
                )
            world.save(path)
            made_of = (world.provenance or {})["identified"]
            doubt = "" if made_of["settled"] else "; the balls' fit did not settle: its intervals are wider by its step"
            return f"{made_of['flights']} flights, {made_of['hits']} hits{doubt}"

        inputs = (*data, *motion, *(folder / identification.BALLS for folder in hits))
        return Step(name, inputs, (path,), run)

    def _joints_of(self, seed: int, hits: tuple[Path, ...], settings: Identification) -> Path | None:
        """The log of the joints for an identification: from before the first ball; on a robot the newest play's."""
        if self.study.robot is None:
            return self.paths.seed(seed) / JOINTS
        if hits:
            return hits[-1]
        return None if settings.joints is None else Path(settings.joints)

    def _train(self, seed: int, player: str, item: Simulated) -> Step:
        folder, name = self.paths.model(seed, player, item.key), f"seed{seed}/{player}/{item.key}"
        human = self.paths.human(seed, player, item.balls) if item.balls.startswith("M") else None
        world = None if item.world is None else self.paths.world(seed, player, item.world)
        inputs: tuple[Path, ...] = tuple(path for path in (human, world) if path is not None)
        if item.source is not None:
            inputs += (self.paths.model(seed, player, item.source) / POLICY,)

        def run() -> str:
            source = None if item.source is None else self.paths.run(seed, player, item.source)
            score = self._world[seed].score(player, name)
            return training.train_seeds(self.study, item, folder, human, source, name, self.console, score, world)

        # An identified world is in the program.
        program = None if item.world else f"training of round {item.round} in the world as believed"
        compiled = Run(folder / "training" / "seed0").metrics
        return Step(name, inputs, (folder / POLICY, folder / SELECTION), run, program, compiled)

    def _fine_tune(self, seed: int, player: str, item: Real) -> Step:
        folder, name = self.paths.model(seed, player, item.key), f"seed{seed}/{player}/{item.key}"
        outputs: tuple[Path, ...] = (folder / POLICY,)
        if item.data is not None:
            outputs += (self.paths.balls(seed, player, item.data),)
        if item.data is not None and item.hits:
            outputs += (self.paths.hits(seed, player, item.data) / identification.BALLS,)

        def run() -> str:
            source, world = self.paths.run(seed, player, item.source), self._world[seed]
            strokes, text = world.fine_tune(player, source, count_updates(self.study, item), folder, name)
            if len(outputs) > 2:
                log = world.hits(player, source, folder, f"{name}/hits")
                identification.write_hits(outputs[2].parent, log.balls, log.joints)
            if len(outputs) > 1:
                measurements.write_csv(outputs[1], strokes)
            load_policy.load(folder).policy.save(folder / POLICY)
            return text

        inputs = (self.paths.model(seed, player, item.source) / POLICY,)
        return Step(name, inputs, outputs, run, "fine-tuning")

    # -- evaluations

    def _evaluate(self, seed: int) -> Step:
        pairings = list_pairings(self.study)
        models = [(trainer, model) for trainer, _, model in pairings]
        path = self.paths.seed(seed) / EVALUATIONS

        def run() -> str:
            reality, played = self._virtual[seed].reality, self._policies_and_balls(seed, models)
            rallies = play_rallies(self.study, reality, seed, pairings, *played)
            scoring.write(path, rallies)
            return f"{len(rallies):,} rallies, {rallies.length[~rallies.filtered].mean():.1f} touches on average"

        balls = sorted({(trainer, self._balls_of(trainer, model)) for trainer, model in models})
        humans = tuple(self.paths.human(seed, *one) for one in balls if one[1].startswith("M"))
        inputs = (*dict.fromkeys(self._policy_of(seed, *one) for one in models), *humans)
        return Step(f"seed{seed}/evaluation", inputs, (path,), run)

    def _play_on_rig(self, seed: int) -> list[Step]:
        """The evaluation on the rig, by its virtual players."""
        found = []
        for trainer, evaluator, model in list_pairings(self.study):
            policy, who = self._policy_of(seed, trainer, model), (seed, trainer, evaluator, model)
            run_of = partial(self.paths.run, seed, trainer, policy.parent.name)
            folder = self.paths.seed(seed) / "rallies" / "-".join(who[1:])
            found.append(make_rally_step(folder, who, run_of, (policy,), self.study.evaluation.rallies, self.console))
        return found

    def _play_blind(self, seed: int, robot: str) -> list[Step]:
        """The evaluation by people: for every trainer and evaluator a folder with code names and a scoring sheet."""
        found: list[Step] = []
        pairings = list_pairings(self.study)
        for trainer, evaluator in dict.fromkeys((t, e) for t, e, _ in pairings):
            models = [m for t, e, m in pairings if (t, e) == (trainer, evaluator)]
            policies = {m: self._policy_of(seed, trainer, m) for m in models}
            runs_of: dict[str, Callable[[], Path]] = {
                m: partial(self.paths.run, seed, trainer, path.parent.name) for m, path in policies.items()
            }
            folder = self.paths.seed(seed) / "blind" / f"{trainer}-{evaluator}"
            inputs = tuple(dict.fromkeys(policies.values()))
            found += make_blind_steps(folder, seed, trainer, evaluator, runs_of, inputs, robot, self.console)
        return found

    def _join_evaluations(self, before: list[Step]) -> Step:
        path = self.paths.folder / EVALUATIONS
        sources = tuple(p for step in before for p in step.outputs if p.name == EVALUATIONS)

        def run() -> str:
            rallies = scoring.join(map(scoring.read, sources))
            scoring.write(path, rallies)
            return f"{len(rallies):,} rallies"

        return Step("evaluations", sources, (path,), run)

    def _report(self, played: list[Step]) -> Step:
        inputs = tuple(p for step in played for p in step.outputs if p.suffix in (".csv", ".yaml", ".json"))

        def run() -> str:
            from experiments.study.report import page

            return str(page.write(self.paths.folder))

        return Step("report", inputs, (self.paths.folder / REPORT,), run)

    def _policy_of(self, seed: int, trainer: str, model: str) -> Path:
        return self.paths.model(seed, trainer, model) / POLICY

    def _balls_of(self, trainer: str, model: str) -> str:
        """Name of the balls that a policy was last trained on in simulation."""
        made = {item.key: item for item in list_items(self.study, trainer) if isinstance(item, Simulated | Real)}
        item = made[model]
        while isinstance(item, Real):
            item = made[item.source]
        return item.balls

    def _policies_and_balls(self, seed: int, models: Sequence[tuple[str, str]]) -> tuple[list[Policy], list[Balls]]:
        """The policies of (trainer, model), and the balls that each was last trained on in simulation."""
        policies, balls = [], []
        for trainer, model in models:
            policies.append(Policy.load(self._policy_of(seed, trainer, model)))
            name = self._balls_of(trainer, model)
            human = self.paths.human(seed, trainer, name)
            balls.append(load_distribution(human) if name.startswith("M") else build.distribution(name, model))
        return policies, balls
