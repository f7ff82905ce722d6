"""A Modbus TCP server around an emulated axis that takes one connection, as the drives do, and one device id."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import cast

from pymodbus.constants import ExcCodes
from pymodbus.pdu import ModbusPDU
from pymodbus.pdu.device import ModbusDeviceIdentification
from pymodbus.pdu.register_message import ReadWriteMultipleRegistersRequest
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice
from pymodbus.transport import ModbusProtocol

from robot_io.emulator.axes import AxisEmulator

WATCH = 0.02  # [s] between looks at whether the connection is to be dropped
READ, WRITE = (3,), (6, 16)  # function codes; 23 does both
READ_WRITE = 23

IDENTITY = {
    "VendorName": "Emulator",
    "ProductCode": "RIG-AXIS",
    "MajorMinorRevision": "1.0",
    "VendorUrl": "none",
    "ProductName": "Emulated axis",
    "ModelName": "AxisEmulator",
}


class AxisServer:
    """Serves an axis in a thread of its own from construction to ``close``.

    port     the one that was taken; 0 takes a free one
    refused  connections beyond the first

    Raises OSError when it cannot listen.
    """

    def __init__(self, axis: AxisEmulator, host: str = "127.0.0.1", port: int = 0, device_id: int = 1) -> None:
        if not 1 <= device_id <= 255:
            raise ValueError(f"device_id {device_id} must be in 1..255; 0 would answer to every id")
        self.port, self.refused = port, 0
        self._axis, self._host, self._device_id = axis, host, device_id
        self._loop = asyncio.new_event_loop()
        self._started = threading.Event()
        self._error: Exception | None = None
        self._finish = asyncio.Event()
        self._thread = threading.Thread(target=self._run, name="axis-server", daemon=True)
        self._thread.start()
        self._started.wait()
        if self._error is not None:
            self._thread.join()
            raise OSError(f"cannot serve an axis on {host} port {port}: {self._error}") from self._error

    def close(self) -> None:
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._finish.set)
            self._thread.join()

    def __enter__(self) -> AxisServer:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()

    def _run(self) -> None:
        # Damaged requests are this server's daily bread; pymodbus would log each with a traceback.
        logging.getLogger("pymodbus.logging").setLevel(logging.CRITICAL)
        try:
            self._loop.run_until_complete(self._serve())
        except Exception as error:
            self._error = error
        finally:
            self._started.set()
            self._loop.close()

    async def _serve(self) -> None:
        blocks = [
            SimData(low, values=[0] * (high - low), datatype=DataType.REGISTERS) for low, high in self._axis.bank.ranges
        ]
        device = SimDevice(id=self._device_id, simdata=blocks, action=self._action)
        server = _SingleConnectionServer(self._axis, device, (self._host, self.port), self._check)
        await server.serve_forever(background=True)
        # What pymodbus declares as a transport is the server of asyncio while it listens.
        self.port = cast(asyncio.Server, server.transport).sockets[0].getsockname()[1]
        self._started.set()
        try:
            silent = False
            while not self._finish.is_set():
                plugged, silent = silent and not self._axis.disconnected, self._axis.disconnected
                if plugged or (self._axis.guard_tripped and not silent):
                    self._axis.guard_tripped = False
                    server.drop()
                self.refused = server.refused
                with suppress(TimeoutError):
                    await asyncio.wait_for(self._finish.wait(), WATCH)
        finally:
            server.drop()
            await server.shutdown()
            await asyncio.sleep(0)

    def _check(self, sending: bool, pdu: ModbusPDU) -> ModbusPDU:
        """Empties the writing half of a read/write request whose reading half is not possible.

        pymodbus would write first and complain about the address to read afterwards.
        """
        if isinstance(pdu, ReadWriteMultipleRegistersRequest) and not sending:
            if not self._axis.bank.readable(pdu.read_address, pdu.read_count):
                pdu.write_registers = []
        return pdu

    async def _action(
        self,
        function: int,
        start: int,
        address: int,
        count: int,
        registers: list[int],
        values: list[int] | list[bool] | None,
    ) -> ExcCodes | None:
        """Called by pymodbus for every access to the registers; ``values`` is None when reading."""
        try:
            if values is not None and function in (*WRITE, READ_WRITE):
                if values:
                    self._axis.write(address, [int(v) for v in values])
            elif function in (*READ, READ_WRITE):
                registers[address - start : address - start + count] = self._axis.read(address, count)
            else:
                return ExcCodes.ILLEGAL_FUNCTION
        except ConnectionError:
            return ExcCodes.ILLEGAL_ADDRESS
        return None


class _SingleConnectionServer(ModbusTcpServer):
    """While the axis's cable is out nothing is answered, and what arrives does nothing."""

    def __init__(
        self,
        axis: AxisEmulator,
        device: SimDevice,
        address: tuple[str, int],
        trace_pdu: Callable[[bool, ModbusPDU], ModbusPDU],
    ) -> None:
        def wire(sending: bool, data: bytes) -> bytes:
            return b"" if sending and axis.disconnected else data

        identity = ModbusDeviceIdentification(info_name=IDENTITY)
        super().__init__(device, address=address, identity=identity, trace_packet=wire, trace_pdu=trace_pdu)
        self._axis, self.refused = axis, 0
        self._unanswered: list[_Unanswered] = []

    def handle_new_connection(self) -> ModbusProtocol:
        """asyncio, the caller, needs no more than a protocol."""
        if self._axis.disconnected:  # the kernel has accepted it, which no cable does; it hears nothing of that
            self._unanswered.append(_Unanswered())
            return cast(ModbusProtocol, self._unanswered[-1])
        if self.active_connections:
            self.refused += 1
            return cast(ModbusProtocol, _Refusal())
        return super().handle_new_connection()

    def drop(self) -> None:
        for connection in list(self.active_connections.values()):
            connection.close()
        while self._unanswered:
            if transport := self._unanswered.pop().transport:
                transport.abort()


class _Refusal(asyncio.Protocol):
    """A connection that is ended as soon as it is made."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        cast(asyncio.Transport, transport).abort()


class _Unanswered(asyncio.Protocol):
    """A connection to a drive whose cable is out."""

    transport: asyncio.Transport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast(asyncio.Transport, transport)
