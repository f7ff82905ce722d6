"""A Modbus TCP server around an emulated axis that takes one connection, as the drives do, and one device id."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable
from typing import Protocol, cast

from pymodbus.constants import ExcCodes
from pymodbus.pdu import ModbusPDU
from pymodbus.pdu.device import ModbusDeviceIdentification
from pymodbus.pdu.register_message import ReadWriteMultipleRegistersRequest
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice
from pymodbus.transport import ModbusProtocol

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


class RegisterBank(Protocol):
    """Part of ``robot_io.emulator.axes.AxisEmulator`` that a server needs."""

    disconnected: bool
    guard_tripped: bool

    @property
    def ranges(self) -> tuple[tuple[int, int], ...]: ...
    def read(self, address: int, count: int) -> list[int]: ...
    def write(self, address: int, values: list[int]) -> None: ...
    def readable(self, address: int, count: int) -> bool: ...


class AxisServer:
    """Serves in a thread of its own from construction to ``close``. ``port`` is the one that was taken."""

    def __init__(self, bank: RegisterBank, host: str, port: int, device_id: int) -> None:
        if not 1 <= device_id <= 255:
            raise ValueError(f"device_id {device_id} must be in 1..255; 0 would answer to every id")
        self.port = port
        self.refused = 0  # connections beyond the first
        self._bank, self._host, self._device_id = bank, host, device_id
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
        device = SimDevice(
            id=self._device_id,
            simdata=[
                SimData(low, values=[0] * (high - low), datatype=DataType.REGISTERS) for low, high in self._bank.ranges
            ],
            action=self._action,
        )
        server = _SingleConnectionServer(
            device,
            (self._host, self.port),
            self._check,
            lambda: self._bank.disconnected,
        )
        await server.serve_forever(background=True)
        # What pymodbus declares as a transport is the server of asyncio while it listens.
        self.port = cast(asyncio.Server, server.transport).sockets[0].getsockname()[1]
        self._started.set()
        try:
            silent = False
            while not self._finish.is_set():
                plugged, silent = silent and not self._bank.disconnected, self._bank.disconnected
                if plugged or (self._bank.guard_tripped and not silent):
                    self._bank.guard_tripped = False
                    server.drop()
                self.refused = server.refused
                await _wait(self._finish, WATCH)
        finally:
            server.drop()
            await server.shutdown()
            await asyncio.sleep(0)

    def _check(self, sending: bool, pdu: ModbusPDU) -> ModbusPDU:
        """Empties the writing half of a read/write request whose reading half is not possible.

        pymodbus would write first and complain about the address to read afterwards.
        """
        if (
            not sending
            and isinstance(pdu, ReadWriteMultipleRegistersRequest)
            and not self._bank.readable(pdu.read_address, pdu.read_count)
        ):
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
                    self._bank.write(address, [int(v) for v in values])
            elif function in (*READ, READ_WRITE):
                registers[address - start : address - start + count] = self._bank.read(address, count)
            else:
                return ExcCodes.ILLEGAL_FUNCTION
        except ConnectionError:
            return ExcCodes.ILLEGAL_ADDRESS
        return None


class _SingleConnectionServer(ModbusTcpServer):
    """disconnected: tells whether the cable is out. Then nothing is answered, and what arrives does nothing."""

    def __init__(
        self,
        device: SimDevice,
        address: tuple[str, int],
        trace_pdu: Callable[[bool, ModbusPDU], ModbusPDU],
        disconnected: Callable[[], bool],
    ) -> None:
        def wire(sending: bool, data: bytes) -> bytes:
            return b"" if sending and disconnected() else data

        identity = ModbusDeviceIdentification(info_name=IDENTITY)
        super().__init__(device, address=address, identity=identity, trace_packet=wire, trace_pdu=trace_pdu)
        self._disconnected, self._unanswered = disconnected, set[_Unanswered]()
        self.refused = 0

    def handle_new_connection(self) -> ModbusProtocol:
        """asyncio, the caller, needs no more than a protocol."""
        if self._disconnected():  # the kernel has accepted it, which no cable does; it hears nothing of that
            return cast(ModbusProtocol, _Unanswered(self._unanswered))
        if self.active_connections:
            self.refused += 1
            return cast(ModbusProtocol, _Refusal())
        return super().handle_new_connection()

    def drop(self) -> None:
        for connection in list(self.active_connections.values()):
            connection.close()
        for unanswered in list(self._unanswered):
            unanswered.close()


class _Refusal(asyncio.Protocol):
    """A connection that is ended as soon as it is made."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        cast(asyncio.Transport, transport).abort()


class _Unanswered(asyncio.Protocol):
    """A connection to a drive whose cable is out; one of ``all_of_them`` until it ends."""

    def __init__(self, all_of_them: set[_Unanswered]) -> None:
        self._all = all_of_them

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)
        self._all.add(self)

    def connection_lost(self, error: Exception | None) -> None:
        self._all.discard(self)

    def close(self) -> None:
        self._transport.abort()


async def _wait(event: asyncio.Event, seconds: float) -> None:
    try:
        await asyncio.wait_for(event.wait(), seconds)
    except TimeoutError:
        pass


def serve(bank: RegisterBank, host: str = "127.0.0.1", port: int = 0, device_id: int = 1) -> AxisServer:
    """Starts a server; port 0 takes a free one. Raises OSError when it cannot listen."""
    return AxisServer(bank, host, port, device_id)
