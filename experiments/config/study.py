"""The typed YAML of a study: the iterative loop, its baselines and variants, for several players and seeds.

Needs neither JAX nor NumPy, as ``experiments.config.experiment``. The defaults are the paper's numbers (Abeyruwan et
al. 2022, appendices "Iterative-Sim-to-Real Procedure", "Training Hyperparameters" and "Evaluation Methodology").
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import Field, model_validator

from ballmodel.io.validation import Count, Name, Positive, Section, Seed
from experiments.config import experiment, files
from experiments.config.experiment import Different, LaterRewards, Task
from experiments.config.finetuning import FineTuning
from experiments.config.optimiser import Optimiser, Step
from experiments.config.prior import PRIOR

Player = Literal["player1", "player2", "player3", "player4", "player5"]
PLAYERS: tuple[Player, ...] = get_args(Player)
Effect = Literal["rubber", "table", "magnus", "spin", "noise", "latency", "camera", "drives", "encoders"]
Outside = Literal["lift", "bounce", "blade", "mount"]
RIG, LOCK_STEP = "rig", "lockstep"
FEWEST_ON_RIG = 5  # which plays in real time
FEWEST_RALLIES = 50  # of each model that are reported


class Round(Section):
    """A round of the loop: training in simulation, then fine-tuning in reality."""

    simulated: Count
    """Updates in simulation."""
    real: Count
    """Updates in reality."""
    step: Step | None = None
    """Step of the parameters in this round's simulation; null: the optimiser's."""
    later_rewards: LaterRewards | None = None
    """Other reward weights for the rest of this round's simulation; null: those of the task throughout."""


class Simulation(Section):
    """Training in simulation: what a training YAML says in its sections task, model, optimiser and training."""

    task: Task = Task(sim_rate=150.0)
    """The episode."""
    model: dict[str, Any] = {}
    """SimModel that training believes in, such as {sensing: {ball_noise: 0.02}}; may hold randomise."""
    optimiser: Optimiser = Optimiser()
    """Blackbox Gradient Sensing."""
    rounds: Annotated[list[Round], Field(min_length=3, max_length=3)]
    """The paper's three; fine-tuned 35 %, 65 % and 100 % are named after their 60, 70 and 70 real updates."""
    pool: Count = 65536
    """Balls drawn from the human model before a training."""
    seeds: Count = 3
    """Trainings per model; the one that does best in reality goes on."""
    selection_episodes: Count = 50
    """Balls in reality by which it is chosen."""
    checkpoint_seconds: Positive = 60.0
    """Least time between checkpoints."""
    devices: Count | Literal["auto"] = "auto"
    """Devices that share the perturbations; auto: as many as divide them evenly."""


class Reality(Section):
    """The virtual reality: effects that training does not know (``target_domain.hidden_effects``), drawn per seed."""

    without: list[Effect] = []
    """Effects that are left out: there, reality is what training believes."""
    outside: list[Outside] = []
    """Effects from outside of the model's class, which no identification can name; none of them by default."""
    sim_rate: Positive = 300.0
    """[Hz] of its physics."""
    camera_noise: Positive = 0.003
    """[m] standard deviation of each coordinate of a measured ball, from which the human model is fitted."""


class Ablation(Section):
    """Hand-made ball distributions against the oracle's, zero-shot, for one player."""

    player: Player = "player4"
    """Player whose balls the policies meet."""
    balls: list[str] = ["large", "medium", "narrow"]
    """The distributions by name."""


class Evaluation(Section):
    """Rallies of every model with its own player and with others."""

    rallies: Annotated[int, Field(ge=FEWEST_ON_RIG)] = 80
    """Played by each player with each model, 50 at least, on the rig 5; what is left after filtering is cut to the
    first 60, then to the longest 50, or five sixths of fewer."""
    lanes: Count = 8
    """Sessions side by side into which these rallies are divided."""
    max_touches: Count = 400
    """A rally that is longer ends there."""
    cross: bool = True
    """Also with the two other players of the paper's table."""


class Identification(Section):
    """Before each training in simulation: what the balls and joints measured so far say of the simulation."""

    seconds: Annotated[float, Field(ge=10.0)] = 60.0
    """[s] of joint motion that is looked at: recorded before the first ball, on a robot during its play as well."""
    joints: str | None = None
    """With a robot: a folder with command.csv and state.csv of all joints in motion, from before the first ball; null:
    until the first play the drives are drawn from the prior."""
    balls: Annotated[int, Field(ge=20)] = 400
    """Balls of all rounds so far that are looked at, drawn evenly, if there are more."""
    prior: dict[str, Any] = PRIOR
    """Ranges, as under randomise of a model YAML, of what may be wrong; used where the logs say nothing."""


class Study(Section):
    """One study."""

    name: Name
    """Folder of the study."""
    players: Different[Player] = list(PLAYERS)
    """Virtual players, or people in their places."""
    seeds: Different[Seed] = [0]
    """Repetitions of the whole study, each with another reality, other initial policies and other chance."""
    first_balls: Annotated[int, Field(ge=20)] = 200
    """Balls of D0: across the table, without a robot."""
    short_balls: bool = False
    """The human models draw balls as well that bounce twice on the robot's side, as people play them; false: balls that
    bounce once, as everywhere else."""
    simulation: Simulation
    """Training in simulation."""
    fine_tuning: FineTuning = FineTuning()
    """In reality; the number of updates is the round's, the seed the step's, and evaluation_balls are a robot's."""
    reality: Reality = Reality()
    """Effects of the virtual reality that training does not know."""
    baselines: bool | Literal["is2r"] = True
    """The paper's ten models; is2r: of these the loop's alone, to compare variants with it; false: the variants alone,
    without what they are compared with."""
    fresh: bool = True
    """Also the variant whose weights are not carried back from reality to simulation."""
    identification: Identification | None = None
    """Also the variant that learns its simulation from what each round measures; null: none. Not with
    the robot in lock-step, which logs no sessions."""
    ablation: Ablation | None = Ablation()
    """Hand-made ball distributions against the oracle's; null: none."""
    evaluation: Evaluation = Evaluation()
    """Rallies of every model."""
    robot: str | None = None
    """A robot.yaml, "rig" or "lockstep": reality is that robot and its operator; null: the virtual reality."""
    recordings: dict[Player, str] = {}
    """With a robot: each player's first balls as measured, a file that `mjx-tt fit-human` reads. On the rig a player
    without one serves them."""

    @model_validator(mode="after")
    def _complete(self) -> Study:
        if self.ablation and self.ablation.player not in self.players:
            raise ValueError(
                f"ablation.player {self.ablation.player!r} is none of the players of this study; "
                f"allowed: {', '.join(self.players)}, or no ablation at all (ablation: null)"
            )
        rallies, lanes = self.evaluation.rallies, self.evaluation.lanes
        if rallies < FEWEST_RALLIES and self.robot != RIG:
            raise ValueError(
                f"evaluation.rallies {rallies} is less than {FEWEST_RALLIES}, which are reported; fewer are allowed "
                f"with robot: {RIG} alone"
            )
        if rallies % lanes and self.robot is None:
            more = lanes * (rallies // lanes + 1)
            near = f"{more - lanes} or {more}" if more - lanes >= FEWEST_RALLIES else more
            raise ValueError(
                f"evaluation.rallies {rallies} is no multiple of its lanes {lanes} (evaluation.lanes); "
                f"the nearest that is allowed: {near}"
            )
        if self.robot == LOCK_STEP and self.identification is not None:
            raise ValueError(
                "identification: the robot in lock-step logs no session; take robot: rig, or leave it null"
            )
        if self.identification is not None and self.identification.joints is not None and self.robot is None:
            raise ValueError("identification.joints: the virtual reality records its own; leave it null")
        if self.baselines is not True:
            compares = {"ablation": self.ablation, "evaluation.cross": self.evaluation.cross}
            compares["fresh"] = self.fresh and not self.baselines
            for key in filter(compares.get, compares):
                chosen = self.baselines or "false"
                raise ValueError(f"{key}: compares the paper's models, and baselines is {chosen}; leave it out, too")
        if not (self.baselines or self.identification):
            raise ValueError("baselines: false leaves nothing to do without identification")
        self._no_fine_tuning_in_vain()
        simulation = self.simulation
        later = {f"simulation.rounds.{k}.later_rewards": r.later_rewards for k, r in enumerate(simulation.rounds)}
        experiment.refuse_rewards(simulation.optimiser, simulation.task, "simulation.", later)
        missing = [player for player in self.players if player not in self.recordings]
        if self.robot not in (None, RIG) and missing:
            files = ", ".join(f"{player}: FILE" for player in missing)
            raise ValueError(
                f"with a robot, recordings of the first balls of {', '.join(missing)} are needed: "
                f"recordings: {{{files}}}, files that `mjx-tt fit-human` reads"
            )
        return self

    def _no_fine_tuning_in_vain(self) -> None:
        """Raises ValueError for settings of fine-tuning that the study would not use."""
        chosen, default = self.fine_tuning, FineTuning()
        if chosen.seed != default.seed:
            raise ValueError(
                f"fine_tuning.seed {chosen.seed}: each step's chance follows from its name and the study's seeds; "
                "leave it out"
            )
        if self.robot is None and chosen.evaluation_balls != default.evaluation_balls:
            raise ValueError(
                f"fine_tuning.evaluation_balls {chosen.evaluation_balls}: played on a robot alone, to compare before "
                "and after; leave it out, evaluation.rallies compares all policies"
            )

    def recording(self, player: str) -> str:
        """File of a player's first balls. Raises KeyError where there is none."""
        return dict[str, str](self.recordings.items())[player]


def load(path: str | os.PathLike, overrides: tuple[str, ...] = ()) -> Study:
    """Reads a study; ``overrides`` are "dotted.path=value".

    Relative paths in the file are relative to its folder, those of overrides to the current one. Raises ConfigError.
    """
    return files.load(Study, "a study", path, overrides, _absolute)


def _absolute(data: dict[str, Any], folder: Path) -> None:
    if data.get("robot") not in (RIG, LOCK_STEP):
        files.make_absolute(data, ("robot",), folder)
    files.make_absolute(data.get("recordings"), PLAYERS, folder)
    files.make_absolute(data.get("identification"), ("joints",), folder)
    if isinstance(data.get("simulation"), dict):
        experiment.absolute_samples(data["simulation"].get("model"), folder)


def parse(data: dict[str, Any], where: str) -> Study:
    """A Study from parsed YAML; ``where`` names its origin. Raises ConfigError with one line per mistake."""
    return files.validate(Study, data, where)
