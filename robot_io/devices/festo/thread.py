"""The thread that exchanges with the axes in real time."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence

from robot_io.devices.festo.axes import DEFAULTS, FestoAxes
from robot_io.devices.festo.axis import AxesConfig, Axis

STOPPING = 1.0  # [s] for coming to rest at the end


class AxesThread(FestoAxes):
    """Calls ``cycle`` at ``rate`` [Hz] by absolute deadlines, from ``start`` (entering) to ``close`` (leaving).

    Commands, requests and state are handed over as single immutable objects, so no lock is held across an exchange and
    nobody waits for one. Times are those of ``time.monotonic``.

    cycles    done
    late      deadlines that had passed by a whole period when their cycle would have begun; those are left out
    """

    def __init__(self, axes: Sequence[Axis], config: AxesConfig = DEFAULTS, rate: float = 125.0):
        if not 10.0 <= rate <= 1000.0:
            raise ValueError(f"rate {rate} Hz must be in 10..1000")
        super().__init__(axes, config)
        self.cycles = 0
        self.late = 0
        self._period = 1.0 / rate
        self._finish = threading.Event()
        self._failure: str | None = None
        self._thread = threading.Thread(target=self._run, name="festo-axes", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        """Brakes, switches off, ends the thread and closes the links."""
        self._finish.set()
        if self._thread.is_alive():
            self._thread.join()

    def __enter__(self) -> AxesThread:
        self.start()
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()

    def preparable(self, now: float) -> bool:
        """As ``FestoAxes.preparable``, while the thread runs."""
        return self._failure is None and self._thread.is_alive() and super().preparable(now)

    def problem(self, now: float) -> str | None:
        """As ``FestoAxes.problem``; also that the thread has ended, which lasts."""
        if self._failure is not None:
            return self._failure
        if not self._thread.is_alive():
            return "The exchange with the linear axes is not running: start it."
        return super().problem(now)

    def _run(self) -> None:
        try:
            self._loop(self._finish.is_set)
        except Exception as error:  # a mistake of ours must stop the axes and be told, not vanish with the thread
            self._failure = (
                f"The exchange with the linear axes broke off ({type(error).__name__}: {error}): restart the program."
            )
        finally:
            self._end()

    def _loop(self, finished: Callable[[], bool]) -> None:
        deadline = time.monotonic()
        while not finished():
            self.cycle(time.monotonic())
            self.cycles += 1
            after = time.monotonic()
            deadline += self._period
            missed = int((after - deadline) / self._period)
            if missed > 0:
                self.late += missed
                deadline += missed * self._period
            if deadline > after:
                time.sleep(deadline - after)

    def _end(self) -> None:
        """Stops, waits until the axes stand, switches them off. What fails here is left to the drives' node guards."""
        try:
            limit = time.monotonic() + STOPPING
            self.stop()
            self.cycle(time.monotonic())  # at least this one stop command
            self._loop(lambda: self.standing or time.monotonic() > limit)
        except Exception as error:
            self._failure = (
                self._failure or f"The linear axes could not be stopped in order ({type(error).__name__}: {error})."
            )
        finally:
            self.switch_off()
            super().close()
