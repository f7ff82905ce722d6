"""Means of an ordinary Linux process to be on time, and undisturbed; every refusal is reported, none is an error."""

from __future__ import annotations

import ctypes
import gc
import os
import signal
import sys

MCL_CURRENT, MCL_FUTURE = 1, 2


def prepare(priority: int | None = 50, lock_memory: bool = True) -> list[str]:
    """To be called by the control process after everything is imported and warmed up. What was done and refused.

    priority: of SCHED_FIFO; None keeps ordinary scheduling.
    """
    report = []
    if priority is not None:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
            report.append(f"real-time scheduling: SCHED_FIFO {priority}")
        except (OSError, AttributeError) as error:
            report.append(f"real-time scheduling refused ({error}): ticks will be late more often")
    if lock_memory:
        report.append(_lock_memory())
    sys.setswitchinterval(1e-4)  # other threads of this process give way sooner
    gc.collect()
    gc.freeze()
    gc.disable()  # the loop makes no cycles; a collection would come at the worst moment
    return report


def leave_terminal() -> None:
    """To be called first by a process that a terminal must not end: neither its keys nor its closing reach it then.

    Ctrl-Z would freeze it at the robot's last speed, Ctrl-\\ or a closed window end it there. Not for a process that
    leads a group.
    """
    os.setsid()
    for number in (signal.SIGINT, signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU):
        signal.signal(number, signal.SIG_IGN)


def _lock_memory() -> str:
    try:
        libc = ctypes.CDLL(None, use_errno=True)
        if libc.mlockall(MCL_CURRENT | MCL_FUTURE) != 0:
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    except (OSError, AttributeError) as error:
        return f"locking memory refused ({error})"
    return "memory locked"
