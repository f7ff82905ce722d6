"""Stalls in real time while balls are played on the rig: ``python -m benchmarks.rig_stalls ARTEFACT [--stalls 50]``.

The control process is stopped by SIGSTOP, the tracker falls silent, the cables of axes or arm are pulled, each for 0.05
to 5 s. After every fault: how far the reference of the log is from the true arm, and the operator's one key.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import time
from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from rich.console import Console

from experiments.commands.options import RobotOptions
from experiments.deploy.control_session import ControlSession
from experiments.deploy.recovery import Recovery
from experiments.deploy.rig import rig_for
from robot_io import log
from robot_io.contract import LIMITS, N_JOINTS
from robot_io.control.messages import Refused, Status
from robot_io.control.process import ControlOptions
from robot_io.emulator.processes import Rig
from robot_io.errors import RefusedError
from robot_io.policy import artefact as artefacts

KINDS = ("bridge", "tracker", "axes", "arm")
SHORTEST, LONGEST = 0.05, 5.0  # [s]
AFTER = 1.5  # [s] from the end of a stall to the look at where the robot is


def main(arguments: list[str] | None = None) -> int:
    """Stalls, prints what came of them; 1 when a fault was not recovered or an exception left the loop."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("artefact", type=Path)
    parser.add_argument("--stalls", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args(arguments)
    random, found, looks = np.random.default_rng(chosen.seed), Counter[str](), []
    outside = 0.0
    loaded = artefacts.load(chosen.artefact)
    with TemporaryDirectory() as folder, rig_for(loaded, RobotOptions(seed=chosen.seed)) as rig:
        options = ControlOptions(str(chosen.artefact), log_folder=folder, log_name="stalls")
        with ControlSession(rig.robot, options, Console()) as session:
            try:
                session.prepare(rig)
                session.arm()
            except RefusedError:
                session.recover(rig)
            rig.throw(True)
            for number in range(chosen.stalls):
                listen(session, random.uniform(0.5, 2.0))
                kind = KINDS[random.integers(len(KINDS))]
                seconds = float(np.exp(random.uniform(np.log(SHORTEST), np.log(LONGEST))))
                stall(rig, session, kind, seconds)
                outside = max(outside, watch(rig, session, AFTER))
                found["stalls"] += 1
                faults = session.status.faults if session.status else ()
                if not faults:
                    continue
                looks.append((time.monotonic(), rig.state()[0].copy()))
                found["faults"] += 1
                found[f"{faults[0].cause} of {kind}"] += 1
                refused = recovered(rig, session)
                found["recovered"] += not refused
                if refused:
                    print(f"{number} {kind} {seconds:.2f} s, {faults[0]}: {refused}", flush=True)
                    session.recover(rig)
        commands = log.read(Path(folder) / "stalls.mcap").commands
        timings = session.timings
    at = np.searchsorted(commands.time, [when for when, _ in looks]) - 1
    away = np.abs(commands.reference[:, at].T - np.array([place for _, place in looks]).reshape(-1, N_JOINTS))
    for what, count in found.most_common():
        print(f"{count:6d}  {what}")
    print(
        f"reference away from the arm at most {1e3 * away[:, :2].max(initial=0.0):.1f} mm, "
        f"{np.degrees(away[:, 2:].max(initial=0.0)):.2f} deg"
    )
    print(f"joints outside their ranges by at most {outside:.4f}; {timings}")
    return int(found["recovered"] < found["faults"])


def listen(session: ControlSession, seconds: float) -> None:
    """Take what the control process sends."""
    for _ in session.messages(seconds):
        pass


def watch(rig: Rig, session: ControlSession, seconds: float) -> float:
    """Farthest that a joint is outside its range [m], [rad] meanwhile."""
    end, worst = time.monotonic() + seconds, 0.0
    while time.monotonic() < end:
        listen(session, 0.02)
        place = rig.state()[0]
        worst = max(worst, float(np.maximum(LIMITS.lower - place, place - LIMITS.upper).max()))
    return worst


def stall(rig: Rig, session: ControlSession, kind: str, seconds: float) -> None:
    """Stop one of them for a while."""
    if kind == "tracker":
        rig.drop_out(seconds)
        listen(session, seconds)
    elif kind == "bridge" and session.process.pid is not None:
        os.kill(session.process.pid, signal.SIGSTOP)
        time.sleep(seconds)
        os.kill(session.process.pid, signal.SIGCONT)
    else:
        pull(rig, kind, False)
        listen(session, seconds)
        pull(rig, kind, True)


def pull(rig: Rig, kind: str, connected: bool) -> None:
    if kind == "arm":
        rig.connect_arm(connected)
    else:
        for axis in (0, 1):
            rig.connect_axis(axis, connected)


def recovered(rig: Rig, session: ControlSession) -> str:
    """The operator's one key, once the arm's controller is on again; why it failed, empty: it did not."""
    rig.switch_on()
    recovery = Recovery(time.monotonic(), session.status, emulated=True)
    while not recovery.done:
        for message in session.messages(0.3):
            if isinstance(message, Refused) and recovery.refused(message):
                return message.sentence
            if isinstance(message, Status):
                try:
                    request = recovery.step(message, time.monotonic())
                except TimeoutError as error:
                    return str(error)
                if request is not None:
                    session.send(request)
                break
    end = time.monotonic() + 15.0
    while time.monotonic() < end:
        for message in session.messages(0.3):
            if isinstance(message, Refused):
                return message.sentence
            if isinstance(message, Status) and message.faults:
                return f"a fault again: {message.faults[0]}"
            if isinstance(message, Status) and message.at_home:
                return ""
    return "not at home within 15 s"


if __name__ == "__main__":
    sys.exit(main())
