"""Log of a session at the robot: records, recorders, reader, tables. Format: docs/reference/log-format.md."""

from robot_io.log.messages import Action as Action
from robot_io.log.messages import Ball as Ball
from robot_io.log.messages import Command as Command
from robot_io.log.messages import Event as Event
from robot_io.log.messages import Joints as Joints
from robot_io.log.messages import Level as Level
from robot_io.log.messages import LogError as LogError
from robot_io.log.messages import Metadata as Metadata
from robot_io.log.messages import Observation as Observation
from robot_io.log.messages import Tick as Tick
from robot_io.log.messages import episode_end as episode_end
from robot_io.log.messages import episode_start as episode_start
from robot_io.log.reader import Episode as Episode
from robot_io.log.reader import SessionLog as SessionLog
from robot_io.log.reader import read as read
from robot_io.log.reader import stream as stream
from robot_io.log.recorder import FileRecorder as FileRecorder
from robot_io.log.recorder import NullRecorder as NullRecorder
from robot_io.log.recorder import Recorder as Recorder
from robot_io.log.recorder import SessionRecorder as SessionRecorder
from robot_io.log.scan import Overview as Overview
from robot_io.log.scan import check as check
from robot_io.log.scan import salvage as salvage
from robot_io.log.tables import export as export
from robot_io.log.tables import trajectories as trajectories
