"""The viewer without a browser: what its controls do to the play, and what the scene then shows."""

import numpy as np
import pytest

from experiments.view.auth import Server
from experiments.view.controls import ONE_BALL
from experiments.view.playlist import FixedPlaylist
from experiments.view.replay import RATE, Replay, Series
from experiments.view.viewer import REST, Viewer
from mjx_tt.robot.mjcf import home_qpos, load_model

SECONDS, SPEED = 0.5, 4.0


def flight(title: str, **changes) -> Replay:
    """A ball at 4 m/s towards the robot, 0.3 m over the table, for half a second."""
    time = np.arange(round(SECONDS * RATE) + 1) / RATE
    ball = np.stack([0.0 * time, 1.2 - SPEED * time, 0.3 + 0.0 * time], axis=1)
    curves = {"speed [m/s]": Series(("y",), time, np.full((len(time), 1), -SPEED))}
    qpos = np.tile(home_qpos(load_model()), (len(time), 1))
    terms = {"hit": (0.5, 2.0), "jerk": (-1.0, 0.25)}
    given = {"outcome": "returned", "decided": 0.4, "series": curves, "terms": terms, "events": ((0.1, "a <b>"),)}
    return Replay(time, qpos, {"ball": ball}, title, **given | changes)


@pytest.fixture(scope="module")
def server():
    server = Server("127.0.0.1", 0)
    yield server
    server.stop()


@pytest.fixture
def viewer(server):
    server.gui.reset()
    server.scene.reset()
    return Viewer(server, FixedPlaylist([[flight("one")], [flight("two", outcome="missed")]], ["first", "second"]))


def test_time_passes_at_the_speed_that_is_chosen_and_the_next_ball_follows(viewer):
    viewer.advance(0.2)
    assert viewer.t == pytest.approx(0.2) and viewer._time.value == pytest.approx(0.2)
    viewer._speed.value = 0.5
    viewer.advance(0.1)
    assert viewer.t == pytest.approx(0.25)
    viewer._speed.value = 1.0
    viewer.advance(SECONDS + REST)
    assert (viewer.number, viewer.t, viewer._caption.content) == (1, 0.0, "**second**")
    viewer.go(-1)
    assert viewer.number == 1 and viewer.controls is None
    viewer.t = SECONDS + 0.3  # it rests on the last frame
    for button, t in (("▶", SECONDS), ("◀", SECONDS - 1 / 75), ("◀", SECONDS - 2 / 75)):
        viewer._step(button)
        assert viewer.t == pytest.approx(t)
    viewer.advance(1.0)
    assert not viewer.playing and viewer.t == pytest.approx(SECONDS - 2 / 75)


def test_curves_grow_with_time_and_rewards_come_after_the_ball(viewer):
    viewer._plotted = 0.0
    viewer._seek(0.2)
    viewer.advance(0.0)
    (plot,) = viewer._plots.values()
    assert plot.data[0][-1] == pytest.approx(0.2, abs=2 / RATE) and "after the ball" in viewer._rewards.content
    assert "0.10 s: a &lt;b&gt;" in viewer._events.content
    viewer._plotted = 0.0
    viewer._seek(0.45)
    viewer.advance(0.0)
    assert "<b>0.75</b>" in viewer._rewards.content  # 0.5 x 2 - 1 x 0.25


def test_what_the_page_asks_for_waits_for_the_loop_and_a_newer_wish_replaces_an_older_one(viewer):
    asked = []
    viewer.enqueue("ball", lambda: asked.append(1))
    viewer.enqueue("ball", lambda: (asked.append(2), viewer.stop()))
    assert not asked
    viewer.run()
    assert asked == [2]


def test_controls_choose_balls_and_physics(server, play):
    server.gui.reset()
    server.scene.reset()
    viewer = Viewer(server, play)
    controls = viewer.controls
    np.testing.assert_allclose([h.value for h in controls._state[:3]], play.state(0)[:3], atol=0.01)
    np.testing.assert_allclose(controls.gizmo.position, play.state(0)[:3], atol=1e-4)
    slider, handle = controls._sliders["ball.table.restitution"]
    assert handle.value == pytest.approx(play.values[slider.path] / slider.unit, abs=1e-5)
    controls._play_one(np.array([0.1, 1.0, 0.3, 0.0, -4.5, 1.0, 0.0, 0.0, 0.0]))
    assert play.balls is None and controls._balls.value == ONE_BALL
    assert controls._state[4].value == pytest.approx(-4.5)
    controls._balls.value = "narrow"
    controls._choose_balls()
    assert play.balls == "narrow" and "Ball 1 of narrow" in viewer._caption.content
    play.values["latency.ball_observation"] = 0.09
    controls._find_misses()
    assert "Missed ball 1" in viewer._caption.content and not viewer.shown[0].outcome.startswith("returned")
    play.values[slider.path] = 0.5
    controls._reset()
    assert play.values == play.recorder.nominal() and handle.value == pytest.approx(play.values[slider.path], abs=1e-5)
