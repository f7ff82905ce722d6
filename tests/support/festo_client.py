"""Festo's own client against our emulated axis: run by the Python that has festo-edcon, with the port to talk to.

    python interop_festo.py 127.0.0.1 PORT

Prints one line of JSON with what the drive said after each step.
"""

from __future__ import annotations

import functools
import json
import sys
import time

from edcon.edrive import com_modbus
from edcon.edrive.motion_handler import MotionHandler

TARGET, SPEED = 150_000, 500  # [um], [mm/s]


def main(address: str, port: int) -> None:
    com_modbus.ModbusClient = functools.partial(com_modbus.ModbusClient, port=port)  # festo-edcon only knows port 502
    com = com_modbus.ComModbus(address, cycle_time=5, timeout_ms=500)
    told = {"device": com.device_info["product_code"]}
    told["units"] = [com.read_pnu(number) for number in (11724, 11725, 12345, 12346, 12347)]
    with MotionHandler(com, config_mode="write") as motion:
        motion.base_velocity = 2.0
        told["acknowledged"] = motion.acknowledge_faults()
        told["enabled"] = motion.enable_powerstage()
        told["homed"] = motion.referencing_task() and motion.referenced()
        told["start"] = motion.current_position()
        told["moved"] = motion.position_task(TARGET, SPEED, absolute=True)
        time.sleep(0.2)
        told["position"] = motion.current_position()
        told["back"] = motion.position_task(-250_000, 2 * SPEED, absolute=True, nonblocking=True)
        time.sleep(0.15)
        told["velocity"] = motion.current_velocity()
        motion.stop_motion_task()
        time.sleep(0.4)
        told["stopped"] = motion.stopped()
        told["between"] = motion.current_position()
        motion.configure_continuous_update(True)
        motion.position_task(-400_000, SPEED, absolute=True, nonblocking=True)
        time.sleep(0.1)
        told["updated"] = motion.position_task(TARGET, SPEED, absolute=True)
        time.sleep(0.2)
        told["final"] = motion.current_position()
        told["fault"] = _after_a_fault(motion)
        told["disabled"] = motion.disable_powerstage()
    print(json.dumps(told))


def _after_a_fault(motion: MotionHandler) -> dict[str, object]:
    """What the client sees of a fault, made once the word is read, and of its acknowledgement."""
    print("fault", flush=True)
    end = time.monotonic() + 5.0
    while not motion.fault_present() and time.monotonic() < end:
        time.sleep(0.02)
        motion.update_inputs()
    told: dict[str, object] = {"present": motion.fault_present(), "code": int(motion.current_fault_code())}
    told["refused"] = not motion.position_task(0, SPEED, absolute=True)
    told["acknowledged"] = motion.acknowledge_faults() and not motion.fault_present()
    told["enabled"] = motion.enable_powerstage()
    told["moved"] = motion.position_task(0, SPEED, absolute=True)
    return told


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
