"""Likeness of balls to strokes, of the same people's and of a box; and the mixture that fit-human writes."""

from __future__ import annotations

import numpy as np
import pytest

from ballmodel import registry
from ballmodel.distribution import BallMixture
from experiments import cli
from experiments.evaluation.human_likeness import likeness
from tests.mjx_tt.prediction.test_predict import spinning


@pytest.mark.slow
def test_likeness_tells_a_box_from_its_gaussian():
    rng = np.random.default_rng(0)
    mixed = rng.standard_normal((6, 6))
    known, held, same = (rng.standard_normal((n, 6)) @ mixed for n in (600, 200, 200))
    box = rng.uniform(known.min(axis=0), known.max(axis=0), (200, 6))
    alike, unlike = likeness(same, held, known), likeness(box, held, known)
    assert alike.low < 0.5 < alike.high + 0.06 and alike.far < 0.06
    assert unlike.auc > 0.9 and unlike.far > 0.6 and unlike.low < unlike.auc < unlike.high


@pytest.mark.slow
def test_fit_human_finds_spins_of_trajectories_and_writes_a_mixture(tmp_path, capsys):
    tracks, _, spins = spinning()
    rows = [
        f"{t.session},{t.name},{s},{x},{y},{z}"
        for t in tracks
        for s, (x, y, z) in zip(t.time, t.position.T, strict=True)
    ]
    (tmp_path / "log.csv").write_text("\n".join(["session,trajectory,t,x,y,z", *rows]) + "\n")
    (tmp_path / "lift.yaml").write_text("ball: {flight: {magnus_coefficient: 0.6, drag_coefficient: 0.4}}\n")
    given = ["fit-human", str(tmp_path / "log.csv"), "--model", str(tmp_path / "lift.yaml")]
    out = ["--out", str(tmp_path / "box.yaml"), "--mixture", str(tmp_path / "mixture.yaml")]
    assert cli.main([*given, *out]) == 0
    assert "too few to hold out a quarter" in " ".join(capsys.readouterr().out.split())
    mixture = registry.resolve(tmp_path / "mixture.yaml")
    assert isinstance(mixture, BallMixture) and (tmp_path / "mixture.png").stat().st_size > 10_000
    assert abs(float(mixture.weights @ mixture.means[:, 6]) - spins[0].mean()) < 20.0  # of those that clear the net
