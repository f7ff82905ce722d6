"""Rig and bridge in one process on a clock of its own: the same code as in real time, as fast as the machine allows.

Bytes on the wire are those of the sockets; only UDP and TCP themselves are omitted. Deterministic: equal parameters
give equal episodes, bit for bit.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from robot_io.calibrated import UNCALIBRATED, Calibration
from robot_io.control.bridge import Bridge, BridgeConfig, BridgeState, Policy
from robot_io.control.config import PROFILES, axis_range
from robot_io.control.episode import EpisodeSummary
from robot_io.control.interfaces import STANDARD_PLAY
from robot_io.control.rally import RallySummary
from robot_io.devices.egm.session import EgmConfig, EgmSession
from robot_io.devices.festo import Axis, FestoAxes
from robot_io.devices.fixed_base import FixedBase
from robot_io.devices.tracker import Tracker, TrackerConfig
from robot_io.emulator.arm import ArmController
from robot_io.emulator.config import STANDARD_RIG, RigParams, drives_of, for_robot
from robot_io.emulator.network import Network
from robot_io.emulator.opponent import Opponent, Throws, ball_source
from robot_io.emulator.tracker import EmulatedTracker, TrackerEmulator, TrackerParams
from robot_io.emulator.world import World
from robot_io.errors import JogFirstError, RefusedError
from robot_io.log.recorder import SessionRecorder
from robot_io.safety.clearance import RobotGeometry
from robot_io.safety.gate import SafetyConfig, SafetyGate

GRID = 3000  # ticks a second of the clock, so that 75, 125 and 250 Hz are whole numbers of them
ARM, AXES, TRACK, CONTROL = GRID // 250, GRID // 125, GRID // 125, GRID // 75
SAME_CLOCK = TrackerConfig()
BRIDGE, CONTROLLER = ("127.0.0.1", 6510), ("127.0.0.1", 6511)


class LockStep:
    """A robot with its bridge, from power-on.

    scene   the MJCF
    balls   what is thrown, from ball number ``first`` on, or who plays rallies
    world   one to use again, which is reset: making it takes a while
    tracker, calibration  what the bridge knows of the installation
    config  of the bridge; its contract says which joints arm and axes have
    balls_needed  as of BridgeConfig; with the default the tracker, which nobody can move, counts as shown, and only
            balls that contradict it are heeded
    rendered  makes the tracker where ``tracker.cameras`` is "rendered"; the number is a seed
    """

    def __init__(
        self,
        scene: str | Path,
        balls: Throws | Opponent,
        policy: Policy,
        params: RigParams = STANDARD_RIG,
        config: BridgeConfig = STANDARD_PLAY,
        safety: SafetyConfig | None = None,
        recorder: SessionRecorder | None = None,
        first: int = 0,
        world: World | None = None,
        tracker: TrackerConfig = SAME_CLOCK,
        calibration: Calibration = UNCALIBRATED,
        balls_needed: int = 0,
        rendered: Callable[[TrackerParams, World, int], EmulatedTracker] | None = None,
    ) -> None:
        contract = config.contract
        self.params = params = for_robot(params, contract)
        self._contract = contract
        safety = safety or SafetyConfig.of(contract)
        self.world = world or World(scene, params.world, contract)
        self.world.reset()
        arm_params = replace(params.arm, dead_time=params.arm.dead_time + params.action_delay)
        self.arm = ArmController(BRIDGE, arm_params)
        self.emulators = drives_of(params, contract)
        axes = [
            Axis(contract.joints[i], emulator, PROFILES[params.axis_profile](), *axis_range(i, safety, contract.limits))
            for i, emulator in zip(contract.carrying, self.emulators, strict=True)
        ]
        self.axes: FestoAxes | FixedBase = FestoAxes(axes) if axes else FixedBase()
        seed = np.random.SeedSequence([params.seed, first]).generate_state(4)
        self.cameras: EmulatedTracker
        if rendered is not None and params.tracker.cameras == "rendered":
            self.cameras = rendered(params.tracker, self.world, int(seed[0]))
        else:
            self.cameras = TrackerEmulator(params.tracker, int(seed[0]), params.hidden)
        self._to_bridge = Network(params.arm_network, int(seed[1]))
        self._to_arm = Network(params.arm_network, int(seed[2]))
        self._frames = Network(params.tracker_network, int(seed[3]))
        self.thrower = ball_source(balls, params, first)
        self.summaries: deque[EpisodeSummary] = deque()
        self.rallies: list[RallySummary] = []
        self.track = np.zeros((0, 4))  # t [s], x, y, z [m] of the newest ball with an outcome, on its way to the robot
        found = calibration.robot
        session = EgmSession(EgmConfig(controller_address=CONTROLLER[0], zeros=found.zeros(len(contract.arm))))
        self.bridge = Bridge(
            session,
            self.axes,
            Tracker(tracker, calibration),
            SafetyGate(contract.limits, geometry=RobotGeometry.of(contract).moved(found.base), config=safety),
            policy,
            replace(config, base=found.base, balls_needed=balls_needed),
            recorder,
            self._played,
            self.rallies.append,
        )
        self._clock = 0
        self._setpoint = np.zeros(contract.n_joints)
        self.throwing = False
        self.bridge_alive = self.arm_connected = True

    @property
    def now(self) -> float:
        return self._clock / GRID

    def _played(self, summary: EpisodeSummary) -> None:
        self.summaries.append(summary)
        self.track = self.bridge.play.track(summary.number)

    def step(self) -> None:
        """To the next moment at which anything happens."""
        following = min(n - self._clock % n for n in (ARM, CONTROL))
        self.world.advance(self._setpoint, following / GRID)
        self._clock += following
        now, clock = self.now, self._clock
        if clock % ARM == 0:
            self._devices(now)
        if clock % TRACK == 0:
            world = self.world
            number, seen = self.params.tracker.sees(world)
            self.cameras.step(now, number, world.ball if seen else None)
        for datagram in self.cameras.due(now):
            self._frames.send(datagram, now)
        if self.bridge_alive:
            self._bridge(now, clock)
        for reply in self._to_arm.due(now):
            if self.arm_connected:
                self.arm.receive(reply, BRIDGE, now)
        if self.throwing:
            self.thrower.update(self.world, now)

    def _devices(self, now: float) -> None:
        qpos, qvel = self.world.qpos, self.world.qvel
        abb = list(self._contract.arm)
        hidden = self.params.hidden
        self._setpoint[abb], datagram = hidden.drive_arm(self.arm, now, qpos[abb], qvel[abb])
        for k, (i, emulator) in enumerate(zip(self._contract.carrying, self.emulators, strict=True)):
            self._setpoint[i] = hidden.drive_axis(k, emulator, now, float(qpos[i]), float(qvel[i]))
        if datagram is not None and self.arm_connected:
            self._to_bridge.send(datagram, now)

    def _bridge(self, now: float, clock: int) -> None:
        bridge, fresh = self.bridge, False
        for datagram in self._to_bridge.due(now):
            fresh |= bridge.arm_session.receive(datagram, CONTROLLER, now)
        if fresh:
            reply = bridge.arm_received(now)
            if reply is not None:
                self._to_arm.send(reply, now)
        for datagram in self._frames.due(now):
            bridge.tracker_received(datagram, "127.0.0.1", now)
        if clock % AXES == 0:
            self.axes.cycle(now)
            state = self.axes.state
            if state is not None:
                bridge.axes_received(state.position, state.received)
        if clock % CONTROL == 0:
            bridge.tick(now, now)

    def run(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Runs for at most ``seconds`` or until the condition holds; whether it did."""
        end = self._clock + round(seconds * GRID)
        while self._clock < end:
            if until():
                return True
            self.step()
        return until()

    def start(self) -> None:
        """Switch everything on, home the axes, arm the bridge. Raises RefusedError when it does not get ready."""
        self.arm.switch_on()
        self.run(0.1)
        self.axes.enable()
        self.run(1.0, lambda: self.axes.state is not None and self.axes.state.enabled)
        self.axes.home()
        self.run(5.0, lambda: self.axes.problem(self.now) is None)
        self._ramp_in()
        if self.bridge.frame_check.needed:
            self.throwing = True
            bridge = self.bridge
            self.run(12.0, lambda: not bridge.unproven or bool(bridge.frame_check.problem or bridge.tracker.refused))
            self.throwing = False
        self.bridge.arm(self.now)
        if not self.run(5.0, lambda: self.bridge.at_home):
            raise RefusedError(f"the rig does not reach its home pose: {self.bridge.gate.faults}")

    def _ramp_in(self) -> None:
        """Until the arm follows commands fully."""
        self.run(0.1)
        self.run(2.0, lambda: self.bridge.arm_session.ramping(self.now) is None)

    def recover(self) -> None:
        """Reset a fault and arm again, as an operator does, who jogs the robot where needed; home is reached later.

        Raises RefusedError.
        """
        self.arm.motors_on()
        self.arm.start_rapid()
        self.run(0.2)  # an arm that still brakes cannot start EGM
        if not self.arm.egm_is_running:
            self.arm.start_egm()
        self.run(2.5, lambda: self.bridge.gate.settled)
        self.run(1.0)
        if self.axes.fault:
            self.axes.acknowledge()
            self.run(0.3)
        self.axes.enable()
        self.run(0.3)
        if not self.run(3.0, lambda: not self.bridge.gate.present):  # outside its range, or in contact
            self._push_by_hand()
        if self.bridge.state is BridgeState.FAULT:
            self.bridge.reset(self.now)
        if not self.axes.homed:
            self.axes.home()
        self.run(3.0, lambda: self.axes.problem(self.now) is None)
        self._ramp_in()
        try:
            self.bridge.arm(self.now)
        except JogFirstError:
            self._push_by_hand()
            self.bridge.arm(self.now)

    def _push_by_hand(self) -> None:
        self.axes.disable()
        self.run(0.5)
        self.world.jog(whole=True)
        self.axes.enable()
        self.run(1.0)

    def play(self, balls: int, longest: float = 20.0) -> list[EpisodeSummary]:
        """Plays until the outcomes of ``balls`` more balls are known; fewer when the bridge stops or time runs out."""
        found: list[EpisodeSummary] = []
        self.throwing = True
        for _ in range(balls):
            self.run(
                longest, lambda: bool(self.summaries) or self.bridge.state in (BridgeState.FAULT, BridgeState.DISARMED)
            )
            if not self.summaries:
                break
            found.append(self.summaries.popleft())
        self.throwing = False
        return found
