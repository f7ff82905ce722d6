"""A Ctrl-C while a library computes and Python's own handlers wait."""

from __future__ import annotations

import io
import signal
import subprocess
import sys
import time

import pytest
from rich.console import Console

from experiments import interrupts
from tests.support.paths import ROOT

DEAF = """
import hashlib, sys
from experiments.interrupts import interruptible
with interruptible():
    print("ready", flush=True)
    hashlib.pbkdf2_hmac("sha256", b"", b"", 60_000_000)  # C code that never looks for signals
"""


@pytest.mark.realtime
def test_ctrl_c_is_answered_where_python_does_not_run_and_the_second_one_ends():
    process = subprocess.Popen(
        [sys.executable, "-c", DEAF], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout.readline() == "ready\n"
        time.sleep(0.5)  # until the C code has begun
        process.send_signal(signal.SIGINT)
        assert process.stderr.readline() == "\n"
        assert "Ctrl-C again ends at once" in process.stderr.readline()
        assert process.poll() is None
        process.send_signal(signal.SIGINT)
        began = time.monotonic()
        assert process.wait(10) == 130 and time.monotonic() - began < 5.0
        assert "the same command continues" in process.stderr.read()
    finally:
        process.kill()
        process.wait()


def test_an_orderly_end_is_asked_for_by_the_first_ctrl_c_and_forced_by_the_second():
    """Signals come while Rich prints, where an exception could leave a console that is silent from then on."""
    outside = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        text = io.StringIO()

        class Interrupting(io.StringIO):
            def write(self, words):
                if not asked.is_set():
                    signal.raise_signal(signal.SIGINT)
                return text.write(words)

        with interrupts.stop_requested() as asked:
            assert not asked.is_set()
            console = Console(file=Interrupting())
            console.print("played")
            assert asked.is_set()
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
        console.print("summary")
        assert text.getvalue() == "played\nsummary\n"
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, outside)
