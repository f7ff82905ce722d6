"""The paper's study as data: its models, players and trainer/evaluator table, and what it claims, each with its place.

Abeyruwan et al. 2022, "i-Sim2Real". Its ball distributions and player skills are those of ``ballmodel.registry``. The
figures are published as pictures only, so a claim's number is one that the text states.
"""

from __future__ import annotations

from dataclasses import dataclass

from ballmodel import registry

IS2R, S2R, ORACLE, FRESH, ABLATION = "i-S2R", "S2R", "S2R-Oracle", "i-S2R, weights not carried back", "ablation"
IDENTIFIED, RANDOMISED, BOUND = "i-S2R with identification", "i-S2R in worlds of the prior", "i-S2R in reality itself"


@dataclass(frozen=True)
class Model:
    """One trained policy of a player.

    key: name in a study's folder; label: the paper's; method: IS2R, S2R, ...; real: share of the real training budget
    """

    key: str
    label: str
    method: str
    real: float
    fine_tuned: bool


MODELS = (
    Model("is2r-sim1", "i-S2R sim 1", IS2R, 0.0, False),
    Model("is2r-ft35", "i-S2R fine-tuned 35 %", IS2R, 0.35, True),
    Model("is2r-sim2", "i-S2R sim 2", IS2R, 0.35, False),
    Model("is2r-ft65", "i-S2R fine-tuned 65 %", IS2R, 0.65, True),
    Model("is2r-sim3", "i-S2R sim 3", IS2R, 0.65, False),
    Model("is2r-ft100", "i-S2R fine-tuned 100 %", IS2R, 1.0, True),
    Model("s2r-ft65", "S2R fine-tuned 65 %", S2R, 0.65, True),
    Model("s2r-ft100", "S2R fine-tuned 100 %", S2R, 1.0, True),
    Model("oracle-sim", "S2R-Oracle sim", ORACLE, 0.0, False),
    Model("oracle-ft", "S2R-Oracle fine-tuned", ORACLE, 0.35, True),
)
"""The ten models that every player trains and evaluates, in the paper's order (Evaluation Methodology)."""
VARIANT = (
    Model("fresh-sim2", "sim 2, weights not carried back", FRESH, 0.35, False),
    Model("fresh-ft65", "fine-tuned 65 %, weights not carried back", FRESH, 0.65, True),
    Model("fresh-sim3", "sim 3, weights not carried back", FRESH, 0.65, False),
    Model("fresh-ft100", "fine-tuned 100 %, weights not carried back", FRESH, 1.0, True),
)
"""The variant that the paper leaves to future work: simulation goes on from its own weights."""


def _rounds(prefix: str, method: str, world: str) -> tuple[Model, ...]:
    return (
        Model(f"{prefix}-sim1", f"sim 1, {world}", method, 0.0, False),
        Model(f"{prefix}-ft35", f"fine-tuned 35 %, {world}", method, 0.35, True),
        Model(f"{prefix}-sim2", f"sim 2, {world}", method, 0.35, False),
        Model(f"{prefix}-ft65", f"fine-tuned 65 %, {world}", method, 0.65, True),
        Model(f"{prefix}-sim3", f"sim 3, {world}", method, 0.65, False),
        Model(f"{prefix}-ft100", f"fine-tuned 100 %, {world}", method, 1.0, True),
    )


LEARNED = {
    "prior": _rounds("prior", RANDOMISED, "worlds of the prior"),
    "id": _rounds("id", IDENTIFIED, "identified"),
    "bound": _rounds("bound", BOUND, "reality itself"),
}
"""The variants that train in other worlds than the one that was believed: drawn from a prior; learned from what each
round measures, which the paper does by hand; the reality itself."""
OTHER_WORLDS = tuple(model for rounds in LEARNED.values() for model in rounds)
ABLATED = tuple(Model(key, key.capitalize(), ABLATION, 0.0, False) for key in ("large", "medium", "narrow", "oracle"))
"""Zero-shot policies of the ablation of the ball distribution, one player."""
BY_KEY = {model.key: model for model in (*MODELS, *VARIANT, *OTHER_WORLDS, *ABLATED)}
TEN = tuple(model.key for model in MODELS)
FINAL = ("is2r-ft100", "s2r-ft100", "oracle-ft")
"""The methods' final policies, in the order of the paper's figures; these are cross-evaluated."""
LAST = (*FINAL, *(rounds[-1].key for rounds in LEARNED.values()))
"""These and the final policies of the variants that train in other worlds."""
SHORT = {
    "is2r-ft100": "i-S2R",
    "s2r-ft100": "S2R+FT",
    "oracle-ft": "S2R-Oracle+FT",
    "prior-ft100": "in the prior",
    "id-ft100": "identified",
    "bound-ft100": "in reality",
}

CROSS = {
    "player1": ("player4", "player5"),
    "player2": ("player1", "player3"),
    "player3": ("player1", "player4"),
    "player4": ("player2", "player5"),
    "player5": ("player2", "player3"),
}
"""Trainer and its two cross-evaluators (table cross_eval)."""
BY_SKILL = ("player3", "player5", "player4", "player2", "player1")
"""From the lowest to the highest mean rally (table player_skill), the order of the paper's figures by player."""
LEVELS = ("beginner", "intermediate", "advanced")
RALLIES = 50
"""Rallies that an evaluation reports."""


def level(player: str) -> str:
    """Skill level of a player (table player_skill). Raises ValueError for an unknown name."""
    return registry.skill(player).level


def of_level(name: str) -> tuple[str, ...]:
    """Players of a level, of "all", or of "without the advanced"."""
    if name == "all":
        return BY_SKILL
    if name == WITHOUT:
        return tuple(p for p in BY_SKILL if level(p) != "advanced")
    return tuple(p for p in BY_SKILL if level(p) == name)


WITHOUT = "all but the advanced"
GROUPS = ("all", *LEVELS, WITHOUT)


@dataclass(frozen=True)
class Claim:
    """Something that the paper says.

    key: by which ``study_claims`` measures it; text: the claim in our words; source: where it stands;
    value: its number where the text states one, in the quantity's own unit; quantity: what is measured here
    """

    key: str
    text: str
    source: str
    quantity: str
    value: float | None = None


_FIG_ALL = "Figure all_player_results"
_FIG_SKILL = "Figure main_summary_by_skill_level, results (1)"
_FIG_CURVES = "Figure main_training_curves, results (2)"
_SIGNIFICANCE = "Appendix Additional Results, Statistical Significance"
_CROSS = "Figure main_cross_eval_summary, results (4)"
_RATIO = "mean rally length, i-S2R / S2R+FT"

CLAIMS = (
    Claim(
        "all-ratio",
        "Over all players, i-S2R's rallies are about 9 % longer than those of S2R+FT.",
        f"{_FIG_ALL} (left)",
        _RATIO,
        1.09,
    ),
    Claim("all-raw", "The unnormalised means of i-S2R and S2R+FT do not differ significantly.", _SIGNIFICANCE, _RATIO),
    Claim(
        "all-normalised",
        "Normalised by player, i-S2R is better than S2R+FT in mean, median and both quartiles.",
        f"{_FIG_ALL} (centre)",
        "normalised rally length, i-S2R minus S2R+FT",
    ),
    Claim(
        "all-oracle",
        "Normalised by player, S2R-Oracle+FT is significantly better than S2R+FT.",
        _SIGNIFICANCE,
        "normalised rally length, S2R-Oracle+FT minus S2R+FT",
    ),
    Claim(
        "short",
        "More of S2R+FT's rallies than of i-S2R's are shorter than five.",
        f"{_FIG_ALL} (right)",
        "share of rallies below 5, S2R+FT minus i-S2R",
    ),
    Claim(
        "beginner",
        "With beginners, i-S2R's rallies are about 70 % longer than those of S2R+FT.",
        _FIG_SKILL,
        _RATIO,
        1.70,
    ),
    Claim("intermediate", "With intermediate players, they are about 175 % longer.", _FIG_SKILL, _RATIO, 2.75),
    Claim("advanced", "With the advanced player, S2R+FT is far better than i-S2R.", _FIG_SKILL, _RATIO),
    Claim(
        "players",
        "For 80 % of the players, i-S2R's rallies are longer (by 70 % to 175 %).",
        "Abstract",
        "share of players with longer rallies under i-S2R",
        0.8,
    ),
    Claim(
        "without-raw",
        "Without the advanced player, i-S2R is significantly better than S2R+FT.",
        f"Figure app_summary_all_except_outlier, {_SIGNIFICANCE}",
        _RATIO,
    ),
    Claim(
        "without-normalised",
        "The same holds for the normalised rally length.",
        f"Figure app_summary_all_except_outlier, {_SIGNIFICANCE}",
        "normalised rally length, i-S2R minus S2R+FT",
    ),
    Claim(
        "oracle-beginner",
        "With beginners, S2R-Oracle+FT reaches what i-S2R reaches, with 35 % of the real training.",
        "Results (3), Figure main_summary_by_skill_level",
        "mean rally length, S2R-Oracle+FT / i-S2R",
    ),
    Claim(
        "oracle-intermediate",
        "So it does with intermediate players.",
        "Results (3), Figure main_summary_by_skill_level",
        "mean rally length, S2R-Oracle+FT / i-S2R",
    ),
    Claim(
        "converge-beginner",
        "With beginners, i-S2R has converged after two rounds.",
        _FIG_CURVES,
        "mean rally length, fine-tuned 100 % / 65 %",
    ),
    Claim(
        "converge-intermediate",
        "With intermediate players, the third round still improves it.",
        _FIG_CURVES,
        "mean rally length, fine-tuned 100 % / 65 %",
    ),
    Claim(
        "converge-advanced",
        "With the advanced player, the second and third round end alike.",
        "Results (2)",
        "mean rally length, fine-tuned 100 % / 65 %",
    ),
    Claim(
        "first-advanced",
        "With the advanced player, i-S2R was best at the end of the first round.",
        "Results (2)",
        "mean rally length, fine-tuned 100 % / 35 %",
    ),
    Claim(
        "drop-sim2",
        "After the second round in simulation, rallies are shorter than before it.",
        "Results (3), Figure main_training_curves",
        "mean rally length, sim 2 / fine-tuned 35 %",
    ),
    Claim(
        "drop-sim3",
        "After the third round in simulation, rallies are shorter than before it.",
        "Results (3), Figure main_training_curves",
        "mean rally length, sim 3 / fine-tuned 65 %",
    ),
    Claim(
        "fine-tuning",
        "Fine-tuning bridges what is left of the gap: it lengthens the rallies of the first round.",
        "Related work; Figure main_training_curves",
        "mean rally length, fine-tuned 35 % / sim 1",
    ),
    Claim(
        "model-change",
        "The human model changes much less from M1 to M2 than from M0 to M1.",
        "Method; Figure sim_param_evolution",
        "change M1 to M2 / change M0 to M1",
    ),
    Claim(
        "change-levels",
        "From M1 to M2 the model of beginners changes less than that of intermediate players.",
        "Results (2), Figure sim_param_evolution",
        "change M1 to M2, beginners / intermediate players",
    ),
    Claim(
        "cross",
        "With players who did not train the policy, i-S2R is better than S2R+FT.",
        _CROSS,
        "mean cross-evaluated rally length, i-S2R / S2R+FT",
    ),
    Claim(
        "cross-normalised",
        "The same holds for the normalised rally length.",
        _CROSS,
        "normalised cross-evaluated rally length, i-S2R minus S2R+FT",
    ),
    Claim(
        "cross-advanced",
        "It holds for the advanced player's policies too.",
        _CROSS,
        "mean cross-evaluated rally length, i-S2R / S2R+FT",
    ),
    Claim(
        "cross-oracle",
        "S2R-Oracle+FT, too, is better than S2R+FT with other players.",
        _CROSS,
        "mean cross-evaluated rally length, S2R-Oracle+FT / S2R+FT",
    ),
    Claim(
        "keeps-is2r",
        "With other players i-S2R keeps about 70 % of its rally length.",
        _CROSS,
        "cross-evaluated / own rally length, i-S2R",
        0.70,
    ),
    Claim(
        "keeps-s2r",
        "With other players S2R+FT keeps about 30 % of its rally length.",
        _CROSS,
        "cross-evaluated / own rally length, S2R+FT",
        0.30,
    ),
    Claim(
        "keeps-less",
        "Every method plays shorter rallies with other players.",
        _CROSS,
        "cross-evaluated / own rally length, the three methods together",
    ),
    Claim("mean", "i-S2R holds rallies of 22 hits on average.", "Abstract", "mean rally length of i-S2R", 22.0),
    Claim(
        "robot-ends",
        "Almost all rallies end with the robot's mistake or with a return that cannot be continued.",
        "Evaluation Methodology",
        "share of counted rallies that the robot ended or made impossible to continue",
    ),
    Claim(
        "over",
        "With the advanced player, most of i-S2R's mistakes are returns over the human's end of the table.",
        "Results (1)",
        "share, of the balls that the robot did not return, hit over the human's end line",
    ),
    Claim(
        "middle-in",
        "Of player 3's balls with i-S2R, 48.6 % bounce in the middle of the robot's half.",
        "Figure app:heatmap-incoming",
        "share of balls in the middle ninth",
        0.486,
    ),
    Claim(
        "middle-out",
        "Of those in the picture of returns, 53.4 % do.",
        "Figure app:heatmap-outgoing",
        "share, of the balls touched, in the middle ninth",
        0.534,
    ),
    Claim(
        "large",
        "A policy trained on the Large distribution does about 40 % worse than on the Oracle's, zero-shot.",
        "Oracle Ball Distribution Ablation",
        "mean rally length, Large / Oracle",
        0.60,
    ),
    Claim(
        "medium",
        "Trained on the Medium distribution it does about as well as on the Oracle's, zero-shot.",
        "Oracle Ball Distribution Ablation",
        "mean rally length, Medium / Oracle",
    ),
    Claim(
        "carried",
        "Whether it helps to carry the weights back to simulation is left open.",
        "Appendix i-S2R Procedure",
        "mean rally length, weights carried back / not",
    ),
)
"""In the order of the paper's questions."""
