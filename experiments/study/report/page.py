"""The report of a study: the paper's figures and tables with ours beside them, and what agrees.

The order is that of a reader's questions: what was found, does the method help, whom, how fast, why, with others, and
how sure is all this. A part that a study lacks is named in its place.
"""

from __future__ import annotations

import json
from html import escape
from pathlib import Path

import yaml

from experiments.study.analysis.claims import NOT_COMPARABLE, VERDICTS, Measurements, findings, show, span
from experiments.study.analysis.claims import __doc__ as RULES
from experiments.study.analysis.paper import LEVELS, RALLIES, WITHOUT
from experiments.study.analysis.statistics import Estimate
from experiments.study.analysis.study_folder import Study, load
from experiments.study.report import figures, further_figures, heatmaps, human_model_figures, tables, tsne
from experiments.study.report import text as words
from mjx_tt.viz.html import Page, details, table

REPORT = "report"
ABSENT = "This study holds nothing of it."
MOST_MISSING = 12  # that are listed at once


def write(folder: Path) -> Path:
    """Writes report/index.html, its pictures and its tables into a study's folder; returns the page's path.

    Raises ConfigError where there is no study or a file of it cannot be read.
    """
    study = load(folder)
    writer = _Report(study)
    writer.compose()
    target = study.folder / REPORT
    path, *_ = writer.page.write(target / "index.html", target)
    for name, content in writer.tables.items():
        content.write(target / f"{name}.csv")
    return path


class _Report:
    def __init__(self, study: Study) -> None:
        self.study, self.measured = study, Measurements(study)
        self.findings = {f.claim.key: f for f in findings(self.measured)}
        self.tables: dict[str, tables.Table] = {}
        name = study.settings.get("name", study.folder.name)
        seeds = len(study.seeds)
        subtitle = (
            f"{name}: {_count(len(study.players), 'player')}, {_count(seeds, 'seed')}, {len(study.rallies):,} "
            "rallies, of which"
            f" {int(study.rallies.selected.sum()):,} are reported"
        )
        self.page = Page("Simulate, play, refine: the paper's study repeated", subtitle, css=STYLE)

    def compose(self) -> None:
        for part in (
            self._top,
            self._aggregated,
            self._skill,
            self._without,
            self._checkpoints,
            self._zero_shot,
            self._human_model,
            self._effects,
            self._cross,
            self._players,
            self._balls,
            self._heatmaps,
            self._ablation,
            self._variant,
            self._ends,
            self._statistics,
            self._calibration,
            self._all_claims,
            self._about,
        ):
            part()

    # Parts of the page

    def _top(self) -> None:
        self.page.section("findings", "What was found")
        self.page.add(
            "<ul>" + "".join(f"<li>{escape(s)}</li>" for s in words.sentences(self.measured, self.findings)) + "</ul>"
        )
        self._picture(
            "summary",
            further_figures.summary(list(self.findings.values())),
            "Ratios of mean rally lengths in this study, with 95 % intervals over seeds and rallies, and the paper's "
            "numbers where "
            "its text states them. On the right the verdict, by the rules at the end of this page.",
        )
        counts = {v: sum(f.verdict == v for f in self.findings.values()) for v in VERDICTS}
        self.page.add("<p>" + " ".join(f"{_badge(v)} {n}" for v, n in counts.items()) + "</p>")
        if len(self.study.seeds) == 1:
            self.page.paragraph(
                "One seed: the intervals hold for these policies and this reality; how much another training or "
                "another reality "
                "would change is not known from it.",
                "note",
            )
        if self.study.missing:
            lines = "".join(f"<li>{escape(line)}</li>" for line in self.study.missing)
            first = "; ".join(self.study.missing[:MOST_MISSING])
            more = (
                "" if len(self.study.missing) <= MOST_MISSING else f" and {len(self.study.missing) - MOST_MISSING} more"
            )
            self.page.paragraph(f"This study is partial. Missing: {first}{more}.", "missing")
            if more:
                self.page.add(details("All that is missing", f"<ul>{lines}</ul>"))

    def _aggregated(self) -> None:
        self.page.section("aggregated", "Over all players")
        self._picture(
            "aggregated",
            figures.aggregated(self.study, self.measured),
            "The paper's figure all_player_results. White circle: mean; line: median; box: quartiles. Normalised: "
            "minus the mean, over "
            "the standard deviation of the player's rallies with all ten models.",
        )
        self._picture(
            "aggregated_means",
            figures.means(self.study, self.measured),
            "The paper's figure app_summary: means with 95 % intervals over seeds and rallies.",
        )
        self._claims("all-ratio", "all-raw", "all-normalised", "all-oracle", "short", "mean")
        self._table(
            "normalised",
            tables.quartiles(self.study, self.measured),
            "Normalised rally length: mean, median, quartiles",
        )

    def _skill(self) -> None:
        self.page.section("skill", "By skill level")
        self._picture(
            "by_skill",
            figures.by_skill(self.study, self.measured),
            "The paper's figures main_summary_by_skill_level (above) and app_summary_by_skill_level_means (below). "
            "S2R-Oracle+FT has "
            "35 % of the real training of the others.",
        )
        self._claims(
            "beginner", "intermediate", "advanced", "players", "oracle-beginner", "oracle-intermediate", "over"
        )
        self._table(
            "player_skill",
            tables.skill(self.study),
            "Player skill: rally length over the ten models (the paper's table player_skill)",
        )

    def _without(self) -> None:
        self.page.section("without", "Without the advanced player")
        self._picture(
            "without_advanced",
            figures.means(self.study, self.measured, WITHOUT),
            "The paper's figure app_summary_all_except_outlier, the advanced player left out.",
        )
        self._claims("without-raw", "without-normalised")

    def _checkpoints(self) -> None:
        self.page.section("checkpoints", "On the way: the ten models")
        self._picture(
            "checkpoints",
            figures.checkpoints(self.study, self.measured),
            "The paper's figure main_training_curves. Hollow: from simulation; filled: fine-tuned. S2R shares its "
            "first two models "
            "with i-S2R.",
        )
        self._claims(
            "converge-beginner",
            "converge-intermediate",
            "converge-advanced",
            "first-advanced",
            "drop-sim2",
            "drop-sim3",
        )

    def _zero_shot(self) -> None:
        self.page.section("zero-shot", "Zero-shot and fine-tuned")
        self._picture(
            "zero_shot",
            further_figures.zero_shot(self.study, self.measured),
            "Each policy as it came from simulation, and after its fine-tuning in reality, by skill level. The paper "
            "has it as the "
            "steps of its training curves.",
        )
        self._claims("fine-tuning")
        self._picture(
            "fine_tuning",
            further_figures.fine_tuning(self.study, self.measured),
            "Balls that the perturbed policies return while they are fine-tuned in reality (mean over 7 updates; "
            "thick: mean over players "
            "and seeds). The first cycle is the same for both methods; at the gaps i-S2R goes back to simulation, "
            "S2R does not.",
        )
        cells = []
        for name in LEVELS:
            found = [self.measured.ratio(b, a, name) for a, b in further_figures.PAIRS]
            cells.append((name, *(_ratio_text(e) for e in found)))
        head = ("players", "35 % / sim 1", "65 % / sim 2", "100 % / sim 3", "Oracle fine-tuned / sim")
        self._table(
            "zero_shot",
            tables.Table(head, cells, (1, 2, 3, 4)),
            "What fine-tuning brings: ratio of mean rally lengths",
        )

    def _human_model(self) -> None:
        self.page.section("human-model", "The human model, round by round")
        self._picture(
            "evolution",
            human_model_figures.evolution(self.study, self.measured),
            "The paper's figure sim_param_evolution and table ball_dist: the interval of each quantity in M0, M1 and "
            "M2. Bars of several "
            "seeds are means, with the smallest and largest end as whiskers.",
        )
        self._picture(
            "changes",
            human_model_figures.changes(self.study, self.measured),
            "How far the model moves between rounds: mean over the 16 numbers of the change, each in units of its "
            "quantity's width over "
            "the three models. The paper's follow from its table.",
        )
        self._claims("model-change", "change-levels")
        self._table(
            "distances",
            tables.change(self.study, self.measured),
            "Distance M0 to M1 against M1 to M2",
            opened=True,
        )
        self._table(
            "deviations",
            tables.deviations(self.study),
            "Median deviation of the human models from the paper's, in units of each quantity's width",
        )
        self._table(
            "ball_distributions",
            tables.distributions(self.study),
            "All numbers of M0, M1 and M2 (the paper's table ball_dist)",
        )

    def _effects(self) -> None:
        self.page.section("effects", "What each hidden effect costs")
        self._picture(
            "effects",
            further_figures.effects_left_out(self.study),
            "Not in the paper: the same policies, not trained again, in a reality that lacks one of the effects that "
            "training does not know, and one that lacks all. Mean rally length over that in the whole reality, geometric "
            "mean over players and seeds; bold where its 95 % interval excludes 1.",
        )
        self._table("effects", tables.effects_left_out(self.study), "Rally length without an effect over that with all")

    def _cross(self) -> None:
        self.page.section("cross", "With players who did not train the policy")
        self._picture(
            "cross",
            figures.cross(self.study, self.measured),
            "The paper's figure main_cross_eval_summary. Normalised: by mean and standard deviation of the trainer's "
            "own evaluation of "
            "that model. Right: mean with others over mean with the trainer.",
        )
        self._claims(
            "cross", "cross-normalised", "cross-advanced", "cross-oracle", "keeps-is2r", "keeps-s2r", "keeps-less"
        )
        self._table(
            "cross",
            tables.cross(self.study, self.measured),
            "Trainers and evaluators (the paper's table cross_eval): mean rally length",
        )
        self._picture(
            "cross_players",
            figures.cross_by_player(self.study, self.measured),
            "The paper's figure app:cross_eval_details, ordered by the trainer's skill.",
        )

    def _players(self) -> None:
        self.page.section("players", "Player by player")
        self._picture(
            "players",
            figures.by_player(self.study, self.measured),
            "The paper's figure app:trainer_details: mean and distribution of the rally length of the ten models, "
            "players from the lowest "
            "to the highest skill. Dashed: the paper's mean over the ten models of that player.",
        )
        self._not_drawn(
            "The paper gives these figures as pictures only; what its text says about players stands above."
        )

    def _balls(self) -> None:
        self.page.section("balls", "The balls on a plane (t-SNE)")
        planes = []
        if self.study.seeds:
            found = (tsne.embed(self.study, player, self.study.seeds[0]) for player in self.study.players)
            planes = [plane for plane in found if plane is not None]
        seed = f"Seed {self.study.seeds[0]}. " if self.study.seeds else ""
        self._picture(
            "tsne_training",
            tsne.training(planes),
            f"{seed}The paper's figure app:ball-dist-evo-train: D0, and what the first and second fine-tuning add. "
            "One plane per player "
            "for all three sets of pictures, so a place means the same ball in all; grey: all balls of the player.",
        )
        self._picture(
            "tsne_evaluation",
            tsne.evaluation(planes),
            "The paper's figure app:ball-dist-evo-train-eval: training balls up to a round, and the balls of the "
            "evaluation after it.",
        )
        self._picture(
            "tsne_methods",
            tsne.methods(planes),
            "The paper's figure app:ball-dist-is2r-s2r: i-S2R left, S2R+FT right. S2R was trained in simulation on "
            "D0 alone; ΔD1 are the "
            "balls of the fine-tuning that it shares with i-S2R.",
        )
        self._not_drawn(
            "The paper draws these without a statement in numbers. Numbers from here: the share of evaluation balls "
            "inside each human model."
        )
        self._table("inside", tables.inside(self.study), "Evaluation balls inside each human model", opened=True)

    def _heatmaps(self) -> None:
        self.page.section("heatmaps", "Where balls come from and go to")
        how = (
            "Large grid: where the human's ball bounced on the robot's half, seen from above with the human at the "
            "top. Colour: return "
            "rate. Numbers: percent of all balls of the picture; those of a small grid add up to the number above it."
        )
        self._picture(
            "heatmap_incoming",
            heatmaps.heatmaps(self.study, heatmaps.incoming),
            f"The paper's figure app:heatmap-incoming. {how} Small grid: from where on the human's half it was hit.",
        )
        self._picture(
            "heatmap_outgoing",
            heatmaps.heatmaps(self.study, heatmaps.outgoing),
            f"The paper's figure app:heatmap-outgoing. {how} Small grid: where on the human's half the robot's "
            "return came down (beside it: "
            "the nearest square), of the balls that it touched.",
        )
        self._claims("middle-in", "middle-out")

    def _ablation(self) -> None:
        self.page.section("ablation", "Which distribution to train on")
        self._picture(
            "ablation",
            figures.ablation(self.study, self.measured),
            "The paper's figure arbitarary_distributions: zero-shot rallies of policies trained on hand-made "
            "distributions and on the Oracle's.",
        )
        self._claims("large", "medium")

    def _variant(self) -> None:
        self.page.section("variant", "Are the weights worth carrying back?")
        self._picture(
            "variant",
            further_figures.variant(self.study, self.measured),
            "i-S2R, which goes on in simulation from the weights fine-tuned in reality, against the variant that "
            "goes on from its own "
            "weights in simulation and takes only the new human model.",
        )
        self._claims("carried")

    def _ends(self) -> None:
        self.page.section("ends", "Who ends the rallies")
        self._picture(
            "ends",
            further_figures.ends(self.study, self.measured),
            "Shares of the rallies that count, played with the own trainer, that the robot (coloured) and the human "
            "(grey) ended.",
        )
        self._claims("robot-ends")
        self._table(
            "ends",
            tables.ends(self.study),
            "End-of-rally attribution (the paper's table end_of_rally_attribution)",
        )
        cut = tables.broken_off(self.study)
        if cut:
            self.page.paragraph(
                f"{cut} reported rallies were broken off at the largest number of touches; their lengths are lower "
                "bounds.",
                "note",
            )

    def _statistics(self) -> None:
        self.page.section("statistics", "Intervals, significance, and what the selection does")
        self._picture(
            "unselected",
            further_figures.unselected(self.study, self.measured),
            f"The paper reports the {RALLIES} longest of 60 rallies. The same comparison on every rally that counts.",
        )
        self._table(
            "significance",
            tables.significance(self.measured),
            "Differences between the methods, with tests",
            opened=True,
        )
        self.page.paragraph(
            "p Welch and p permuted take rallies as independent, the paper's way: they hold for these very policies. "
            "p policies takes a "
            "pair of policies (one player, one seed) as the unit; with n pairs it cannot fall below 2 / 2^n. Holm: "
            "adjusted for the "
            "number of rows.",
            "note",
        )
        self._table(
            "models",
            tables.models(self.study, self.measured),
            "Every model: mean rally length with intervals of three kinds, quartiles, unselected",
        )
        self._table("rallies", tables.ball_counts(self.study), "Rallies played, counted and reported")

    def _calibration(self) -> None:
        self.page.section("calibration", "How far the virtual players are the paper's")
        found = self.study.calibration
        if not found:
            self._not_drawn(
                "No calibration.json in this study. The human models reached in it stand above, beside the paper's."
            )
            return
        self._picture(
            "calibration",
            human_model_figures.calibration(found),
            "Virtual players without a study: their balls fitted as a human model is, beside the paper's, and their "
            "rallies with policies "
            "of mixed quality. Dotted: 15 % of a range.",
        )
        medians = found.get("medians", {})
        rows = [
            (player, *(f"{100 * by[m]:.0f} %" if m in by else "" for m in ("M0", "M1", "M2")))
            for player, by in medians.items()
        ]
        self._table(
            "calibration_medians",
            tables.Table(("player", "M0", "M1", "M2"), rows, (1, 2, 3)),
            "Median deviation over the 16 numbers, as a share of each quantity's range",
            opened=True,
        )
        for name, title in (
            ("numbers", "Target and reached, number by number"),
            ("rallies", "Rally statistics, target and reached"),
        ):
            lines = found.get(name, [])
            if lines:
                head = tuple(lines[0])
                self._table(
                    f"calibration_{name}",
                    tables.Table(head, [tuple(str(r[k]) for k in head) for r in lines]),
                    title,
                )

    def _all_claims(self) -> None:
        self.page.section("claims", "Every claim, and the rules")
        content = tables.claims(list(self.findings.values()))
        self.tables["claims"] = content
        rows = [(*map(escape, row[:6]), _badge(row[6]), escape(row[7])) for row in content.rows]
        self.page.add(details("All claims", table(content.head, rows, content.right)))
        self.page.add(details("Rules of the verdicts", f"<pre>{escape(RULES)}</pre>"))

    def _about(self) -> None:
        self.page.section("about", "The study")
        for seed, reality in self.study.realities.items():
            text = yaml.safe_dump(reality, sort_keys=False)
            self.page.add(details(f"The reality of seed {seed}, which was sealed", f"<pre>{escape(text)}</pre>"))
        if self.study.settings:
            text = yaml.safe_dump(self.study.settings, sort_keys=False)
            self.page.add(details("Settings", f"<pre>{escape(text)}</pre>"))
        if self.study.info:
            self.page.add(
                details("Sessions and versions", f"<pre>{escape(json.dumps(self.study.info, indent=2))}</pre>")
            )
        self.page.paragraph("Every picture of this page is a PNG beside it, every table a CSV.", "note")

    # Pieces

    def _picture(self, name: str, figure, caption: str) -> None:
        if figure is None:
            self._not_drawn(f"{caption.split('.')[0].split(':')[0]}: {ABSENT[0].lower() + ABSENT[1:]}")
            return
        self.page.add(self.page.picture(name, figure, escape(caption), caption.split(". ")[0]))

    def _table(self, name: str, content: tables.Table, title: str, opened: bool = False) -> None:
        self.tables[name] = content
        if not content.rows:
            self._not_drawn(f"{title}: {ABSENT[0].lower() + ABSENT[1:]}")
            return
        html = table(content.head, [tuple(map(escape, row)) for row in content.rows], content.right)
        self.page.add(f"<h3>{escape(title)}</h3>{html}" if opened else details(title, html))

    def _claims(self, *keys: str) -> None:
        rows = []
        for f in (self.findings[key] for key in keys):
            paper = "" if f.paper is None else show(f.unit, f.paper)
            ours = (
                ABSENT
                if f.interval is None
                else f"<b>{show(f.unit, f.interval.value)}</b> ({span(f.unit, f.interval)})"
            )
            rows.append(
                (
                    _badge(f.verdict),
                    f"{escape(f.claim.text)}<br><span class=note>{escape(f.claim.source)}</span>",
                    escape(f.claim.quantity),
                    paper,
                    ours,
                    escape(f.why),
                )
            )
        self.page.add(table(("", "the paper says", "measured", "paper", "here (95 %)", "why"), rows, (3,)))

    def _not_drawn(self, text: str) -> None:
        self.page.add(f"<p>{_badge(NOT_COMPARABLE)} {escape(text)}</p>")


def _ratio_text(estimate: Estimate | None) -> str:
    if estimate is None:
        return ""
    i = estimate.interval
    return f"{i.value:.2f} ({i.low:.2f} to {i.high:.2f})"


def _badge(verdict: str) -> str:
    return f'<span class="badge {verdict.replace(" ", "-")}">{escape(verdict)}</span>'


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


STYLE = """
header, main { max-width: 1180px; }
nav { margin: .4rem 0 0; }
nav a { color: inherit; }
.badge { white-space: nowrap; font-size: .82rem; background: #6b7280; }
.badge.agrees { background: #00664b; }
.badge.agrees-in-direction { background: #0b62a4; }
.badge.differs { background: #b3400a; }
.badge.undecided { background: #6b7280; }
.badge.not-comparable { background: #fff; color: #4d5661; outline: 1px solid #9aa3ad; }
pre { white-space: pre-wrap; font-size: .85rem; }
p.missing { border-left: 5px solid #b3400a; padding: .2rem 0 .2rem 1rem; }
"""
