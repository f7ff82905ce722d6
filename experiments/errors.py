"""Errors whose message is all that the person at the terminal needs; anything else is a bug and keeps its traceback."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


class ExperimentError(Exception):
    """The message names the file or folder, what is wrong, and what to do."""


class ConfigError(ExperimentError):
    """A request that cannot be met: the message names file, dotted path, what was given and what is allowed."""


class RunError(ExperimentError):
    """A run folder cannot be used as asked."""


class LockedError(RunError):
    """Another process is at work in a run's folder."""


class CheckpointError(ExperimentError):
    """A checkpoint cannot be written or read: the message says which, why, and what is left."""


def explained(error: Exception) -> bool:
    """True where the error's message is enough."""
    # These need NumPy, which --help should not wait for.
    from robot_io.devices.egm.messages import EgmError
    from robot_io.errors import DeviceError, RefusedError
    from robot_io.log.messages import LogError
    from robot_io.policy.artefact import ArtefactError

    return isinstance(error, (ExperimentError, ArtefactError, OSError, RefusedError, DeviceError, EgmError, LogError))


@contextmanager
def error_context(where: str = "") -> Iterator[None]:
    """Turns a complaint about a request into a ConfigError whose lines begin with ``where``, its file or key."""
    try:
        yield
    except (ValueError, OSError, RuntimeError) as error:
        lines = str(error).splitlines() or [""]
        raise ConfigError("\n".join(f"{where}: {line}" for line in lines) if where else str(error)) from None
