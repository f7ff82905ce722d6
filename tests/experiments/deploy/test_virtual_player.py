"""A virtual player as the rig's opponent: the decisions of the simulator's player, in another process by name."""

from __future__ import annotations

import pickle

import jax
import numpy as np

from experiments.deploy.virtual_player import VirtualPlayer
from mjx_tt.rally import human_player
from robot_io.control.kinks import landing
from robot_io.emulator.opponent import Stroke


def test_it_plays_as_in_the_simulator_and_travels_by_name():
    player = VirtualPlayer("player3", seed=4)
    other = pickle.loads(pickle.dumps(player))
    for one in (player, other):
        one.prepare()
    first, again = player.serve(), other.serve()
    person, key = human_player.load("player3"), jax.random.fold_in(jax.random.key(4), 1)
    expected = human_player.first_ball(person, human_player.fresh(), key, ())
    np.testing.assert_allclose(first.velocity, expected.velocity, rtol=1e-4, atol=1e-4)
    np.testing.assert_array_equal(first.position, again.position)
    plane, height = player.wish()
    assert person.strokes.plane.low <= plane <= person.strokes.plane.high
    assert person.strokes.height.low <= height <= person.strokes.height.high
    ball = Stroke(np.array([0.1, 1.6, 0.25]), np.array([0.1, 3.0, -1.0]), np.zeros(3))
    answers = [player.answer(ball, np.array([0.1, 0.8]), 0.7) for _ in range(12)]
    hit = [stroke for stroke in answers if stroke is not None]
    assert len(hit) >= 8 and all(stroke.velocity[1] < -2.0 for stroke in hit)
    places = np.array([landing(stroke.position, stroke.velocity) for stroke in hit])
    assert (np.median(places, axis=0)[1] < -0.2) and len(np.unique(places, axis=0)) == len(hit)
    tired = float(player._state.tiredness)
    player.rest()
    assert 0.0 < float(player._state.tiredness) < tired


def test_nothing_is_compiled_in_mid_play(caplog):
    player = VirtualPlayer("player3")
    player.prepare()
    ball = Stroke(np.array([0.1, 1.6, 0.25]), np.array([0.1, 3.0, -1.0]), np.zeros(3))
    with jax.log_compiles(), caplog.at_level("WARNING"):
        for _ in range(2):
            player.serve()
            for _ in range(2):
                player.wish()
                player.answer(ball, np.array([0.2, 0.8]), 0.4)
            player.rest()
    assert not [record.message for record in caplog.records if "Compiling" in record.message]
