"""Items that a study makes for each player: human models, policies and the order in which they come about.

The ten models of the paper (appendix "Evaluation Methodology"), the variant whose weights stay in simulation (its
"Bringing the Fine-Tuned Model from the Real World Back to Simulation"), the variant that identifies its simulation, and
the ablation's hand-made distributions.
"""

from __future__ import annotations

from dataclasses import dataclass

from experiments.config.study import Study
from experiments.study.analysis.paper import CROSS, FINAL


@dataclass(frozen=True)
class Human:
    """A human model, fitted to data sets together."""

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
    world   that was identified; None: the study's model
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
POLICY_SUFFIXES = (("sim1", "ft35"), ("sim2", "ft65"), ("sim3", "ft100"))  # of each round


def loop_in(prefix: str, suffix: str, identify: bool = False) -> tuple[Item, ...]:
    """The loop's three rounds: a human model of the balls so far, simulation, fine-tuning, which adds balls.

    prefix: of the policies' keys; suffix: of the names of its own data sets and human models; identify: each round
    first identifies its world
    """
    items: list[Item] = []
    data, hits = ["D0"], list[str]()
    source: str | None = None
    for number, (sim, real) in enumerate(POLICY_SUFFIXES):
        human = Human("M0" if number == 0 else f"M{number}{suffix}", tuple(data))
        items += [human] if number else []
        world = f"world{number}" if identify else None
        items += [Identified(world, tuple(data), tuple(hits))] if world else []
        added = f"D{number + 1}{suffix}" if number < 2 else None
        items.append(Simulated(f"{prefix}-{sim}", human.name, source, number, world))
        items.append(Real(f"{prefix}-{real}", f"{prefix}-{sim}", number, added, identify and added is not None))
        source = f"{prefix}-{real}"
        data += [added] if added else []
        hits += [added] if added else []
    return tuple(items)


M0 = Human("M0", ("D0",))
LOOP: tuple[Item, ...] = (M0, *loop_in("is2r", ""))
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
CROSS_ORDER = (FINAL[0], FINAL[2], FINAL[1])  # in which cross-evaluations are played: their chance follows from it


def list_items(study: Study, player: str) -> tuple[Item, ...]:
    """Items made for a player, in an order in which everything comes after what it needs."""
    chosen = LOOP if study.baselines else (M0,)
    chosen += COMPARED if study.baselines is True else ()
    chosen += FRESH if study.fresh else ()
    chosen += loop_in("id", "-id", identify=True) if study.identification else ()
    if study.ablation and study.ablation.player == player:
        chosen += tuple(Simulated(balls, balls, None, None) for balls in study.ablation.balls)
    return chosen


def count_updates(study: Study, item: Simulated | Real) -> int:
    """Updates of an item's training or fine-tuning."""
    rounds = study.simulation.rounds
    if isinstance(item, Real):
        return rounds[item.round].real
    return sum(r.simulated for r in rounds) if item.round is None else rounds[item.round].simulated


def list_pairings(study: Study) -> list[tuple[str, str, str]]:
    """Trainer, evaluator and model of every evaluation."""
    found: list[tuple[str, str, str]] = []
    for trainer in study.players:
        keys = [item.key for item in list_items(study, trainer) if isinstance(item, Simulated | Real)]
        found += [(trainer, trainer, key) for key in keys]
    if study.evaluation.cross:
        for trainer in study.players:
            evaluators = [e for e in CROSS[trainer] if e in study.players]
            found += [(trainer, evaluator, key) for evaluator in evaluators for key in CROSS_ORDER]
    return found
