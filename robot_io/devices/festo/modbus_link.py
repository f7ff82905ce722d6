"""The link that carries registers to an axis over Modbus TCP."""

from __future__ import annotations

import logging
import time
from typing import Protocol

from pymodbus.client import ModbusTcpClient
from pymodbus.exceptions import ModbusIOException

DEFAULT_PORT = 502
RETRY = 0.5  # [s] between attempts to connect: a dead axis must not slow down the exchange with the living one
EXCEPTIONS = {
    1: "illegal function: the drive does not know function code 0x17; set combined: false of this axis",
    2: "illegal data address: is this the right profile for the drive?",
    3: "illegal data value",
    4: "device failure",
    6: "device busy",
    10: "no path behind the gateway",
    11: "no answer behind the gateway: is the device id right?",
}


class AxisLost(ConnectionError):
    """An exchange with an axis failed; the message says how."""


class RegisterLink(Protocol):
    """One axis's register bank behind a connection, or an emulator's in the same process."""

    def exchange(self, write_address: int, values: list[int], read_address: int, count: int) -> list[int]:
        """Writes ``values`` from ``write_address`` on, then reads ``count`` registers. Raises AxisLost."""

    def close(self) -> None: ...


class ModbusLink:
    """A Modbus TCP connection, opened by the first exchange and closed by any failure: no late answer is mixed up.

    address    of the drive
    timeout    longest wait for an answer, and for a connection [s]
    device_id  Modbus unit identifier
    combined   one request of function code 0x17 (read/write multiple registers); else 0x10 and then 0x03
    """

    def __init__(
        self, address: str, port: int = DEFAULT_PORT, timeout: float = 0.02, device_id: int = 1, combined: bool = True
    ):
        if not 0 < timeout <= 1:
            raise ValueError(f"timeout {timeout} s must be in (0, 1]: an axis that stays silent for longer is lost")
        if not 0 <= device_id <= 255:
            raise ValueError(f"device_id {device_id} must be in 0..255; Modbus TCP drives mostly have 1 or 255")
        self._where = f"axis at {address} port {port}, device id {device_id}"
        logging.getLogger("pymodbus.logging").setLevel(logging.CRITICAL)  # AxisLost tells the same, once
        self._client = ModbusTcpClient(address, port=port, timeout=timeout, retries=0)
        self._device_id, self._timeout = device_id, timeout
        self._combined = combined
        self._next_attempt = 0.0

    def exchange(self, write_address: int, values: list[int], read_address: int, count: int) -> list[int]:
        if not self._client.connected:
            self._connect()
        try:
            if self._combined:
                answer = self._client.readwrite_registers(
                    write_address=write_address,
                    values=values,
                    read_address=read_address,
                    read_count=count,
                    device_id=self._device_id,
                )
            else:
                answer = self._client.write_registers(write_address, values, device_id=self._device_id)
                if not answer.isError():
                    answer = self._client.read_holding_registers(read_address, count=count, device_id=self._device_id)
        except ModbusIOException as error:
            reason = f"no sound answer within {self._timeout:g} s: is it powered, is the cable in?"
            raise self._lost(reason) from error
        except Exception as error:  # whatever a damaged answer or a dying socket raises inside pymodbus
            raise self._lost(str(error) or type(error).__name__) from error
        if answer.isError():
            code = getattr(answer, "exception_code", 0)
            raise self._lost(
                f"it refused registers {write_address} and {read_address}: {EXCEPTIONS.get(code, f'exception {code}')}"
            )
        registers = getattr(answer, "registers", None) or []
        if len(registers) != count:
            raise self._lost(f"it sent {len(registers)} registers, wanted were {count}")
        return list(registers)

    def close(self) -> None:
        self._client.close()

    def _connect(self) -> None:
        now = time.monotonic()
        if now < self._next_attempt:
            raise AxisLost(f"{self._where}: not connected")
        self._next_attempt = now + RETRY
        if not self._client.connect():
            raise self._lost(
                "no connection: is it powered, is the cable in, does another program hold its only connection?"
            )

    def _lost(self, reason: str) -> AxisLost:
        self._client.close()
        return AxisLost(f"{self._where}: {reason}")
