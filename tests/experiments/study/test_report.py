"""The study's scoring and statistics against other libraries and numbers by hand; its report on made-up studies."""

from __future__ import annotations

import base64
import csv
import io
import json
import math
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
import yaml
from PIL import Image
from scipy import stats

from ballmodel import registry
from experiments import cli
from experiments.errors import ConfigError
from experiments.study.analysis import claims, scoring, statistics
from experiments.study.analysis import paper as study_paper
from experiments.study.analysis import study_folder as study_data
from experiments.study.analysis.claims import DIFFERENCE, HITS, RATIO, SHARE, Measurements, judge
from experiments.study.analysis.statistics import Bootstrap, Interval
from experiments.study.analysis.study_folder import StudyFolder
from experiments.study.report import figures
from mjx_tt.rally.end_reasons import ROWS, End
from tests.support import made_up_study


def rallies(lengths: dict, end=End.ROBOT_MISSED):
    """Rallies from {(seed, trainer, evaluator, model): lengths}."""
    return scoring.join(
        scoring.score_rallies(s, t, e, m, "A", values, [end] * len(values)) for (s, t, e, m), values in lengths.items()
    )


def played(lengths: dict) -> scoring.Rallies:
    """Own rallies of player 3, {model: lengths}."""
    return rallies({(0, "player3", "player3", model): values for model, values in lengths.items()})


# Statistics


def test_bootstrap_of_one_policy_is_scipys():
    length = np.random.default_rng(0).geometric(0.1, 50)
    found = Bootstrap(rallies({(0, "player1", "player1", "is2r-ft100"): length}), draws=20000)
    interval = found.mean("is2r-ft100", ["player1"]).interval
    theirs = stats.bootstrap((length,), np.mean, n_resamples=20000, method="percentile", rng=1).confidence_interval
    assert interval.value == pytest.approx(length.mean())
    assert (interval.low, interval.high) == pytest.approx(theirs, abs=0.15)


@pytest.mark.parametrize("count", [52, 60, 80])
def test_bootstrap_of_the_longest_selects_in_every_draw(count):
    """Against a bootstrap by a loop; the interval holds the mean of the longest five sixths as often as it says."""
    rng, draws = np.random.default_rng(count), []
    length = rng.geometric(0.05, count)
    boot = Bootstrap(rallies({(0, "player1", "player1", "m"): length}), draws=8000, longest=True)
    found, pool = boot.mean("m", ["player1"]), length[:60]
    keep = round(pool.size * 5 / 6)
    assert found.value == pytest.approx(np.sort(pool)[-keep:].mean())
    for _ in range(8000):
        draws.append(np.sort(rng.choice(pool, pool.size))[-keep:].mean())
    assert np.percentile(found.draws, (2.5, 50, 97.5)) == pytest.approx(np.percentile(draws, (2.5, 50, 97.5)), rel=0.02)
    truth, held = 1.18 * 20.0, 0
    for k in range(200):
        data = rallies({(0, "player1", "player1", "m"): rng.geometric(0.05, count)})
        i = Bootstrap(data, draws=300, key=k, longest=True).mean("m", ["player1"]).interval
        held += i.low <= truth <= i.high
    assert 0.87 <= held / 200 <= 0.99


def test_an_evaluation_with_fewer_than_sixty_that_count_is_named(tmp_path):
    folder = made_up_study.make(tmp_path, names=("player5",), rallies=58, cross=False)
    study = study_data.load(folder)
    r = study.rallies
    count = int(np.sum(~r.filtered & (r.model == "is2r-ft100")))
    line = f"is2r-ft100: {count} rallies that count of 60, the longest {round(count * 5 / 6)} are reported"
    assert f"seed 0, player5 with player5, {line}" in study.missing


@pytest.mark.parametrize("count", [5, 6, 9])
def test_bootstrap_over_seeds_has_the_spread_of_a_mean_over_seeds(count):
    levels = np.random.default_rng(count).integers(2, 40, count)  # rallies of a seed do not differ: only seeds do
    data = rallies({(s, "player1", "player1", "m"): np.full(5, level) for s, level in enumerate(levels)})
    draws = Bootstrap(data, draws=40000).mean("m", ["player1"]).draws
    assert draws.mean() == pytest.approx(levels.mean(), rel=0.02)
    assert draws.var() == pytest.approx(levels.var(ddof=1) / count, rel=0.05)


def test_fewer_than_five_seeds_are_not_drawn_anew():
    levels = [3, 30, 12, 7]
    data = rallies({(s, "player1", "player1", "m"): np.full(5, level) for s, level in enumerate(levels)})
    assert np.ptp(Bootstrap(data).mean("m", ["player1"]).draws) == 0.0
    assert [statistics.name_chance(n) for n in (1, 4, 5)] == ["rallies", "rallies", "seeds and rallies"]


def test_trainers_weigh_the_same_and_only_pairs_are_compared():
    data = rallies(
        {
            (0, "player1", "player1", "a"): [10, 10],
            (0, "player1", "player1", "b"): [5] * 4,
            (0, "player2", "player2", "a"): [4] * 6,
            (0, "player3", "player3", "b"): [99],
        }
    )
    boot = Bootstrap(data)
    names = ["player1", "player2", "player3"]
    assert boot.mean("a", names).value == 7.0
    first, second = boot.pair("a", "b", names)
    assert (first / second).value == 2.0 and (first - second).value == 5.0  # player 1 alone has both
    assert boot.pair("a", "b", ["player2"]) is None and boot.mean("c", names) is None


def test_normalisation_both_ways_by_hand():
    data = rallies(
        {
            (0, "player1", "player1", "a"): [2, 4],
            (0, "player1", "player1", "b"): [6, 8],
            (0, "player1", "player4", "a"): [1, 3],
            (1, "player1", "player1", "a"): [10, 30],
        }
    )
    own = data.take(data.own)
    by_player = statistics.normalise_by_player(own)
    spread = np.sqrt(20 / 3)  # of 2, 4, 6, 8 around 5
    assert by_player == pytest.approx([*(np.array([-3, -1, 1, 3]) / spread), -np.sqrt(0.5), np.sqrt(0.5)])
    by_model = statistics.normalise_by_model(data)
    unit = np.sqrt(2.0)  # of 2, 4
    expected = {
        (0, "a", True): [-1 / unit, 1 / unit],
        (0, "a", False): [-2 / unit, 0.0],
        (0, "b", True): [-1 / unit, 1 / unit],
    }
    for (seed, model, is_own), values in expected.items():
        where = (data.seed == seed) & (data.model == model) & (data.own == is_own)
        assert by_model[where] == pytest.approx(values)


# Changes of the human models, and costs

BEGINNERS, INTERMEDIATE = ("player3", "player5"), ("player2", "player4")


def measured(tmp_path, second: dict[tuple[int, str], float]) -> Measurements:
    """Of a study whose first changes are all 1, with these second ones by seed and player."""
    found = Measurements(StudyFolder(tmp_path, {}, scoring.join([])))
    found.changes = {at: (1.0, change) for at, change in second.items()}
    return found


def test_changes_of_several_seeds_have_intervals_over_seeds(tmp_path):
    by_seed = {0: 0.1, 1: 0.2, 2: 0.15}
    second = {
        (s, p): x * (2.0 if p in BEGINNERS else 1.0) for s, x in by_seed.items() for p in BEGINNERS + INTERMEDIATE
    }
    m, logs = measured(tmp_path, second), np.log([*by_seed.values()])
    half = stats.t.ppf(0.975, 2) * logs.std(ddof=1) / math.sqrt(3)
    found = m.model_change()
    assert found.value == pytest.approx(math.sqrt(2.0) * math.exp(logs.mean())) and found.n == 3
    assert found.high / found.value == pytest.approx(math.exp(half)) and not found.over
    levels = m.model_change_by_level()
    assert (levels.value, levels.low, levels.high) == pytest.approx((2.0, 2.0, 2.0))  # the seeds' part cancels


def test_changes_of_one_seed_are_over_its_players_and_say_so(tmp_path):
    m = measured(tmp_path, {(0, "player3"): 0.1, (0, "player5"): 0.2, (0, "player2"): 0.1, (0, "player4"): 0.1})
    expected = stats.ttest_1samp(np.log([0.1, 0.2, 0.1, 0.1]), 0.0).confidence_interval()
    found = m.model_change()
    assert (found.low, found.high) == pytest.approx(tuple(np.exp(expected)))
    assert "players of one seed" in found.over and "players of one seed" in m.model_change_by_level().over
    whys = {key: found.why for key, found in m.findings.items()}
    assert "over the players of one seed alone" in whys["model-change"]
    assert measured(tmp_path, {(0, "player3"): 0.1}).model_change() is None


def test_a_group_has_the_changes_of_its_players_alone(tmp_path):
    m = measured(tmp_path, {(s, p): 0.2 if p in BEGINNERS else 0.6 for s in (0, 1) for p in BEGINNERS + INTERMEDIATE})
    assert m.model_change(group="beginner").value == pytest.approx(0.2)
    assert m.model_change(group="intermediate").value == pytest.approx(0.6)
    assert m.findings["change-beginner"].paper == pytest.approx(
        math.sqrt(math.prod(b / a for a, b in map(claims.paper_changes, BEGINNERS)))
    )


def test_the_longest_rally_is_of_all_that_count(tmp_path):
    counted = played({"is2r-ft100": [3] * 99 + [151], "s2r-ft100": [400] * 100})
    found = Measurements(StudyFolder(tmp_path, {}, counted)).longest_rally("is2r-ft100")
    assert found.value == 151
    # One rally of a hundred is drawn again with probability 1 - 0.99^100.
    assert np.mean(found.draws == 151) == pytest.approx(1.0 - 0.99**100, abs=0.04)


def test_a_poor_zero_shot_policy_costs_the_updates_to_an_equal_level(tmp_path):
    """Two fine-tunings that rise alike, from 0.1 and from 0.4: to 0.645, the average that both reach."""
    found = played({"is2r-sim1": [2] * 60, "oracle-sim": [8] * 60})
    m = Measurements(StudyFolder(tmp_path, {}, found))
    for model, start in (("is2r-ft35", 0.1), ("oracle-ft", 0.4)):
        folder = m.study.paths.model(0, "player3", model)
        folder.mkdir(parents=True)
        rows = ({"update": k + 1, "return_rate": start + 0.01 * k} for k in range(60))
        (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    assert m.tuning_cost() is None  # one player of one seed has no interval
    shutil.copytree(tmp_path / "seed0", tmp_path / "seed1")
    second = found.copy()
    second.seed = 1
    m = Measurements(replace(m.study, rallies=scoring.join([found, second])))
    assert m.tuning_cost().value == pytest.approx(60 / 30)


# Verdicts


@pytest.mark.parametrize(
    ("kind", "unit", "interval", "paper", "verdict"),
    [
        ("more", RATIO, (1.6, 1.2, 2.1), 1.7, "agrees"),
        ("more", RATIO, (1.6, 1.2, 2.1), None, "agrees"),
        ("more", RATIO, (1.6, 1.2, 2.1), 2.75, "agrees in direction"),
        ("more", RATIO, (1.1, 0.9, 1.3), 1.09, "undecided"),
        ("more", RATIO, (1.1, 0.9, 1.3), 2.75, "differs"),
        ("more", RATIO, (0.7, 0.5, 0.9), None, "differs"),
        ("less", RATIO, (0.7, 0.5, 0.9), None, "agrees"),
        ("less", RATIO, (1.7, 1.5, 1.9), None, "differs"),
        ("alike", RATIO, (1.1, 0.8, 1.4), None, "agrees"),
        ("alike", RATIO, (1.1, 0.3, 4.0), None, "undecided"),
        ("alike", RATIO, (1.3, 1.1, 1.6), None, "differs"),
        ("more", DIFFERENCE, (0.3, 0.1, 0.5), None, "agrees"),
        ("more", SHARE, (0.45, 0.40, 0.49), None, "differs"),
        ("number", HITS, (20.0, 18.0, 23.0), 22.0, "agrees"),
        ("number", HITS, (9.0, 8.0, 11.0), 22.0, "differs"),
    ],
)
def test_verdicts_follow_the_rules(kind, unit, interval, paper, verdict):
    assert judge(kind, unit, Interval(*interval), paper)[0] == verdict


def test_the_papers_changes_follow_from_its_table():
    """Player 4's M1 to M2 by hand from the YAML of the paper's table."""
    balls = yaml.safe_load(registry.PAPER.read_text())["balls"]
    data = {model: balls[f"player4/{model}"] for model in ("M0", "M1", "M2")}
    total = 0.0
    for part in ("position", "velocity", "landing"):
        for axis in data["M0"][part]:
            ends = [data[m][part][axis] for m in ("M0", "M1", "M2")]
            width = max(e[1] for e in ends) - min(e[0] for e in ends)
            total += (abs(ends[2][0] - ends[1][0]) + abs(ends[2][1] - ends[1][1])) / width
    assert claims.paper_changes("player4")[1] == pytest.approx(total / 16)


# The report


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = made_up_study.make(tmp_path_factory.mktemp("study"), seeds=(0, 1), names=("player3", "player1"))
    assert cli.main(["study-report", str(folder)]) == 0
    return folder


@pytest.fixture(scope="module")
def measurements(whole):
    return Measurements(study_data.load(whole))


def test_measured_means_are_the_known_ones(measurements):
    m, counted = measurements, Bootstrap(measurements.study.pick(own=None, selected=False))
    for model in study_paper.TEN:
        for player in ("player3", "player1"):
            known, found = made_up_study.mean_length(player, model), counted.mean(model, [player])
            # Of some 145 rallies of a geometric distribution, under policies that scatter by 5 %.
            assert found.value == pytest.approx(known, abs=4 * (known / np.sqrt(145) + 0.05 * known / np.sqrt(2)))
    kept = m.kept_ratio(["is2r-ft100"]).interval
    assert kept.low - 0.1 <= 0.7 <= kept.high + 0.1
    robot = made_up_study.ROBOT_SHARE  # and of the human's, a third are returns to the corner
    assert m.robot_ended_share().value == pytest.approx(robot + (1.0 - robot) / 3, abs=0.03)


def test_claims_are_judged_as_the_made_up_numbers_demand(measurements):
    found = measurements.findings
    assert set(found) == {claim.key for claim in study_paper.CLAIMS}
    for key in ("beginner", "advanced", "fine-tuning", "cross", "keeps-less", "robot-ends"):
        assert found[key].verdict.startswith("agrees"), (key, found[key])
    assert found["first-advanced"].verdict == "differs"  # made up so that later rounds are better
    assert found["intermediate"].verdict == "not comparable"  # no such player in it
    assert found["model-change"].interval.value == pytest.approx(
        np.sqrt(np.prod([b / a for a, b in map(claims.paper_changes, ("player1", "player3"))]))
    )  # its human models are the paper's


def test_the_report_is_one_page_that_needs_nothing_else(whole):
    report = whole / "report"
    html = re.sub(' data-head="[^"]*"', "", (report / "index.html").read_text())
    assert not re.findall(r"(?:src|href)=[\"'](?!data:|#)", html) and "http" not in re.sub('base64,[^"]*', "", html)
    pictures = re.findall(r'src="data:image/png;base64,([^"]+)"', html)
    files = {path.name for path in report.glob("*.png")}
    assert len(pictures) == len(files) and files == {f"{name}.png" for name in figures.FIGURES}
    for data in pictures:
        image = Image.open(io.BytesIO(base64.b64decode(data))).convert("L")
        assert image.width > 600 and np.asarray(image).std() > 5.0  # something is drawn
    for claim in study_paper.CLAIMS:
        assert claim.text.replace("'", "&#39;") in html, claim.key
    assert "players player5, player4, player2" in html  # what is missing is named
    with open(report / "claims.csv", newline="") as file:
        assert {row["verdict"] for row in csv.DictReader(file)} <= set(claims.VERDICTS)
    with open(report / "player_skill.csv", newline="") as file:
        paper = [row for row in csv.reader(file) if row[1] == "paper"]
    assert paper[0] == ["player3 (beginner)", "paper", "2", "3", "7", "5.9", "9", "52", "500"]


def test_identified_worlds_stand_beside_the_opened_reality(whole, measurements):
    with open(whole / "report" / "identified.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    held = {(row["parameter"], row["truth"], row["holds it"]) for row in rows}
    assert held == {("ball.table.friction", "0.2", "yes"), ("ball.paddle.restitution", "0.97", "no")}
    with open(whole / "report" / "coverage.csv", newline="") as file:
        (counted,) = csv.DictReader(file)
    assert counted["different intervals of 90 % that hold the truth"] == "2 of 4"  # of two seeds, both players alike
    assert counted["decided by"] == "prior"
    assert len(rows) == 2 * 2 * 2 and {row["round"] for row in rows} == {"world0"}  # seeds, players, parameters
    ratio, known = measurements.length_ratio("id-sim1", "is2r-sim1").interval, made_up_study.MEANS["id-sim1"] / 3.0
    assert ratio.low < known < ratio.high


def test_a_study_that_has_just_begun_has_a_report(tmp_path):
    folder = made_up_study.make(tmp_path, names=("player5",), cross=False)
    (folder / "evaluations.csv").unlink()
    assert cli.main(["study-report", str(folder)]) == 0
    html = (folder / "report" / "index.html").read_text()
    assert "seed 0, player5: evaluation of is2r-sim1, is2r-ft35" in html and "evolution" in html
    (tmp_path / "empty").mkdir()
    with pytest.raises(ConfigError, match="is no study"):
        study_data.load(tmp_path / "empty")


def test_a_study_of_chosen_methods_is_whole_and_says_what_identification_brings(tmp_path):
    """Rallies of one length per policy, so that every ratio is known; the other methods are left out on purpose."""
    touches = {"sim1": (5, 6), "ft35": (6, 7), "sim2": (8, 20), "ft65": (9, 30), "sim3": (10, 45), "ft100": (20, 50)}
    lengths = {
        (seed, player, player, f"{method}-{stage}"): np.full(60, touches[stage][i])
        for seed in range(5)
        for player in study_paper.BY_SKILL
        for i, method in enumerate(("is2r", "id"))
        for stage in touches
    }
    scoring.write(tmp_path / "evaluations.csv", rallies(lengths))
    settings = "name: chosen\nbaselines: is2r\nidentification: {}\nevaluation: {cross: false}\n"
    (tmp_path / "study.yaml").write_text(settings)
    study = study_data.load(tmp_path)
    assert [line for line in study.missing if "human model" not in line] == []
    m = Measurements(study)
    for key, ratio in (("identified-zero-shot", 4.5), ("identified-tuned", 2.5)):
        found = m.findings[key].interval
        assert (found.value, found.low, found.high) == pytest.approx((ratio, ratio, ratio))
    for axes in figures.draw_methods(m).axes:  # no empty place for a method that was left out
        assert [label.get_text() for label in axes.get_xticklabels()] == ["i-S2R", "identified"]
    (tmp_path / "study.yaml").write_text("name: whole\n")  # where all was asked for, it is missing
    study = study_data.load(tmp_path)
    assert "seed 4, player1: cross-evaluation by player4, player5" in study.missing
    assert "seed 0, player3: evaluation of s2r-ft65, s2r-ft100, oracle-sim, oracle-ft" in study.missing


def test_rallies_that_no_figure_shows_are_named(tmp_path):
    path, strange = tmp_path / "evaluations.csv", {(0, "anna", "player3", "mine"): [4, 5]}
    scoring.write(path, rallies(strange | {(0, "player3", "player3", "is2r-ft100"): [6]}))
    study = study_data.load(tmp_path)
    missing = "; ".join(study.missing)
    assert "rallies with trainer anna (known are player1, " in missing and "with model mine" in missing
    assert "with evaluator" not in missing and study.rallies.length.tolist() == [6]
    scoring.write(path, rallies(strange))  # then there is no figure at all
    with pytest.raises(ConfigError, match="evaluations.csv: the figures have no place for any .* trainer anna"):
        study_data.load(tmp_path)
    path.write_text(path.read_text().replace("anna", ""))
    with pytest.raises(ConfigError, match="evaluations.csv: line 2: names and lengths are needed"):
        study_data.load(tmp_path)


DAMAGED = {  # file of a study: contents, what reads it
    "study.yaml": ([b"name: [", b"\x80\x81", b"- a"], study_data.load),
    "seed0/player5/balls/human_M1.yaml": ([b"garbage", b"\x80"], study_data.load),
    "evaluations.csv": ([b"\x80", b"seed\n1\n"], study_data.load),
    "seed0/reality.yaml": ([b"{", b"\x80"], lambda folder: study_data.load(folder).realities),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_a_damaged_file_is_named(tmp_path, name):
    contents, read = DAMAGED[name]
    folder = made_up_study.make(tmp_path, names=("player5",), cross=False)
    assert read(folder) is not None
    for content in contents:
        (folder / name).write_bytes(content)
        with pytest.raises(ConfigError) as said:
            read(folder)
        assert str(said.value).startswith(str(folder / name)), (content, str(said.value))


# Table end_of_rally_attribution, row by row as printed: did-robot-end-rally ("" where empty or a dash) and "Filter".
PRINTED = [
    ("", "Filter"),
    ("", "Filter"),
    ("Yes", ""),
    ("", "Filter"),
    ("Yes", ""),
    ("No", ""),
    ("No", ""),
    ("Yes", ""),
    ("", "Filter"),
    ("", "Filter"),
    ("No", ""),
    ("No", ""),
    ("Yes", ""),
    ("", "Filter"),
    ("", "Filter"),
]


def test_ends_are_attributed_as_in_the_papers_table():
    one = scoring.score_rallies(0, "p", "p", "m", "A", np.ones(15, int), [row[0] for row in ROWS[:15]])
    printed = {"Yes": 1, "No": 0, "": scoring.UNKNOWN}
    assert one.robot_ended.tolist() == [printed[who] for who, _ in PRINTED]
    assert one.filtered.tolist() == [what == "Filter" for _, what in PRINTED]


def test_a_return_beside_the_table_is_the_robots():
    one = scoring.score_rallies(0, "p", "p", "m", "A", [4], [End.ROBOT_OUT])
    assert one.robot_ended.tolist() == [1] and not one.filtered[0] and one.selected[0]


def test_selection_is_the_longest_five_sixths_of_the_first_sixty():
    rng = np.random.default_rng(1)
    for count in (10, 55, 64, 90):
        length, filtered = rng.integers(1, 30, count), rng.random(count) < 0.15
        chosen = scoring.choose_reported(length, filtered)
        pool = [i for i in range(count) if not filtered[i]][:60]
        wanted = {60: 50}.get(len(pool), round(len(pool) * 5 / 6))
        while len(pool) > wanted:  # take away the shortest, one by one; of equal ones the last played
            pool.remove(min(pool, key=lambda i: (length[i], -i)))
        assert np.flatnonzero(chosen).tolist() == pool


def test_fewer_rallies_that_count_do_not_shift_the_mean():
    """The same lengths, of 60 rallies 8 filtered or none: the means agree, as 50 of 52 and 50 of 60 would not."""
    rng, means = np.random.default_rng(4), []
    for dropped in (8, 0):
        end = np.where(np.arange(60) < dropped, End.SERVICE, End.ROBOT_MISSED)
        drawn = (scoring.score_rallies(0, "p", "p", "m", "A", rng.geometric(0.05, 60), end) for _ in range(2000))
        means.append([one.length[one.selected].mean() for one in drawn])
    few, many = np.mean(means, axis=1)
    assert few == pytest.approx(many, rel=0.02)  # each is known to 0.4 %
    assert many == pytest.approx(1.18 * 20.0, rel=0.02)
    assert [scoring.count_reported(n) for n in (0, 1, 52, 60)] == [0, 1, 43, 50]


def test_a_rally_after_the_sixtieth_is_not_reported_however_long():
    length = np.full(61, 3)
    length[60] = 300
    assert not scoring.choose_reported(length, np.zeros(61, bool))[60]
    filtered = np.zeros(61, bool)
    filtered[7] = True  # now it is the sixtieth that counts
    assert scoring.choose_reported(length, filtered)[60]


def test_the_file_keeps_every_rally(tmp_path):
    rng = np.random.default_rng(2)
    ends = rng.integers(0, len(End), 70)
    evaluations = ((0, "player1", "player1"), (0, "player1", "player4"), (3, "player2", "player2"))
    written = scoring.join(
        scoring.score_rallies(seed, trainer, evaluator, "is2r-ft100", "Q", rng.integers(1, 40, 70), ends)
        for seed, trainer, evaluator in evaluations
    )
    scoring.write(tmp_path / "evaluations.csv", written)
    read = scoring.read(tmp_path / "evaluations.csv")
    for name in scoring.COLUMNS:
        assert getattr(read, name).tolist() == getattr(written, name).tolist(), name
    assert read.own.sum() == 140
    lines = (tmp_path / "evaluations.csv").read_text().splitlines()
    assert lines[0] == "seed,trainer,evaluator,model,blind,rally,length,end,robot_ended,filtered,selected"
    assert len(lines) == 211


@pytest.mark.parametrize(
    "line",
    ["0,a,a,m,A,0,5,fell_asleep", "0,a,a,m,A,0,5,3", "0,a,a,m,A,0,long,robot_missed", "x,a,a,m,A,0,5,robot_missed"],
)
def test_a_bad_line_is_named(tmp_path, line):
    """An end by its number, too: it could be counted from 0 or from 1."""
    path = tmp_path / "evaluations.csv"
    path.write_text(",".join(scoring.COLUMNS[:8]) + "\n" + line + "\n")
    with pytest.raises(ConfigError, match="evaluations.csv: line 2: .* wanted are seed, trainer"):
        scoring.read(path)
