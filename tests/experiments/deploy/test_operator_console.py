"""The operator's view of a control process."""

from __future__ import annotations

from io import StringIO

from rich.console import Console

from experiments.deploy.operator_console import KEYS, View
from robot_io.control import messages
from robot_io.errors import RefusedError


def test_the_view_shows_state_faults_joints_and_counts():
    view = View(Console(file=StringIO(), force_terminal=True), "policy on robot")
    console = Console(record=True, width=300, file=StringIO())
    status = messages.Status(
        time=1.0,
        state="fault",
        paused=True,
        at_home=False,
        faults=(messages.FaultReport("estop", "the button is pressed"),),
        present={},
        arm=None,
        axes=None,
        tracker=None,
        joints=[("rail", "m", 0.1, 0.0), ("elbow", "rad", -1.0, 0.5)],
        balls=3,
        outcomes={"returned": 2, "missed": 1},
        rally=1,
        rallies=4,
        mean_rally=5.25,
        longest_rally=12,
        last_rally="2 touches: Human returning a ball over the table.",
        egm={"accepted": 1000, "rejected": {"stranger": 2}, "lost": 3},
        tracker_counts={"accepted": 40},
        axes_cycles=17,
        axes_late=4,
        log_dropped=5,
        ball=(0.1, -0.2, 0.02),
        clock={"drift": -4e-5, "seconds": 60},
        dry=True,
        stopped="not heard for 2 s",
        timings={"missed_ticks": 6, "tick": {"p50_ms": 1.0, "p99_ms": 2.0, "max_ms": 3.0}},
    )
    with view:
        view.take(messages.Refused(messages.Arm(), RefusedError("not now")))
        view.take(status)
        console.print(view._draw(status))
    text = console.export_text()
    for shown in (
        "ball +0.100 -0.200 +0.020 m in the table frame; tracker's clock +40.0 ppm over 60 s",
        "in thought",
        "FAULT estop: the button is pressed",
        "STOPPED: not heard for 2 s",
        "balls 3: 2 returned, 1 missed",
        "rally 1 touches; 4 rallies, 5.2 on average, longest 12; last: 2 touches: Human returning a ball over",
        "+0.100 m ",
        "-1.000 rad",
        "EGM 1,000 taken, 2 refused, 3 lost; tracker 40 taken",
        "17 cycles, 4 late; ticks missed 6; log lost 5",
        "not now",
        *(key.text for key in KEYS.values()),
    ):
        assert shown in text, shown
