"""Values of a verdict that go into the extended model, by parts written out by hand."""

from __future__ import annotations

from mjx_tt.diagnosis.verdict import NOT_ADOPTED, Cause, Estimate, Expressed, HeldOut, Part, Unexplained, combined

WIND = "ball.flight.wind_x"
BETTER = HeldOut("rms", 50.0, 15.0, 30.0, 36.0)


def _named(name: str, path: str, value: float) -> Expressed:
    estimate = Estimate(0.0, value, value - 0.1, value + 0.1, "m/s")
    return Expressed.by(Cause(name, (name,), 1.0, {path: estimate}, 10.0, ""), {path: estimate})


def test_nothing_beside_the_unexplained_is_trained_on():
    block = Unexplained("force over speed", "near 3 m/s", "x", "60.0 mm")
    ball = Part((_named("wind_x", WIND, 0.3),), {}, unexplained=block, held_out=BETTER)
    joints = Part((_named("joint_1.lag", "robot.lag_1", 0.02),))
    verdict, values, ranges = combined([ball, joints], ["a note"])
    assert verdict.verdict == "unexplained" and [c.name for c in verdict.causes] == ["wind_x", "joint_1.lag"]
    assert values == {"robot.lag_1": 0.02} and [r.path for r in ranges] == ["robot.lag_1"]
    assert verdict.warnings == ("a note", NOT_ADOPTED)


def test_causes_that_predict_worse_are_not_trained_on():
    worse = HeldOut("rms", 50.0, 55.0, -8.0, -2.0)
    verdict, values, ranges = combined([Part((_named("wind_x", WIND, 0.3),), held_out=worse)])
    assert verdict.verdict == "undetermined" and values == {} and ranges == ()
