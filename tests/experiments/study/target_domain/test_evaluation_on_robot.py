"""Rallies of a virtual player on the emulated robot that count in a study, on a machine that is late."""

from __future__ import annotations

import io
import json
import multiprocessing
import os
import shutil
import signal
import threading
import time

import numpy as np
import pytest
from rich.console import Console

from experiments.study.analysis import scoring
from experiments.study.target_domain.evaluation_on_robot import rally_step
from tests.support.paths import ROOT

POLICY = ROOT / "experiments/shipped/policies/quickstart"
RALLIES = 5  # that count
BEFORE = 2  # rallies before the machine is late, whether they count or not
STOPPED, PERIOD = 0.15, 0.5  # [s] the arm's controller stands still; often enough that no recovery is left in peace


def late_until_a_session_has_ended(folder, said: io.StringIO, over: threading.Event) -> None:
    """Stop the process of the arm again and again after a few rallies, until the first session's report is there."""
    while said.getvalue().count("rally ") < BEFORE and not over.is_set():
        time.sleep(0.05)
    while not list(folder.glob("*.json")) and not over.is_set():
        for process in multiprocessing.active_children():
            if process.name == "rig-arm":
                os.kill(process.pid, signal.SIGSTOP)
                time.sleep(STOPPED)
                os.kill(process.pid, signal.SIGCONT)
        time.sleep(PERIOD - STOPPED)


@pytest.mark.slow
@pytest.mark.realtime
def test_rallies_that_faults_cut_short_go_on_in_another_session_and_all_count(tmp_path):
    """The real rig, its controller's process stopped until it is not brought back after a fault."""
    run, folder, said, over = tmp_path / "run", tmp_path / "rallies", io.StringIO(), threading.Event()
    shutil.copytree(POLICY, run)
    folder.mkdir()
    step = rally_step(
        folder, (0, "player3", "player3", "zero_shot"), lambda: run, (), RALLIES, Console(file=said, width=200)
    )
    disturbing = threading.Thread(target=late_until_a_session_has_ended, args=(folder, said, over))
    disturbing.start()
    try:
        step.run()
    finally:
        over.set()
        disturbing.join()
    reports = [json.loads(path.read_text()) for path in sorted(folder.glob("2*.json"))]
    played = [rally for report in reports for rally in report["rallies"]["list"]]
    count = [sum(not rally["filtered"] for rally in report["rallies"]["list"]) for report in reports]
    assert len(reports) >= 2 and len(reports[0]["rallies"]["list"]) >= BEFORE, said.getvalue()
    assert count[0] < RALLIES and sum(count) == RALLIES, (count, said.getvalue())
    assert reports[0]["faults"] and f"{RALLIES - count[0]} of {RALLIES} rallies are left" in said.getvalue()
    counted = scoring.read(step.outputs[0])
    np.testing.assert_array_equal(counted.length, [rally["length"] for rally in played])
    np.testing.assert_array_equal(counted.filtered, [rally["filtered"] for rally in played])
