"""``mjx-tt robot new``, ``list`` and ``place`` as a user runs them."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml

from experiments.cli import main
from mjx_tt.robot import robots
from tests.support.paths import ROOT

SHIPPED = ROOT / "mjx_tt" / "assets" / "robots"
TWO_JOINTS = """<mujoco>
  <worldbody>
    <body name="upper"><joint name="shoulder" axis="0 0 1" range="-120 120"/>
      <geom name="col_upper" type="capsule" fromto="0 0 0 .4 0 0" size=".04"/>
      <body name="lower" pos=".4 0 0"><joint name="elbow" axis="0 0 1"/>
        <geom name="col_blade" type="capsule" fromto="0 0 0 .4 0 0" size=".04"/>
      </body>
    </body>
  </worldbody>
  <actuator><velocity joint="shoulder" kv="50"/><velocity joint="elbow" kv="50"/></actuator>
</mujoco>
"""


def copied(name: str, folder: Path) -> Path:
    """The MJCF of a shipped robot alone."""
    return Path(shutil.copy(SHIPPED / name / "robot.xml", folder / "robot.xml"))


def test_the_first_yaml_of_an_incomplete_mjcf_names_what_is_missing_and_is_not_overwritten(tmp_path, capsys):
    mjcf = tmp_path / "two.xml"
    mjcf.write_text(TWO_JOINTS)
    assert main(["robot", "new", str(mjcf), "--no-reachable"]) == 1
    said = capsys.readouterr().out
    file = tmp_path / "description.yaml"
    assert f"{file}: written" in said and "paddle" in said and "mend" in said
    draft = yaml.safe_load(file.read_text())
    assert draft["joints"]["shoulder"]["range"] == pytest.approx(np.deg2rad([-120.0, 120.0]), abs=1e-4)
    file.write_text(file.read_text() + "# mine\n")
    assert main(["robot", "new", str(mjcf), "--no-reachable"]) == 1
    assert "checked, not changed" in capsys.readouterr().out and file.read_text().endswith("# mine\n")


def test_the_first_yaml_of_a_whole_mjcf_loads_as_a_robot(tmp_path, capsys):
    mjcf, picture = copied("ur10e_rail", tmp_path), tmp_path / "home.png"
    assert main(["robot", "new", str(mjcf), "--no-reachable", "--picture", str(picture)]) == 0, capsys.readouterr().out
    robot = robots.load(tmp_path)
    model = mujoco.MjModel.from_xml_path(str(mjcf))
    assert robot.contract.joints == tuple(model.joint(i).name for i in range(model.njnt))
    assert [robot.contract.joints[i] for i in robot.contract.carrying] == ["rail"]
    assert robot.contract.limits.lower == pytest.approx(model.jnt_range[:, 0], abs=1e-4)
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_a_robot_that_is_placed_badly_is_placed_better(tmp_path, capsys):
    """Turned away from the table by a right angle, whose return no motion reaches: the search has to turn it back."""
    folder = Path(shutil.copytree(SHIPPED / "fr3_pedestal", tmp_path / "fr3"))
    file = folder / "description.yaml"
    text = file.read_text()
    yaw = float(re.search(r"yaw: ([-\d.]+)", text).group(1))
    file.write_text(text.replace(f"yaw: {yaw:g}", f"yaw: {yaw + 1.6:.4f}"))
    before = robots.load(folder)
    assert main(["robot", "place", str(folder), "--samples", "24"]) == 0, capsys.readouterr().out
    after = robots.load(folder)
    assert after.contract.joints == before.contract.joints and after.home.shape == before.home.shape
    assert not np.allclose(after.file.yaw, before.file.yaw)
    model = after.model()
    data = mujoco.MjData(model)
    data.qpos[: model.nq] = after.home
    mujoco.mj_forward(model, data)
    assert data.ncon == 0
