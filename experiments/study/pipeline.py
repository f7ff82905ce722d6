"""Simulate, play, refine: the iterative loop of the paper with its baselines, as a resumable list of steps.

For every seed and player: balls without a robot, a human model, training in simulation, fine-tuning in reality while
the player's balls are measured, the next human model, and so on; then rallies of all models, and the report. Reality is
a virtual one (``target_domain.virtual``) or a robot with its operator (``target_domain.play_on_robot``). Trainings are
ordinary runs: several seeds of a model, the best in reality chosen.
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
from ballmodel.trajectory import Dataset
from experiments import measurements
from experiments.config import build
from experiments.config.experiment import Config, Evaluation, Training
from experiments.config.files import read_yaml
from experiments.config.study import RIG, Study
from experiments.errors import error_context
from experiments.runs import load_policy, run_dir
from experiments.runs.locate import SELECTION
from experiments.runs.run_dir import Run
from experiments.study import identification
from experiments.study.analysis import scoring
from experiments.study.paths import EVALUATIONS, JOINTS, POLICY, REPORT, StudyPaths
from experiments.study.schedule import Human, Identified, Real, Simulated, count_updates, list_items, list_pairings
from experiments.study.target_domain import hidden_effects
from experiments.study.target_domain.play_on_robot import RobotWorld, make_blind_steps, make_rally_step
from experiments.study.target_domain.virtual import VirtualReality, VirtualWorld, play_rallies
from experiments.study.workflow import Step, derive_seed
from experiments.training.loop import train
from mjx_tt.diagnosis.logs import ROBOT_FILES
from mjx_tt.env.policy import Policy


def make_config(
    study: Study, item: Simulated, balls: str | dict, source: Path | None, seed: int, world: Path | None = None
) -> Config:
    """The training YAML of a model: balls by name or content, initial policy from ``source``, the round's recipe.

    world: model YAML that was identified; None: the study's.
    """
    simulation = study.simulation
    recipe = simulation.rounds[item.round or 0]
    optimiser = simulation.optimiser
    if recipe.step is not None:
        optimiser = optimiser.model_copy(update={"step": recipe.step})
    training = Training(
        updates=count_updates(study, item),
        later_rewards=recipe.later_rewards,
        seed=seed,
        pool=simulation.pool,
        checkpoint_seconds=simulation.checkpoint_seconds,
        evaluate_every=None,
        devices=simulation.devices,
    )
    return Config(
        name=item.key,
        balls=balls,
        model=simulation.model if world is None else read_yaml(world.read_text(encoding="utf-8"), str(world)),
        task=simulation.task,
        optimiser=optimiser,
        training=training,
        evaluation=Evaluation(sim_rate=study.reality.sim_rate, reachable_balls=None),
        initial_policy=None if source is None else str(source.resolve()),
    )


class Pipeline:
    """All steps of a study in a folder."""

    def __init__(self, study: Study, folder: Path, console: Console) -> None:
        self.study, self.paths, self.console = study, StudyPaths(folder), console
        self._worlds: dict[int, Any]  # VirtualWorld or RobotWorld, by seed
        if study.robot is None:
            shared = VirtualReality(study, study.seeds[0])
            self._worlds = {seed: VirtualWorld(study, seed, shared) for seed in study.seeds}
        else:
            self._worlds = dict.fromkeys(study.seeds, RobotWorld(study, study.robot, console))

    def steps(self) -> list[Step]:
        """Everything in the order in which it is done, the report at the end."""
        played = self.steps_of_play()
        return [*played, self._report(played)]

    def steps_of_play(self) -> list[Step]:
        """All that makes data."""
        found = [step for seed in self.study.seeds for step in self._steps_of_seed(seed)]
        found.append(self._join_evaluations(found))
        return found + ([] if self.study.robot else [self._open_reality(seed) for seed in self.study.seeds])

    def _steps_of_seed(self, seed: int) -> list[Step]:
        study, found = self.study, []
        if study.robot is None and study.identification is not None:
            found.append(self._log_joints(seed, study.identification.seconds))
        for player in study.players:
            found.append(self._first_balls(seed, player))
            for item in list_items(study, player):
                match item:
                    case Human():
                        found.append(self._fit_human(seed, player, item))
                    case Identified():
                        found.append(self._identify(seed, player, item))
                    case Simulated():
                        found.append(self._train(seed, player, item))
                    case Real():
                        found.append(self._fine_tune(seed, player, item))
        if study.robot is None:
            return [*found, self._evaluate(seed)]
        return found + (self._play_on_rig(seed) if study.robot == RIG else self._play_blind(seed, study.robot))

    # -- realities

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
            records = self._worlds[seed].joint_log(seconds, name)
            identification.write_joints(folder, records)
            return f"{seconds:g} s of {len(records)} joints"

        return Step(name, (), tuple(folder / file for file in ROBOT_FILES), run)

    # -- the items of a player

    def _first_balls(self, seed: int, player: str) -> Step:
        path, name = self.paths.balls(seed, player, "D0"), f"seed{seed}/{player}/D0"

        def run() -> str:
            measured = self._worlds[seed].first_balls(player, name)
            measurements.write_csv(path, measured)
            return f"{len(measured):,} balls without a robot"

        return Step(name, (), (path,), run)

    def _fit_human(self, seed: int, player: str, item: Human) -> Step:
        path = self.paths.human(seed, player, item.name)
        sources = tuple(self.paths.balls(seed, player, name) for name in item.data)

        def run() -> str:
            found = measurements.read_trajectories(sources)
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
        # The log of the joints is from before the first ball; on a robot it is the newest play's.
        joints = settings.joints and Path(settings.joints)
        if self.study.robot is None:
            joints = self.paths.seed(seed) / JOINTS
        elif hits:
            joints = hits[-1]
        motion = tuple(joints / file for file in ROBOT_FILES) if joints else ()

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

    def _train(self, seed: int, player: str, item: Simulated) -> Step:
        """Trains every seed of a model, or goes on with them, and writes the policy that is best in reality."""
        folder, name = self.paths.model(seed, player, item.key), f"seed{seed}/{player}/{item.key}"
        human = self.paths.human(seed, player, item.balls) if item.balls.startswith("M") else None
        world = None if item.world is None else self.paths.world(seed, player, item.world)
        started = None if item.source is None else self._policy_of(seed, player, item.source)

        def run() -> str:
            source = None if item.source is None else self.paths.run(seed, player, item.source)
            score = self._worlds[seed].score(player, name) if self.study.simulation.seeds > 1 else None
            balls = item.balls if human is None else load_distribution(human).to_dict()
            scores: dict[str, float] = {}
            for k in range(self.study.simulation.seeds):
                chance = derive_seed(f"{name}/{k}")  # another one for every player, model and study seed
                config = make_config(self.study, item, balls, source, chance, world)
                experiment, run = build.experiment(config, name), Run(folder / "training" / f"seed{k}")
                run.check(experiment.config)
                if not run.trained(experiment.config):
                    train(experiment, run, self.console)
                if score is not None:
                    scores[f"seed{k}"] = score(load_policy.load(run.folder))
            best = max(scores, key=scores.__getitem__) if scores else "seed0"
            load_policy.load(folder / "training" / best).policy.save(folder / POLICY)
            run_dir.write_json(folder / SELECTION, {"best": f"training/{best}", "scores": scores})
            worth = f", worth {scores[best]:.2f} of 2 in reality" if scores else ""
            among = f", best of {len(scores)}" if len(scores) > 1 else ""
            return f"{count_updates(self.study, item)} updates{among}{worth}"

        inputs = tuple(path for path in (human, world, started) if path is not None)
        # An identified world is in the program.
        program = None if item.world else f"training of round {item.round} in the world as believed"
        compiled = Run(folder / "training" / "seed0").metrics
        return Step(name, inputs, (folder / POLICY, folder / SELECTION), run, program, compiled)

    def _fine_tune(self, seed: int, player: str, item: Real) -> Step:
        folder, name = self.paths.model(seed, player, item.key), f"seed{seed}/{player}/{item.key}"
        balls = item.data and self.paths.balls(seed, player, item.data)
        hits = item.data and item.hits and self.paths.hits(seed, player, item.data)

        def run() -> str:
            source, world = self.paths.run(seed, player, item.source), self._worlds[seed]
            strokes, text = world.fine_tune(player, source, count_updates(self.study, item), folder, name)
            if hits:
                log = world.hits(player, source, folder, f"{name}/hits")
                identification.write_hits(hits, log.balls, log.joints)
            if balls:
                measurements.write_csv(balls, strokes)
            load_policy.load(folder).policy.save(folder / POLICY)
            return text

        outputs = [folder / POLICY, *([balls] if balls else []), *([hits / identification.BALLS] if hits else [])]
        return Step(name, (self._policy_of(seed, player, item.source),), tuple(outputs), run, "fine-tuning")

    # -- evaluations

    def _evaluate(self, seed: int) -> Step:
        path, pairings = self.paths.seed(seed) / EVALUATIONS, list_pairings(self.study)
        policies = [self._policy_of(seed, trainer, model) for trainer, _, model in pairings]
        names = [self._balls_of(trainer, model) for trainer, _, model in pairings]
        humans = {
            (trainer, name): self.paths.human(seed, trainer, name)
            for (trainer, _, _), name in zip(pairings, names, strict=True)
            if name.startswith("M")
        }

        def run() -> str:
            balls = [
                load_distribution(humans[t, name]) if (t, name) in humans else build.distribution(name, model)
                for (t, _, model), name in zip(pairings, names, strict=True)
            ]
            reality, played = self._worlds[seed].reality, [Policy.load(path) for path in policies]
            rallies = play_rallies(self.study, reality, seed, pairings, played, balls)
            scoring.write(path, rallies)
            return f"{len(rallies):,} rallies, {rallies.length[~rallies.filtered].mean():.1f} touches on average"

        inputs = (*dict.fromkeys(policies), *humans.values())
        return Step(f"seed{seed}/evaluation", inputs, (path,), run)

    def _play_on_rig(self, seed: int) -> list[Step]:
        """The evaluation on the rig, by its virtual players."""
        found = []
        for who in list_pairings(self.study):
            trainer, _, model = who
            folder, run_of = self.paths.seed(seed) / "rallies" / "-".join(who), partial(self.paths.run, seed)
            inputs, rallies = (self._policy_of(seed, trainer, model),), self.study.evaluation.rallies
            found.append(
                make_rally_step(folder, (seed, *who), partial(run_of, trainer, model), inputs, rallies, self.console)
            )
        return found

    def _play_blind(self, seed: int, robot: str) -> list[Step]:
        """The evaluation by people: for every trainer and evaluator a folder with code names and a scoring sheet."""
        found: list[Step] = []
        pairings = list_pairings(self.study)
        for trainer, evaluator in dict.fromkeys((t, e) for t, e, _ in pairings):
            models = [m for t, e, m in pairings if (t, e) == (trainer, evaluator)]
            runs_of: dict[str, Callable[[], Path]] = {m: partial(self.paths.run, seed, trainer, m) for m in models}
            folder = self.paths.seed(seed) / "blind" / f"{trainer}-{evaluator}"
            inputs = tuple(self._policy_of(seed, trainer, m) for m in models)
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
