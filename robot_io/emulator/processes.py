"""The rig in real time: world, arm's controller, linear axes and tracker as processes of their own on real sockets."""

from __future__ import annotations

import multiprocessing
import random
import signal
import socket
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import replace
from functools import partial
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

import numpy as np

from robot_io.contract import PAPER, Contract
from robot_io.control import realtime
from robot_io.control.config import ArmConfig, AxisConfig, RobotConfig
from robot_io.devices.tracker import TrackerConfig
from robot_io.devices.udp import UdpSocket
from robot_io.emulator.arm import ArmController, ArmStateError
from robot_io.emulator.axis_server import AxisServer
from robot_io.emulator.config import STANDARD_RIG, RigParams, drives_of, for_robot
from robot_io.emulator.network import Network
from robot_io.emulator.opponent import Opponent, Throws, ball_source
from robot_io.emulator.shared_state import ASLEEP, START_TIME, Motion, Shared
from robot_io.emulator.tracker import TrackerEmulator
from robot_io.emulator.world import Vector, World
from robot_io.errors import DeviceError

HOST = "127.0.0.1"
WORLD_STEP, AXIS_CYCLE = 0.002, 0.004  # [s]
PORT_RANGE = 20000, 32000
PRIORITY = 40  # of SCHED_FIFO, where it is allowed


class Ports(NamedTuple):
    """Of the bridge's two sockets and the two drives."""

    arm: int
    tracker: int
    axes: tuple[int, ...]


def free_ports(axes: int = len(PAPER.carrying)) -> Ports:
    """Ports that nobody uses now, below those that the system gives to sockets without one of their own: between this
    look and their use it would give them away. Raises DeviceError when there are too few."""
    found: list[int] = []
    for port in random.SystemRandom().sample(range(*PORT_RANGE), 200):
        kind = socket.SOCK_DGRAM if len(found) < 2 else socket.SOCK_STREAM
        with socket.socket(socket.AF_INET, kind) as probe:
            try:
                probe.bind((HOST, port))
            except OSError:
                continue
        found.append(port)
        if len(found) == 2 + axes:
            return Ports(found[0], found[1], tuple(found[2:]))
    raise DeviceError(f"no free ports for the rig between {PORT_RANGE[0]} and {PORT_RANGE[1]}")


class Rig:
    """The processes; use as a context manager. ``robot`` is what a bridge needs to connect to them.

    contract  of the robot that stands in ``scene``; without carrying axes it has no process for them

    Raises DeviceError when one of them does not start.
    """

    def __init__(
        self,
        scene: str,
        balls: Throws | Opponent,
        params: RigParams = STANDARD_RIG,
        ports: Ports | None = None,
        contract: Contract = PAPER,
    ) -> None:
        params = for_robot(params, contract)
        self.params, self.ports, self._contract = params, ports or free_ports(len(contract.carrying)), contract
        self._shared = Shared(joints=contract.n_joints)
        context = multiprocessing.get_context("spawn")
        jobs: dict[str, Callable[[_Part], None]] = {
            "world": partial(_world, scene=scene, balls=balls),
            "arm": _arm,
            "tracker": _tracker,
        }
        if contract.carrying:
            jobs["axes"] = _axes
        else:
            self._shared["driven"][1] = np.inf  # nobody to wait for
        self._processes, self._pipes = {}, {}
        for name, job in jobs.items():
            self._pipes[name], theirs = context.Pipe()
            given = self._shared.name, params, self.ports, contract, theirs
            process = context.Process(target=_run, args=(job, *given), name=f"rig-{name}")
            process.start()
            theirs.close()
            self._processes[name] = process
        try:
            for name, pipe in self._pipes.items():
                answer = pipe.recv() if pipe.poll(START_TIME) else "does not start"
                if answer != "ready":
                    raise DeviceError(f"rig: {name}: {answer}")
        except (EOFError, DeviceError) as error:
            self.close()
            raise DeviceError(str(error) or "rig: a process ended at once") from None
        self._shared.unlink()

    @property
    def robot(self) -> RobotConfig:
        return replace(
            RobotConfig.of(self._contract),
            name="rig",
            arm=ArmConfig(HOST, self.ports.arm, HOST),
            axis_profile=self.params.axis_profile,
            axes=tuple(AxisConfig(HOST, port) for port in self.ports.axes),
            tracker=TrackerConfig(HOST, self.ports.tracker, HOST),
        )

    def switch_on(self) -> None:
        """Do what a person does at the arm's controller: motors on, RAPID, EGM."""
        self._pipes["arm"].send("switch_on")

    def motors_off(self) -> None:
        """The emergency stop of the arm."""
        self._pipes["arm"].send("motors_off")

    def press_stop(self) -> None:
        """The installation's emergency stop: takes the power from arm and axes, where it is wired to them."""
        if self.params.hidden.stop_wired:
            self.motors_off()
            for axis in range(len(self.ports.axes)):
                self._to_axis("cut_power", axis)

    def hold(self, place: Vector | None) -> None:
        """A hand holds the ball at a place (3,) [m], or nowhere any more."""
        self._shared["held"][:] = 0.0 if place is None else [1.0, *place]

    def clip(self, on: bool) -> None:
        """Clip the ball to the blade, or take it off."""
        self._shared["held"][0] = 2.0 if on else 0.0

    def drive_fault(self, axis: int, code: int) -> None:
        """A fault of one linear axis's drive. Raises DeviceError for a robot without such an axis."""
        self._to_axis("inject_fault", axis, code)

    def connect_arm(self, connected: bool) -> None:
        """Pulls the network cable of the arm's controller or plugs it in again."""
        self._pipes["arm"].send("reconnect" if connected else "disconnect")

    def connect_axis(self, axis: int, connected: bool) -> None:
        """Pulls a linear axis's network cable or plugs it in again. Raises DeviceError as ``drive_fault`` does."""
        self._to_axis("reconnect" if connected else "disconnect", axis)

    def _to_axis(self, request: str, axis: int, *details: int) -> None:
        """Calls a method of an ``AxisEmulator``."""
        if not 0 <= axis < len(self.ports.axes):
            raise DeviceError(f"rig: {self._contract.robot} has {len(self.ports.axes)} linear axes, no number {axis}")
        self._pipes["axes"].send((request, axis, *details))

    def drop_out(self, seconds: float) -> None:
        """The tracker sends nothing for a while."""
        self._pipes["tracker"].send(seconds)

    def jog(self) -> None:
        """Put the arm to its home pose, as somebody does with the controller's own pendant."""
        self._shared["jog"][0] = 1.0

    def throw(self, on: bool) -> None:
        """Starts or ends the throwing of balls."""
        self._shared["throwing"][0] = on

    @property
    def throwing(self) -> bool:
        """True while balls are thrown."""
        return bool(self._shared.value("throwing"))

    @property
    def thrown(self) -> int:
        return int(self._shared.value("thrown"))

    def state(self) -> tuple[np.ndarray, np.ndarray]:
        """True joint positions and velocities (n,)."""
        qpos, qvel = self._shared.read("qpos", "qvel")
        return qpos, qvel

    def check(self) -> None:
        """Raises DeviceError when a process has ended."""
        for name, process in self._processes.items():
            if not process.is_alive():
                raise DeviceError(f"rig: the process of the {name} has ended with status {process.exitcode}")

    def close(self) -> None:
        self._shared["finish"][0] = 1.0
        for process in self._processes.values():
            process.join(2.0)
            if process.is_alive():
                process.kill()
                process.join()
        for pipe in self._pipes.values():
            pipe.close()
        self._shared.close()

    def __enter__(self) -> Rig:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()


class _Part(NamedTuple):
    """What a process of the rig works with."""

    shared: Shared
    params: RigParams
    ports: Ports
    contract: Contract
    pipe: Connection


def _run(
    job: Callable[[_Part], None], name: str, params: RigParams, ports: Ports, contract: Contract, pipe: Connection
) -> None:
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGQUIT):  # no terminal ends hardware; the owner's death does
        signal.signal(number, signal.SIG_IGN)
    shared = Shared(name, contract.n_joints)
    # These stand for hardware, which nothing else on this machine can delay; below the bridge's priority.
    realtime.prepare(PRIORITY)
    try:
        job(_Part(shared, params, ports, contract, pipe))
    except (KeyboardInterrupt, BrokenPipeError, EOFError):
        pass
    except OSError as error:
        pipe.send(str(error))
    except Exception:
        pipe.send(traceback.format_exc())
        raise
    finally:
        shared.close()


def _paced(shared: Shared, period: float) -> Iterator[float]:
    """Absolute deadlines [s] until the rig ends; missed ones are made up for one by one, as a real clock would."""
    parent = multiprocessing.parent_process()
    deadline, count = time.monotonic(), 0
    while not shared.value("finish"):
        deadline += period
        count += 1
        wait = deadline - time.monotonic()
        if wait > 0:
            time.sleep(wait)
        elif wait < -ASLEEP:
            deadline = time.monotonic()  # the machine was asleep
        if count % 256 == 0 and parent is not None and not parent.is_alive():
            return
        yield deadline


def _requests(pipe: Connection) -> Iterator[Any]:
    while pipe.poll():
        yield pipe.recv()


def _world(part: _Part, scene: str, balls: Throws | Opponent) -> None:
    shared, params = part.shared, part.params
    world = World(scene, params.world, part.contract)
    source = ball_source(balls, params)

    def publish(now: float) -> None:
        number, seen = params.tracker.sees(world)
        shared.publish(
            time=now,
            qpos=world.qpos,
            qvel=world.qvel,
            ball=world.ball,
            ball_number=number,
            ball_in_play=seen,
            collisions=world.collisions,
            thrown=source.thrown,
        )

    publish(time.monotonic())
    part.pipe.send("ready")
    for now in _paced(shared, WORLD_STEP):
        shared.await_drives(now)
        world.advance(shared["setpoint"].copy(), WORLD_STEP)
        if shared.value("jog"):
            world.jog()
            shared["jog"][0] = 0.0
        mode, *place = shared["held"].tolist()
        world.held, world.on_blade = np.array(place) if mode == 1.0 else None, mode == 2.0
        if shared.value("throwing"):
            source.update(world, now)
        publish(now)


def _arm(part: _Part) -> None:
    shared, params, client = part.shared, part.params, (HOST, part.ports.arm)
    controller = ArmController(client, replace(params.arm, dead_time=params.arm.dead_time + params.action_delay))
    out, back = Network(params.arm_network, params.seed), Network(params.arm_network, params.seed + 1)
    rows, connected, motion = list(part.contract.arm), True, Motion(shared)
    with UdpSocket(HOST, 0, "rig") as wire:
        part.pipe.send("ready")
        for now in _paced(shared, params.arm.cycle):
            for request in _requests(part.pipe):
                if request == "motors_off":
                    controller.motors_off()
                elif request == "switch_on":
                    with suppress(ArmStateError):  # it still brakes
                        controller.switch_on()
                else:
                    connected = request == "reconnect"
            shared["driven"][0] = now - params.arm.cycle  # the last set-point's time, also if this process was asleep
            qpos, qvel = motion.at(now)
            shared["setpoint"][rows], datagram = params.hidden.drive_arm(controller, now, qpos[rows], qvel[rows])
            shared["driven"][0] = now
            if datagram is not None and connected:
                out.send(datagram, now)
            for ready in out.due(now):
                wire.send(ready, client)
            for reply, source in wire.drain():
                if connected:
                    back.send(reply, now)
                if source != client:
                    controller.receive(reply, source, now)  # counted as a stranger's
            for reply in back.due(now):
                controller.receive(reply, client, now)


def _axes(part: _Part) -> None:
    shared, carrying = part.shared, part.contract.carrying
    emulators = drives_of(part.params, part.contract)
    with ExitStack() as servers:
        for emulator, port in zip(emulators, part.ports.axes, strict=True):
            servers.enter_context(AxisServer(emulator, HOST, port))
        motion = Motion(shared)
        part.pipe.send("ready")
        for now in _paced(shared, AXIS_CYCLE):
            for request, axis, *details in _requests(part.pipe):
                getattr(emulators[axis], request)(*details)
            shared["driven"][1] = now - AXIS_CYCLE
            qpos, qvel = motion.at(now)
            for k, (i, emulator) in enumerate(zip(carrying, emulators, strict=True)):
                place, speed = float(qpos[i]), float(qvel[i])
                shared["setpoint"][i] = part.params.hidden.drive_axis(k, emulator, now, place, speed)
            shared["driven"][1] = now


def _tracker(part: _Part) -> None:
    shared, params = part.shared, part.params
    cameras = TrackerEmulator(params.tracker, params.seed + 2, params.hidden)
    network = Network(params.tracker_network, params.seed + 3)
    with UdpSocket(HOST, 0, "rig") as wire:
        part.pipe.send("ready")
        # Several times a frame, so that frames leave close to the end of their latency.
        for count, _ in enumerate(_paced(shared, 1.0 / params.tracker.rate / 4)):
            now = time.monotonic()
            for seconds in _requests(part.pipe):
                cameras.drop_out(now + seconds)
            if count % 4 == 0:
                ball, in_play, number, taken = shared.read("ball", "ball_in_play", "ball_number", "time")
                cameras.step(float(taken[0]), int(number[0]), ball if in_play[0] else None)
            for datagram in cameras.due(now):
                network.send(datagram, now)
            for datagram in network.due(now):
                wire.send(datagram, (HOST, part.ports.tracker))
