"""Errors at the robot before anything moves."""

from __future__ import annotations


class DeviceError(RuntimeError):
    """A device cannot be reached or opened; the message says what to do."""


class RefusedError(RuntimeError):
    """The robot was asked for something that is not safe now; the message names the reason."""


class JogFirstError(RefusedError):
    """It is not safe where the robot is: somebody has to jog it elsewhere first."""


class ContractError(ValueError):
    """Data that cannot be the contract of a robot."""


def format_error(error: BaseException) -> str:
    """An error's type and words; the type alone where its words cannot be had."""
    try:
        return f"{type(error).__name__}: {error}"
    except Exception:  # __str__ is the error's own code: it must not raise where a robot is being braked
        return type(error).__name__
