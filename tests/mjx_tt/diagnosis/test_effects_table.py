"""The catalogue is the only description of an effect: the reference page and the examination agree with it."""

from __future__ import annotations

from mjx_tt.diagnosis.ball import effects as ball
from mjx_tt.diagnosis.effects_table import markdown
from mjx_tt.diagnosis.joint import effects as joint
from mjx_tt.sim.model import paths
from tests.support.paths import ROOT


def test_the_reference_page_is_the_catalogue():
    page = (ROOT / "docs" / "reference" / "effects.md").read_text(encoding="utf-8")
    assert page == markdown(), "run: python -m mjx_tt.diagnosis.effects_table docs/reference/effects.md"
    for name in (*ball.DESCRIPTIONS, *joint.DESCRIPTIONS):
        assert f"`{name}`" in page


def test_every_effect_moves_a_parameter_that_exists():
    known = set(paths())
    for effect in ball.EFFECTS:
        assert effect.path in known or effect.name == "magnus", effect.name
        assert {twin.path for twin in effect.twins} <= known
