# SPDX-License-Identifier: Apache-2.0
"""What the nodes act on: one record, typed and versioned, as JSON on ``remaster/events``.

A record carries either the *state* of a node (twice a second and at each change, so that a node
which starts late has it at once) or an *event* of a configuration. An event names the pose by the
stamp of its announcement and the solution by its index there.

A field without which an arm could move wrongly has no default: a record that lacks it is refused.
Unknown fields are ignored, so that fields can be added. A change of what
a field means, or a field that is taken away, needs another `VERSION`.
"""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, get_args

import msgspec
import numpy as np

from remaster_ros.errors import InputError


class Body(msgspec.Struct, frozen=True, tag_field='kind'):
    """What a record carries; ``kind`` names its type."""

    sender: ClassVar[str] = ''  # The name of the only node that may publish it; '' for any


class OptimizerState(Body, frozen=True, kw_only=True, tag='optimizer'):
    """State of the optimizer."""

    sender: ClassVar[str] = 'optimizer'
    plan: str  # The plan whose session it has looked at, '' for none
    # Whether the precision that the cell file states is reached: no more poses to fit are visited
    # then
    enough: bool
    precision: str = ''  # What is known, and what more would cost, as text


VERSION = 1

SHORT = 8
"""So many digits of a checksum are shown to people."""

Index = Annotated[int, msgspec.Meta(ge=0)]
Outcome = Literal['recorded', 'partial', 'rejected']


class Alive(Body, frozen=True, tag='alive'):
    """State of a node of which the others need nothing else."""


class PlannerState(Body, frozen=True, kw_only=True, tag='planner'):
    """State of the planner."""

    sender: ClassVar[str] = 'pose_planner'
    # ``running`` while the arm may move; ``held`` (by a full disk), ``idle``, ``paused``,
    # ``stopped``, ``complete`` or ``failed``
    state: str
    run: str  # Token of the run under way, '' for none. Each /remaster/collect begins another one.
    planned: int = 0  # Configurations to fit that were planned; 0 before
    # The plan whose complete collection is gone on with, which its recorder's session is opened
    # again for; ''
    further: str = ''

    def goes_further(self, plan: str) -> bool:
        """Whether a run is under way behind the complete collection of a plan."""
        return self.state == 'running' and self.further == plan != ''

    def run_held(self, before: str) -> str:
        """Return the token that recorder and bridge hold after this state.

        They keep it in memory and publish it: by that a planner which is started again finds
        whether its run still lives. A pause or a stop ends the run; a planner that was just
        started and has not decided yet (``idle``) does not.

        Parameters
        ----------
        before
            The token held so far, '' for none.
        """
        if self.state in ('running', 'held'):
            return self.run or before
        return before if self.state == 'idle' else ''


class BridgeState(Body, frozen=True, kw_only=True, tag='bridge'):
    """State of the bridge."""

    sender: ClassVar[str] = 'robot_bridge'
    halted: str  # Why the arm is halted until a person clears it; ''
    pose: str = ''  # Stamp of the pose whose solutions the bridge has, '' for none
    run: str = ''  # Token of the last run that the bridge has seen running
    # Why nothing moves in this run before a person calls /remaster/collect, and that; ''
    asks_for_collect: str = ''
    # Time since the last usable joint_states, None for never, s; what is wrong with them
    joints_age_s: float | None = None
    joints_trouble: str = ''
    # SHA-256 of the compensation.json by which it corrects what it commands; '' for none
    correction: str = ''


NO_FREE_PATH = 'no_free_path'
"""Outcome of a configuration that the arm cannot get to without hitting something."""


class Decided(msgspec.Struct, frozen=True):
    """What became of the configurations of a plan, as the session's journal has it."""

    pose: int | None = None  # The last one of which any has an outcome; None before the first
    solutions: tuple[int, ...] = ()  # Those of it that have one, by the planner's own numbers
    # How many configurations came to which end: an `Outcome`, ``failed`` or ``no_free_path``.
    # Those for a registration are not among them, and visits to references are counted apart.
    outcomes: dict[str, int] = msgspec.field(default_factory=dict)
    references: int = 0


class RecorderState(Body, frozen=True, kw_only=True, tag='recorder'):
    """State of the recorder."""

    sender: ClassVar[str] = 'recorder'
    # What the arm has to wait for (room on the disk, a required sensor), and why; ''
    waiting_for: str
    state: str = 'waiting'  # ``waiting``, ``measuring`` or ``closed``
    exit_status: str = ''  # Of a session that is closed; ''
    # The folder, how many rows it has, and the plan that they belong to
    session: str = ''
    observations: int = 0
    plan: str = ''
    # Stamp of the announced pose and token of the run, as the recorder has them
    pose: str = ''
    run: str = ''
    decided: Decided = Decided()
    registration: str = ''  # How far the first registration of the sensors is, as text
    registered: bool = False  # Whether every sensor that the arm waits for is registered
    require: str = 'all'  # Which sensors the arm waits for: ``all``, ``any`` or the name of one
    # Time since the last reading of each sensor, s; None for never
    read_age_s: dict[str, float | None] = msgspec.field(default_factory=dict)
    changed: str = ''  # What has changed at the reference configurations; ''
    # Token of the run that this change has paused; None for none, '' for one that a recorder which
    # was started again has not learned yet
    changed_run: str | None = None


class SensorReport(Body, frozen=True, kw_only=True, tag='sensor'):
    """State of a sensor's node."""

    sensor: str  # The sensor's name in the cell
    ready: bool  # Whether it can measure a marker that it sees
    trouble: str = ''  # What is wrong, with the remedy; ''
    message: str = ''  # What the node shows to people
    # The sensor does not see its marker: no reading comes before the arm has moved on
    hidden: bool = False


class TourPlanned(Body, frozen=True, tag='planned'):
    """The planner has planned the collection; described as text."""

    sender: ClassVar[str] = 'pose_planner'
    description: str


class PoseAnnounced(Body, frozen=True, kw_only=True, tag='pose'):
    """The planner announces a pose, whose solutions follow on ``remaster/joint_solutions``."""

    sender: ClassVar[str] = 'pose_planner'
    # Of the messages that belong to this announcement; the same pose announced again has another
    # one
    stamp: str
    # As in the session
    pose: int
    split: str
    # The planner's own numbers of the joint solutions, in the order published
    ids: tuple[Index, ...]
    # Those that no free path leads to; where there are no others, no solutions follow
    unreached: tuple[Index, ...] = ()
    plan: str = ''  # The plan that all are numbered by
    last: bool = False  # Whether it is the last reference of a round


class SolutionCommanded(Body, frozen=True, kw_only=True, tag='commanded'):
    """The bridge sends the arm to a solution, this long after it last settled, wall time."""

    sender: ClassVar[str] = 'robot_bridge'
    stamp: str
    solution: Index
    since_settled_wall_s: float


class SolutionSettled(Body, frozen=True, kw_only=True, tag='settled'):
    """The arm stands at a solution, after so much time of motion and of settling."""

    sender: ClassVar[str] = 'robot_bridge'
    stamp: str
    solution: Index
    motion_s: float = 0.0
    settle_s: float = 0.0


class SolutionFailed(Body, frozen=True, kw_only=True, tag='failed'):
    """The bridge does not get the arm to a solution."""

    sender: ClassVar[str] = 'robot_bridge'
    stamp: str
    solution: Index
    reason: str


class ArmStopped(Body, frozen=True, kw_only=True, tag='stopped'):
    """The bridge has stopped the arm on its way."""

    sender: ClassVar[str] = 'robot_bridge'
    stamp: str
    reason: str


class ArmHalted(Body, frozen=True, kw_only=True, tag='halted'):
    """The bridge has halted the arm until a person clears the halt."""

    sender: ClassVar[str] = 'robot_bridge'
    stamp: str
    reason: str


class HaltCleared(Body, frozen=True, kw_only=True, tag='halt_cleared'):
    """A person has cleared the halt."""

    sender: ClassVar[str] = 'robot_bridge'
    stamp: str


class ConfigurationEnded(Body, frozen=True, kw_only=True, tag='configuration'):
    """The recorder has written down what became of a configuration; the arm may go on."""

    sender: ClassVar[str] = 'recorder'
    stamp: str
    solution: Index
    # What became of it, and why where it is not ``recorded``
    result: Outcome
    reason: str = ''
    registered: bool = False  # Whether every sensor that the arm waits for is registered
    # From settling to the last reading; None where nothing was read, s
    measuring_s: float | None = None


class SetupChanged(Body, frozen=True, kw_only=True, tag='changed'):
    """The references show that something has moved."""

    sender: ClassVar[str] = 'recorder'
    stops: bool  # Whether the collection pauses until a person has looked
    text: str = ''  # What has moved, and by how much


class ReadByHand(Body, frozen=True, kw_only=True, tag='by_hand'):
    """The recorder reads where a person has driven the arm: joints, rad, and since when, s."""

    sender: ClassVar[str] = 'recorder'
    stamp_s: float
    q: tuple[float, ...]


class RecorderBegan(Body, frozen=True, kw_only=True, tag='began'):
    """In a bag: its recorder was started (again) here, with no reading under way."""

    sender: ClassVar[str] = 'recorder'
    # Its parameters, and its cell as JSON: with them the bag gives the same rows again
    parameters: dict[str, bool | int | float | str] = msgspec.field(default_factory=dict)
    cell: str = ''
    # It is the same process as before, which has opened a closed session again
    continued: bool = False


class ShotMeasured(Body, frozen=True, tag='measured'):
    """A single-shot sensor has measured; search and integration took so much wall time."""

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
    """Which arm and surroundings a node computes with."""

    # Checksums of the URDF's content, and of what motions depend on in the cell file
    urdf: str
    cell: str
    # Where the node has read them
    urdf_file: str = ''
    cell_file: str = ''

    def difference(self, own: str, other: ArmModel, name: str) -> str:
        """Return how the model of another node differs, '' where it does not.

        Parameters
        ----------
        own, name
            This node's name, and the other's.
        other
            The other's model.
        """
        found = [
            f'{own} has the {what} {file} (checksum {mine[:SHORT]}) and {name} has '
            f'{other_file} ({its[:SHORT]})'
            for what, mine, its, file, other_file in (
                ('URDF', self.urdf, other.urdf, self.urdf_file, other.urdf_file),
                ('cell file', self.cell, other.cell, self.cell_file, other.cell_file),
            )
            if mine != its
        ]
        if not found:
            return ''
        return f'{"; ".join(found)}: start both with the same cell file'


class EventRecord(msgspec.Struct, frozen=True, kw_only=True):
    """A state or an event, and which node published it when."""

    node: str  # The node with its namespace, such as ``/left/recorder``
    body: State | Event
    # Identifies this start of the node; how long it has been running, s
    started: str = ''
    uptime_s: float = 0.0
    stamp_ns: int = 0  # Time of the node's clock, ns
    # Which arm the node computes with; None where it computes with none
    model: ArmModel | None = None
    version: int = VERSION


class _Version(msgspec.Struct):
    version: int


def encode(record: EventRecord) -> str:
    """Return a record as JSON."""
    return _ENCODER.encode(record).decode()


def decode(text: str) -> EventRecord:
    """Return the record in a message.

    Raises
    ------
    InputError
        It is no JSON, of another version, not complete, or from a node that cannot have sent it.
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
    return value.item()


_ENCODER = msgspec.json.Encoder(enc_hook=_plain)
_VERSION = msgspec.json.Decoder(_Version)
_RECORD = msgspec.json.Decoder(EventRecord)
