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
