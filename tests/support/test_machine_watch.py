"""The watch over the machine, by processes that are stopped on purpose."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import pytest

from tests.support.machine_watch import MachineWatch
from tests.support.paths import ROOT

# A test that fails at its first two runs, in which a core's watch is stopped if told so.
FAILS_TWICE = """
import os, pathlib, signal, time
import pytest
from tests.support import machine_watch

RUNS = pathlib.Path(__file__).with_name("runs")

@pytest.mark.realtime
def test_it():
    RUNS.open("a").write("x")
    if {stops}:
        watch = machine_watch._machine().processes[0].pid
        os.kill(watch, signal.SIGSTOP)
        time.sleep(5 * machine_watch.PAUSE)
        os.kill(watch, signal.SIGCONT)
        time.sleep(0.05)
    else:
        machine_watch._machine().reset()  # whatever this machine does meanwhile
    assert len(RUNS.read_text()) > 2
"""


def test_a_pause_of_one_core_is_measured():
    watch = MachineWatch()
    try:
        one = watch.processes[-1].pid
        watch.reset()
        os.kill(one, signal.SIGSTOP)
        time.sleep(0.2)
        os.kill(one, signal.SIGCONT)
        time.sleep(0.1)
        assert 0.19 < watch.longest() < 1.0
        watch.reset()
        assert watch.longest() < 0.19
    finally:
        watch.close()
    assert not any(process.is_alive() for process in watch.processes)


@pytest.mark.parametrize("stops, status, runs", [(True, 0, 3), (False, 1, 1)])
def test_run_again_is_what_failed_while_the_machine_stood_alone(tmp_path, stops, status, runs):
    (tmp_path / "test_it.py").write_text(FAILS_TWICE.format(stops=stops))
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers =\n    realtime: keeps time\n")
    command = [sys.executable, "-m", "pytest", "-p", "tests.support.machine_watch", "-p", "no:cacheprovider", "."]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=60, env=os.environ | {"PYTHONPATH": str(ROOT)}
    )
    assert done.returncode == status, done.stdout + done.stderr
    assert len((tmp_path / "runs").read_text()) == runs
    assert ("2 rerun" in done.stdout) == stops
