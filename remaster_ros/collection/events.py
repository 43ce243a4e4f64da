# SPDX-License-Identifier: Apache-2.0
"""Messages between the nodes: one record, typed and versioned, as JSON on ``remaster/events``.

A record carries either the *state* of a node (twice a second and at each change, so that a node
that starts late has it at once) or an *event* of a configuration. An event names the pose by the
stamp of its announcement and the solution by its index there.

A field without which an arm could move wrongly has no default: a record without it is refused.
Unknown fields are ignored, so that fields can be added. A change of a field's meaning, or the
removal of a field, needs another `VERSION`.
"""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, get_args

import msgspec
import numpy as np

from remaster_ros.errors import InputError


class Body(msgspec.Struct, frozen=True, tag_field='kind'):
    """Content of a record; ``kind`` names its type."""

    sender: ClassVar[str] = ''  # Name of the only node that may publish the record; '' for any


class OptimizerState(Body, frozen=True, kw_only=True, tag='optimizer'):
    """State of the optimizer."""

    sender: ClassVar[str] = 'optimizer'
    plan: str  # Plan of the session that the optimizer has fitted, '' for none
    # Whether the precision stated in the cell file is reached: no more poses to fit are then
    # visited
    enough: bool
    precision: str = ''  # Precision so far, and cost of the wanted precision, as text


VERSION = 1

SHORT = 8
"""Number of digits of a checksum in messages for people."""

Index = Annotated[int, msgspec.Meta(ge=0)]
Outcome = Literal['recorded', 'partial', 'rejected']


class Alive(Body, frozen=True, tag='alive'):
    """State of a node of which other nodes need to know only that it runs."""


class PlannerState(Body, frozen=True, kw_only=True, tag='planner'):
    """State of the planner."""

    sender: ClassVar[str] = 'pose_planner'
    # ``running`` while the arm may move; ``held`` (by a full disk), ``idle``, ``paused``,
    # ``stopped``, ``complete`` or ``failed``
    state: str
    run: str  # Token of the present run, '' for none. Each /remaster/collect begins another run.
    planned: int = 0  # Number of planned configurations to fit; 0 before
    # Plan whose complete collection is continued, so that its recorder's session is opened again;
    # ''
    further: str = ''

    def goes_further(self, plan: str) -> bool:
        """Whether the present run adds measurements to the complete collection of a plan.

        ``plan``: id of the plan; False for ''.
        """
        return self.state == 'running' and self.further == plan != ''

    def run_held(self, before: str) -> str:
        """Token that recorder and bridge hold after this state, '' for none.

        Both nodes keep the token in memory and publish it: a restarted planner finds by the token
        whether its run still lives. A pause or a stop ends the run; a planner that was just
        started and has not decided yet (``idle``) does not. ``before``: token held so far, '' for
        none.
        """
        if self.state in ('running', 'held'):
            return self.run or before
        return before if self.state == 'idle' else ''


class BridgeState(Body, frozen=True, kw_only=True, tag='bridge'):
    """State of the bridge."""

    sender: ClassVar[str] = 'robot_bridge'
    halted: str  # Reason of a halt until a person clears it; '' without a halt
    pose: str = ''  # Stamp of the pose whose solutions the bridge has, '' for none
    run: str = ''  # Token of the last run that the bridge has seen running
    # Reason why the arm waits for /remaster/collect in this run, with that remedy; ''
    asks_for_collect: str = ''
    # Time since the last usable joint_states, None for never, s; their fault
    joints_age_s: float | None = None
    joints_trouble: str = ''
    # SHA-256 of the compensation.json that corrects the commands; '' for none
    correction: str = ''


NO_FREE_PATH = 'no_free_path'
"""Outcome of a configuration that the arm cannot reach without a collision."""


class Decided(msgspec.Struct, frozen=True):
    """Outcomes of the configurations of a plan, as in the session's journal."""

    pose: int | None = None  # Last pose with an outcome; None before the first
    solutions: tuple[int, ...] = ()  # Solutions of the pose with an outcome, by planner's number
    # Number of configurations by outcome: an `Outcome`, ``failed`` or ``no_free_path``, without
    # those of a registration; visits to references are counted separately.
    outcomes: dict[str, int] = msgspec.field(default_factory=dict)
    references: int = 0


class RecorderState(Body, frozen=True, kw_only=True, tag='recorder'):
    """State of the recorder."""

    sender: ClassVar[str] = 'recorder'
    # Condition that the arm has to wait for (room on the disk, a required sensor) and reason; ''
    waiting_for: str
    state: str = 'waiting'  # ``waiting``, ``measuring`` or ``closed``
    exit_status: str = ''  # Exit status of a closed session; ''
    # Folder of the session, number of its rows, and their plan
    session: str = ''
    observations: int = 0
    plan: str = ''
    # Stamp of the announced pose and token of the run, as the recorder has them
    pose: str = ''
    run: str = ''
    decided: Decided = Decided()
    registration: str = ''  # Progress of the first registration of the sensors, as text
    registered: bool = False  # Whether every sensor that the arm waits for is registered
    require: str = 'all'  # Sensors that the arm waits for: ``all``, ``any`` or the name of one
    # Time since the last reading of each sensor, s; None for never
    read_age_s: dict[str, float | None] = msgspec.field(default_factory=dict)
    changed: str = ''  # Change at the reference configurations, as text; ''
    # Token of the run that this change has paused; None for none, '' for one that a restarted
    # recorder does not know yet
    changed_run: str | None = None


class SensorReport(Body, frozen=True, kw_only=True, tag='sensor'):
    """State of a sensor's node."""

    sensor: str  # The sensor's name in the cell
    ready: bool  # Whether the sensor can measure a visible marker
    trouble: str = ''  # Fault with its remedy; ''
    message: str = ''  # Message of the node for people
    # Whether the marker is hidden from the sensor: no reading comes before the arm has moved on
    hidden: bool = False


class TourPlanned(Body, frozen=True, tag='planned'):
    """Event: the planner has planned the collection; described as text."""

    sender: ClassVar[str] = 'pose_planner'
    description: str


class PoseAnnounced(Body, frozen=True, kw_only=True, tag='pose'):
    """Event: the planner announces a pose.

    Its solutions follow on ``remaster/joint_solutions``.
    """

    sender: ClassVar[str] = 'pose_planner'
    # Stamp of the messages of this announcement; a repeated pose has another stamp
    stamp: str
    # Pose and split as in the session
    pose: int
    split: str
    # The planner's own numbers of the joint solutions, in the order published
    ids: tuple[Index, ...]
    # Solutions without a free path; if there are no others, no solutions follow
    unreached: tuple[Index, ...] = ()
    plan: str = ''  # Plan of these numbers
    last: bool = False  # Whether the pose is the last reference of a round


class SolutionCommanded(Body, frozen=True, kw_only=True, tag='commanded'):
    """Event: the bridge sends the arm to a solution.

    ``since_settled_wall_s``: wall time since the arm last settled, s.
    """

    sender: ClassVar[str] = 'robot_bridge'
    stamp: str
    solution: Index
    since_settled_wall_s: float


class SolutionSettled(Body, frozen=True, kw_only=True, tag='settled'):
    """Event: the arm stands at a solution, after this time of motion and of settling."""

    sender: ClassVar[str] = 'robot_bridge'
    stamp: str
    solution: Index
    motion_s: float = 0.0
    settle_s: float = 0.0


class SolutionFailed(Body, frozen=True, kw_only=True, tag='failed'):
    """Event: the bridge cannot move the arm to a solution."""

    sender: ClassVar[str] = 'robot_bridge'
    stamp: str
    solution: Index
    reason: str


class ArmStopped(Body, frozen=True, kw_only=True, tag='stopped'):
    """Event: the bridge has stopped the arm during a motion."""

    sender: ClassVar[str] = 'robot_bridge'
    stamp: str
    reason: str


class ArmHalted(Body, frozen=True, kw_only=True, tag='halted'):
    """Event: the bridge has halted the arm until a person clears the halt."""

    sender: ClassVar[str] = 'robot_bridge'
    stamp: str
    reason: str


class HaltCleared(Body, frozen=True, kw_only=True, tag='halt_cleared'):
    """Event: a person has cleared the halt."""

    sender: ClassVar[str] = 'robot_bridge'
    stamp: str


class ConfigurationEnded(Body, frozen=True, kw_only=True, tag='configuration'):
    """Event: the recorder has recorded the outcome of a configuration; the arm may go on."""

    sender: ClassVar[str] = 'recorder'
    stamp: str
    solution: Index
    # Outcome, with the reason if it is not ``recorded``
    result: Outcome
    reason: str = ''
    registered: bool = False  # Whether every sensor that the arm waits for is registered
    # Time from settling to the last reading, s; None if nothing was read
    measuring_s: float | None = None


class SetupChanged(Body, frozen=True, kw_only=True, tag='changed'):
    """Event: the references show that something has moved."""

    sender: ClassVar[str] = 'recorder'
    stops: bool  # Whether the collection pauses until a person has checked the change
    text: str = ''  # The change and its size


class ReadByHand(Body, frozen=True, kw_only=True, tag='by_hand'):
    """Event: the recorder reads at a configuration to which a person has driven the arm.

    ``q``: joints, rad; ``stamp_s``: time since which the arm stands there, s.
    """

    sender: ClassVar[str] = 'recorder'
    stamp_s: float
    q: tuple[float, ...]


class RecorderBegan(Body, frozen=True, kw_only=True, tag='began'):
    """Event in a bag: its recorder was started (again) here, with no reading in progress."""

    sender: ClassVar[str] = 'recorder'
    # Parameters of the recorder, and its cell as JSON: with both the bag gives the same rows again
    parameters: dict[str, bool | int | float | str] = msgspec.field(default_factory=dict)
    cell: str = ''
    # Whether the same process as before has opened a closed session again
    continued: bool = False


class ShotMeasured(Body, frozen=True, tag='measured'):
    """Event: a single-shot sensor has measured.

    ``instrument_wall_s``: wall time of search and integration, s.
    """

    instrument_wall_s: float


State = Alive | PlannerState | BridgeState | RecorderState | SensorReport | OptimizerState
Event = (
    TourPlanned
    | PoseAnnounced
    | SolutionCommanded
    | SolutionSettled
    | SolutionFailed
    | ArmStopped
    | ArmHalted
    | HaltCleared
    | ConfigurationEnded
    | SetupChanged
    | ReadByHand
    | RecorderBegan
    | ShotMeasured
)
STATES = get_args(State)


class ArmModel(msgspec.Struct, frozen=True, kw_only=True):
    """Arm and surroundings that a node computes with."""

    # Checksums of the URDF's content, and of the part of the cell file that motions depend on
    urdf: str
    cell: str
    # Paths of both files
    urdf_file: str = ''
    cell_file: str = ''

    def difference(self, own_name: str, other: ArmModel, name: str) -> str:
        """Difference to the model of another node, a sentence; '' if there is none.

        ``own_name, name``: names of this node and of the other node; ``other``: model of the other
        node.
        """
        found = [
            f'{own_name} has the {what} {file} (checksum {checksum[:SHORT]}) and {name} has '
            f'{other_file} ({other_checksum[:SHORT]})'
            for what, checksum, other_checksum, file, other_file in (
                ('URDF', self.urdf, other.urdf, self.urdf_file, other.urdf_file),
                ('cell file', self.cell, other.cell, self.cell_file, other.cell_file),
            )
            if checksum != other_checksum
        ]
        if not found:
            return ''
        return f'{"; ".join(found)}: start both with the same cell file'


class EventRecord(msgspec.Struct, frozen=True, kw_only=True):
    """State or event, with its node and time."""

    node: str  # Name of the node with its namespace, such as ``/left/recorder``
    body: State | Event
    # Identifier of this start of the node; running time, s
    started: str = ''
    uptime_s: float = 0.0
    stamp_ns: int = 0  # Time of the node's clock, ns
    # Arm that the node computes with; None if it needs none
    model: ArmModel | None = None
    version: int = VERSION


class _Version(msgspec.Struct):
    """Version of a record, which is read before the rest of it."""

    version: int


def encode(record: EventRecord) -> str:
    """Record as JSON text, for std_msgs/String; NumPy scalars are converted."""
    return _ENCODER.encode(record).decode()


def decode(text: str) -> EventRecord:
    """Record in a message.

    Raises InputError if the text is no JSON, has another version, is not complete, or is from a
    node that may not publish the record.
    """
    try:
        version = _VERSION.decode(text).version
        if version != VERSION:
            raise InputError(
                f'a record of version {version}, and this program reads version {VERSION}: run '
                'all nodes with the same version of remaster_ros'
            )
        record = _RECORD.decode(text)
    except (msgspec.MsgspecError, UnicodeError, RecursionError) as error:
        raise InputError(f'a damaged record ({error}): {text[:80]!r}') from None
    sender, name = record.body.sender, record.node.rpartition('/')[2]
    if sender not in ('', name):
        kind = type(record.body).__name__
        raise InputError(f'{kind} is not for {record.node} to publish, but for {sender}')
    return record


def _plain(value: np.generic) -> object:
    """NumPy scalar as a Python number, for the JSON encoder."""
    return value.item()


_ENCODER = msgspec.json.Encoder(enc_hook=_plain)
_VERSION = msgspec.json.Decoder(_Version)
_RECORD = msgspec.json.Decoder(EventRecord)
