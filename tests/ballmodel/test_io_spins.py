"""Sets with measured spin, in files of the published forms."""

from __future__ import annotations

import numpy as np
import pytest

from ballmodel.io import MeasuredStates, read, read_events, read_spindoe


def test_spindoe(tmp_path):
    (tmp_path / "index.csv").write_text("traj_file;x_spin;y_spin;z_spin\n001.csv;10;-2;3.5\n002.csv;0;0;100\n")
    (tmp_path / "001.csv").write_text("0.00;0.1;1.2;0.3\n0.01;0.1;1.1;0.31\n0.01;0.1;1.1;0.31\n0.02;0.1;1.0;0.31\n")
    (tmp_path / "002.csv").write_text("t;x;y;z\n0.5;0;1;0.2\n0.6;0;0.5;0.2\n")
    found = read_spindoe(tmp_path)
    assert [t.name for t in found] == ["001", "002"] and found.notes == (
        "001.csv: 1 samples that repeat a time were left out",
    )
    np.testing.assert_array_equal(found.spin, [[10, 0], [-2, 0], [3.5, 100]])
    np.testing.assert_array_equal(found.trajectories[0].time, [0.0, 0.01, 0.02])
    (tmp_path / "002.csv").unlink()
    with pytest.raises(FileNotFoundError, match="002.csv"):
        read_spindoe(tmp_path)
    (tmp_path / "index.csv").write_text("traj_file;x_spin\n001.csv;10\n")
    with pytest.raises(ValueError, match="index.csv: column y_spin, z_spin is missing"):
        read_spindoe(tmp_path)
    (tmp_path / "index.csv").unlink()
    with pytest.raises(FileNotFoundError, match=r"index\.csv: no such file; in SpinDOE's form"):
        read_spindoe(tmp_path)


HEAD = "player_id,rally_id,type,timestamp,ball_pos,ball_vel_out,ball_spin_out\n"


def test_events(tmp_path):
    path = tmp_path / "ace.csv"
    path.write_text(
        HEAD + 'a,1,shot,0.5,"[1.4, 0.2, 0.3]","[-6.0, 0.1, 1.0]","[0.0, -120, 5e0]"\n'
        'a,1,bounce,0.9,"[-0.7 0.3 0.02]","[-5, 0, 2]","[0 1 2]"\n'
        'a,2,shot,2.0,"[1.4, 0, 0.3]","[]","[]"\n'
        'a,2,bounce,2.4,"[-0.7, 0, 0]","[-5, 0, 2]","[0, 1, 2]"\n'
    )
    found = read_events(path)
    assert len(found) == 3 and found.rally == ("1", "1", "2")
    np.testing.assert_allclose(found.state.position[:, 0], [-0.2, 1.4, 0.3])
    np.testing.assert_allclose(found.state.velocity[:, 0], [-0.1, -6.0, 1.0])
    np.testing.assert_allclose(found.state.spin[:, 0], [120.0, 0.0, 5.0])
    assert [list(i) for i in found.landings] == [[0], [1]]
    # Rows as published ones are: a player in the type, a rally id of each row's own, nets.
    rally = (
        HEAD + 'p1,m1/r0/event0,shot_p1,0.5,"[1.4, 0.2, 0.3]","[-6.0, 0.1, 1.0]","[0, 0, 0]"\n'
        'p1,m1/r0/event1,bounce_p2,0.9,"[-0.7, 0.3, 0.02]","[-5, 0, 2]","[0, 1, 2]"\n'
        'p2,m1/r0/event2,net,1.2,"[0, 0, 0.1]","[0, -0.5, -1]","[0, 0, 0]"\n'
    )
    path.write_text(rally)
    players = read_events(path)
    assert players.rally == ("m1/r0", "m1/r0") and [list(i) for i in players.landings] == [[0], [1]]
    path.write_text(
        rally
        + 'p1,m1/r1/event0,shot_p1,3.0,"[1.4, 0.2, 0.3]","[-6.0, 0.1, 1.0]","[0, 0, 9]"\n'
        + 'p1,m1/r1/event1,shot_p2,3.5,"[-1, -1, -1]","[0, 0, 0]","[0, 0, 0]"\n'  # stands for a ball that was lost
    )
    shots = read(path)
    assert isinstance(shots, MeasuredStates) and len(shots) == 2
    np.testing.assert_allclose(shots.state.spin, [[0.0, 0.0], [0.0, 0.0], [0.0, 9.0]])
    np.testing.assert_allclose(shots.landing, [[-0.3, np.nan], [-0.7, np.nan]])
    path.write_text(HEAD + 'a,1,serve,0.5,"[1,2,3]","[1,2,3]","[1,2,3]"\n')
    with pytest.raises(ValueError, match="row 2, column 'type': 'serve'; allowed: shot, bounce, net"):
        read_events(path)
