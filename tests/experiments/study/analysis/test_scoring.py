"""Which rallies count: against the paper's table copied by hand, and against selection by another algorithm."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.errors import ConfigError
from experiments.study.analysis import scoring
from mjx_tt.rally.end_reasons import ROWS, End

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
