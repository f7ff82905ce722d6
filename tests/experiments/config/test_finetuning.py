"""Settings of fine-tuning: the paper's, nearer ones for policies by first-order gradients, and changes of both."""

from __future__ import annotations

import pytest

from experiments.config import experiment, finetuning


def shipped(name: str) -> experiment.Config:
    return experiment.load(experiment.shipped()[name])


def test_defaults_are_the_papers_but_for_policies_by_first_order_gradients():
    for trained in (None, shipped("quickstart")):
        settings = finetuning.load(trained=trained)
        assert (settings.sigma, settings.step.learning_rate) == (0.025, 0.00375)
    settings = finetuning.load(trained=shipped("robust"))
    assert (settings.sigma, settings.step.learning_rate) == (0.01, 0.0015)
    # The step of both is the same share of the perturbation, and all else is alike.
    assert settings.sigma / settings.step.learning_rate == pytest.approx(0.025 / 0.00375)
    assert settings.model_copy(update={"sigma": 0.025, "step": finetuning.FineTuning().step}) == finetuning.FineTuning()


def test_own_settings_come_before_both(tmp_path):
    path = tmp_path / "own.yaml"
    path.write_text("sigma: 0.02\n")
    settings = finetuning.load(path, ("step.learning_rate=0.001",), shipped("robust"))
    assert (settings.sigma, settings.step.learning_rate) == (0.02, 0.001)
