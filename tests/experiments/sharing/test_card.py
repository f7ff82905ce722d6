"""The card says what was measured, with its interval, and of which kind of evaluation it is."""

from __future__ import annotations

import pytest

from experiments.runs.locate import SHIPPED
from experiments.sharing import card
from experiments.stats import wilson
from robot_io.policy import artefact as artefacts


@pytest.fixture(scope="module")
def artefact():
    return artefacts.load(SHIPPED / "quickstart")


def write(artefact, evaluation) -> str:
    return card.write(artefact, artefact.manifest["provenance"]["config"], evaluation)


def row(text: str, name: str) -> list[str]:
    (line,) = [line for line in text.splitlines() if line.startswith(f"| {name} |")]
    return [cell.strip() for cell in line.strip("|").split("|")][1:]


def test_figures_come_with_their_intervals_and_conditions(artefact):
    evaluation = artefact.manifest["provenance"]["evaluation"]
    text = write(artefact, evaluation)
    n, counts = evaluation["episodes"], evaluation["outcomes"]
    for name, k in (("returned", counts["returned"]), ("hit", counts["returned"] + counts["hit"])):
        low, high = wilson(k, n)
        expected = [f"{100 * k / n:.1f} %", f"{100 * low:.1f} % to {100 * high:.1f} %", f"{n:,} balls"]
        assert row(text, name) == expected
    assert row(text, "in reach, at least")[2] == "256 of them"
    for words in ("balls of player3/M0", "seed 1000", "engine fused, 300 Hz", "nominal model", "without randomisation"):
        assert words in " ".join(text.split())
    assert artefact.digest in text and "not stated" in text and "license:" not in text


def test_an_evaluation_after_fine_tuning_names_the_robot(artefact):
    after = {"return_rate": 0.5, "return_rate_low": 0.4, "return_rate_high": 0.6, "balls": 80, "mean_return": 1.0}
    text = write(artefact, {"after": after, "updates": 12, "robot": {"robot": "the rig", "balls": 3}})
    assert row(text, "returned") == ["50.0 %", "40.0 % to 60.0 %", "80 balls"]
    assert "fine-tuned for 12 updates on the rig" in text and "Played there" in text
    assert "on no robot" not in text and "2,600 updates" not in text
