"""Items that a study makes for each player: human models, policies and the order in which they come about.

The ten models of the paper (appendix "Evaluation Methodology"), the variant whose weights stay in simulation (its
"Bringing the Fine-Tuned Model from the Real World Back to Simulation"), and the ablation's hand-made distributions.
"""

from __future__ import annotations

from dataclasses import dataclass

from experiments.config.study import Study


@dataclass(frozen=True)
class Human:
    """A human model: fitted to data sets together."""

    name: str
    data: tuple[str, ...]


@dataclass(frozen=True)
class Identified:
    """A world to train in: what data sets together, and the joints' log, say of the simulation.

    hits: data sets of whose play the robot's hits were logged as well
    """

    name: str
    data: tuple[str, ...]
    hits: tuple[str, ...] = ()


@dataclass(frozen=True)
class Simulated:
    """A policy trained in simulation.

    balls   a human model, or a distribution's name
    source  model whose weights it starts from; None: from scratch
    round   whose updates and recipe it has; None: the first round's recipe with the updates of all rounds
    world   that was identified, or PRIOR or REALITY; None: the study's model
    """

    key: str
    balls: str
    source: str | None
    round: int | None
    world: str | None = None


@dataclass(frozen=True)
class Real:
    """A policy fine-tuned in reality.

    data: name of the data set that the player's hits become; None: not used
    hits: before it is fine-tuned the policy plays some balls of which everything is logged: ball, joints, returns
    """

    key: str
    source: str
    round: int
    data: str | None = None
    hits: bool = False


Item = Human | Identified | Simulated | Real

M0 = Human("M0", ("D0",))
LOOP: tuple[Item, ...] = (
    M0,
    Simulated("is2r-sim1", "M0", None, 0),
    Real("is2r-ft35", "is2r-sim1", 0, "D1"),
    Human("M1", ("D0", "D1")),
    Simulated("is2r-sim2", "M1", "is2r-ft35", 1),
    Real("is2r-ft65", "is2r-sim2", 1, "D2"),
    Human("M2", ("D0", "D1", "D2")),
    Simulated("is2r-sim3", "M2", "is2r-ft65", 2),
    Real("is2r-ft100", "is2r-sim3", 2),
)
COMPARED: tuple[Item, ...] = (
    Real("s2r-ft65", "is2r-ft35", 1),
    Real("s2r-ft100", "s2r-ft65", 2),
    Simulated("oracle-sim", "M2", None, None),
    Real("oracle-ft", "oracle-sim", 2),
)
FRESH: tuple[Item, ...] = (
    Simulated("fresh-sim2", "M1", "is2r-sim1", 1),
    Real("fresh-ft65", "fresh-sim2", 1, "D2-fresh"),
    Human("M2-fresh", ("D0", "D1", "D2-fresh")),
    Simulated("fresh-sim3", "M2-fresh", "fresh-sim2", 2),
    Real("fresh-ft100", "fresh-sim3", 2),
)
IDENTIFIED: tuple[Item, ...] = (
    Identified("world0", ("D0",)),
    Simulated("id-sim1", "M0", None, 0, "world0"),
    Real("id-ft35", "id-sim1", 0, "D1-id", hits=True),
    Human("M1-id", ("D0", "D1-id")),
    Identified("world1", ("D0", "D1-id"), ("D1-id",)),
    Simulated("id-sim2", "M1-id", "id-ft35", 1, "world1"),
    Real("id-ft65", "id-sim2", 1, "D2-id", hits=True),
    Human("M2-id", ("D0", "D1-id", "D2-id")),
    Identified("world2", ("D0", "D1-id", "D2-id"), ("D1-id", "D2-id")),
    Simulated("id-sim3", "M2-id", "id-ft65", 2, "world2"),
    Real("id-ft100", "id-sim3", 2),
)
PRIOR, REALITY = "prior", "reality"  # worlds that need no measurement


def _in(world: str, prefix: str) -> tuple[Item, ...]:
    """The loop with all its simulations in one world."""
    sim1, sim2, sim3, ft35, ft65, ft100 = (f"{prefix}-{x}" for x in ("sim1", "sim2", "sim3", "ft35", "ft65", "ft100"))
    d1, d2, m1, m2 = (f"{name}-{prefix}" for name in ("D1", "D2", "M1", "M2"))
    return (
        Simulated(sim1, "M0", None, 0, world),
        Real(ft35, sim1, 0, d1),
        Human(m1, ("D0", d1)),
        Simulated(sim2, m1, ft35, 1, world),
        Real(ft65, sim2, 1, d2),
        Human(m2, ("D0", d1, d2)),
        Simulated(sim3, m2, ft65, 2, world),
        Real(ft100, sim3, 2),
    )


RANDOMISED, BOUND = _in(PRIOR, "prior"), _in(REALITY, "bound")
MODELS = (
    "is2r-sim1",
    "is2r-ft35",
    "is2r-sim2",
    "is2r-ft65",
    "is2r-sim3",
    "is2r-ft100",
    "s2r-ft65",
    "s2r-ft100",
    "oracle-sim",
    "oracle-ft",
)
CROSS_MODELS = ("is2r-ft100", "oracle-ft", "s2r-ft100")
CROSS = {  # trainer: evaluators, the paper's table of cross-evaluations
    "player1": ("player4", "player5"),
    "player2": ("player1", "player3"),
    "player3": ("player1", "player4"),
    "player4": ("player2", "player5"),
    "player5": ("player2", "player3"),
}
ORACLE = "oracle"  # the oracle's simulated policy under its name in the ablation


def items(study: Study, player: str) -> tuple[Item, ...]:
    """Items made for a player, in an order in which everything comes after what it needs."""
    chosen = (
        (LOOP if study.baselines else (M0,))
        + (COMPARED if study.baselines is True else ())
        + (FRESH if study.fresh else ())
        + (IDENTIFIED if study.identification else ())
    )
    chosen += (RANDOMISED if study.randomised else ()) + (BOUND if study.bound else ())
    if study.ablation and study.ablation.player == player:
        chosen += tuple(Simulated(balls, balls, None, None) for balls in study.ablation.balls)
    return chosen


def updates(study: Study, item: Simulated | Real) -> int:
    """Of an item's training or fine-tuning."""
    rounds = study.simulation.rounds
    if isinstance(item, Real):
        return rounds[item.round].real
    return sum(r.simulated for r in rounds) if item.round is None else rounds[item.round].simulated


def pairings(study: Study) -> list[tuple[str, str, str]]:
    """Trainer, evaluator and model of every evaluation."""
    found: list[tuple[str, str, str]] = []
    for trainer in study.players:
        own = [item.key for item in items(study, trainer) if isinstance(item, Simulated | Real)]
        if study.ablation and study.ablation.player == trainer:
            own.append(ORACLE)
        found += [(trainer, trainer, key) for key in own]
    if study.evaluation.cross:
        for trainer in study.players:
            evaluators = [e for e in CROSS[trainer] if e in study.players]
            found += [(trainer, evaluator, key) for evaluator in evaluators for key in CROSS_MODELS]
    return found
