"""The catalogue is the only description of an effect: the reference page and the examination agree with it."""

from __future__ import annotations

from mjx_tt.diagnosis.ball import effects as ball
from mjx_tt.diagnosis.effects_table import markdown
from mjx_tt.diagnosis.joint import effects as joint
from mjx_tt.sim.model import paths
from tests.exam.generator import cases
from tests.support.paths import ROOT

# Catalogue names without a hidden case of their own.
NOT_EXAMINED = {
    "ball_radius",  # a twin of drag, as the mass is
    "magnus_coefficient",  # named as magnus, the nominal ball does not spin
    "spin_decay",
    "lift_saturation",  # ball/test_spins
    "table_grip",  # test_ball: most balls of people and of the exam slide
    "tracker_filter",  # cases of their own: Kalman filters
    "tracker_gate",
    "paddle_restitution",  # hits: test_hits
    "paddle_friction",
    "paddle_tilt",
    "paddle_offset",
    "ball_latency",
}


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


def test_hidden_cases_and_catalogue_name_the_same_effects():
    """The generator knows nothing of the catalogue, so that names are all that the two share."""
    hidden = {*cases.EFFECTS, *cases.INVISIBLE}
    beside = {name for e in cases.EFFECTS.values() for name in (*e.twins, *e.kin)}
    assert hidden == set(ball.DESCRIPTIONS) - NOT_EXAMINED
    assert beside <= set(ball.DESCRIPTIONS)
    assert {name for pair in cases.LOOKALIKES for name in pair} <= hidden
    assert {*cases.ROBOT_EFFECTS, "joint_offset"} == set(joint.DESCRIPTIONS)
    for effect in ball.EFFECTS:
        if effect.name in cases.EFFECTS and not effect.made_of:  # of balls that do not spin it is a twin
            twins = {effect.name, *(twin.name for twin in effect.twins)} - NOT_EXAMINED
            assert {effect.name, *cases.EFFECTS[effect.name].twins} == twins
