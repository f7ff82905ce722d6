"""One compiled recorder for all tests of the viewer."""

import pytest

from ballmodel import registry
from experiments.runs import load_policy
from experiments.runs.locate import SHIPPED
from experiments.view.playlist import PolicyPlaylist
from experiments.view.recorder import Recorder
from mjx_tt.env.task import TaskConfig
from mjx_tt.sim.model import ModelFile, SimModel


@pytest.fixture(scope="package")
def recorder():
    return Recorder(TaskConfig(sim_rate=150.0), ModelFile(SimModel()))


@pytest.fixture(scope="package")
def policy():
    return load_policy.load(SHIPPED / "quickstart").policy


@pytest.fixture
def play(recorder, policy):
    return PolicyPlaylist(recorder, ["quickstart"], [policy], registry.load("player3/M0"))


@pytest.fixture
def pair(recorder, policy):
    """The same policy at two tables."""
    return PolicyPlaylist(recorder, ["one", "other"], [policy, policy], registry.load("player3/M0"))
