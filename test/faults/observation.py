# SPDX-License-Identifier: Apache-2.0
"""What becomes of a fault that is injected into a running collection of real nodes.

`observe` injects a row's fault, ends it, lets an operator do what is needed, and returns the row
of the page. What must hold whatever happens is asserted on the way: nothing commanded outside the
limits or too fast, nothing at all from a halt until a person has cleared it, and a collection that
goes on once the fault is over.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from faults.bench import Bench
from faults.observer import plain
from rigs.ros_rig import PATIENCE

from remaster_ros.collection.events import (
    ArmHalted,
    ArmStopped,
    ConfigurationEnded,
    HaltCleared,
)

HALT_S = 0.3
"""A command may be on its way when a halt is published, s."""
TRIES = 4
"""So often at most a row is tried."""
GOES_ON_S = 30.0
"""Once a fault is over the next configuration is recorded within so much wall time."""
BENCHES = {
    'real time': {'rate': 1.0},
    'plain': {},
    'relays': {'relays': True},
    'emergency': {'emergency': True, 'rate': 1.0},
    'bar alone': {'require': 'mocap'},
    'any sensor': {'require': 'any'},
    'several markers': {'several_markers': True},
}
"""Set of nodes -> what the bench is given for it."""
REFUSED = {
    'outside_limits': 'outside the limits',
    'too_fast': 'faster than the arm can be',
    'stamp': 'its stamp does not advance',
    'not_finite': 'not finite',
}
"""What a busy machine alone never does to a report."""
COLUMNS = 'who', 'fault', 'what is said', 'what is commanded', 'how it goes on'


class TooBusyError(Exception):
    """The machine was too busy to see what became of a fault."""


@dataclass(frozen=True)
class Row:
    """A fault.

    Attributes
    ----------
    who, fault
        Columns of the page.
    inject, end
        Begin and end it; by default it ends with the faults of the fakes.
    lasts_s
        Wall time between the two.
    during
        ``move`` or ``reading``: what is under way when it begins.
    bench
        Which set of nodes it is tried in, see `BENCHES`; '' for that of `kind`.
    times
        Whether it makes joint_states late or early; only a busy machine does else.
    """

    who: str
    fault: str
    inject: Callable[[Bench], object]
    end: Callable[[Bench], object] = lambda bench: bench.inject()
    lasts_s: float = 4.0
    during: str = 'move'
    bench: str = ''
    times: bool = False

    @property
    def kind(self) -> str:
        """The set of nodes: of what becomes of the motion, in a world that waits for nobody."""
        moves = self.who in ('robot', 'robot_bridge')
        return self.bench or ('real time' if moves else 'plain')


@dataclass(frozen=True)
class Seen:
    """What became of a fault: columns of the page, and what was commanded in numbers.

    Attributes
    ----------
    travel_deg, share
        Of the stop that followed the fault, or 0: how far it led on, and its highest speed as a
        share of the arm's limits.
    """

    said: str
    commanded: str
    goes_on: str
    travel_deg: float = 0.0
    share: float = 0.0


def observe(bench: Bench, row: Row) -> Seen:
    """Try a row; return what was seen. On a machine that was too busy for it, try again.

    Raises
    ------
    TooBusyError
        It was too busy every time.
    """
    for _ in range(TRIES):
        began = time.monotonic()
        seen = _observe(bench, row)
        if row.times or not any(_refused(bench, kind, began) for kind in ('late', 'early')):
            return seen
        print(f'{row.fault}: once more, joint_states came late without a fault: {seen.said}')
    raise TooBusyError(f'{TRIES} times joint_states came late without a fault: {seen.said}')


def _observe(bench: Bench, row: Row) -> Seen:
    observer = bench.observer
    (bench.under_way if row.during == 'move' else bench.settled)()
    began = time.monotonic()
    row.inject(bench)
    wait_until(bench, began + row.lasts_s)
    row.end(bench)
    ended = time.monotonic()
    wait_until(bench, ended + 1.2)
    halted = bench.halted
    if halted:
        # What is over does not let the arm go.
        wait_until(bench, time.monotonic() + 1.0)
    goes_on = _go_on(bench)
    halts = observer.find(ArmHalted, since_s=began)
    stops = observer.find(ArmStopped, since_s=began)
    cleared = [at for at, _ in observer.find(HaltCleared, since_s=began)]
    commands = observer.since(began)
    observer.judge(commands)
    stop = next((c for c in commands if c.points == 1 and c.wall_s < ended + 1.0), None)
    if halts:
        (halt_s, _), until = halts[0], [at for at in cleared if at > halts[0][0]]
        after = observer.since(halt_s + HALT_S, until[0] if until else np.inf)
        assert not after, f'{len(after)} commands after a halt: {halts}'
        stop = stop if stop is not None and stop.wall_s < halt_s + HALT_S else None
        commanded = 'a stop along its path, then nothing' if stop else 'nothing'
    elif stops or _blocked(bench, began, ended):
        commanded = 'nothing new: it stops, or stands, as long as it lasts'
    else:
        commanded = 'the planned moves'
    refused = [kind for kind in REFUSED if _refused(bench, kind, began) > 0]
    unseen = [
        message
        for at, node, message, _ in list(observer.summaries)
        if node == 'recorder' and at > began and 'was not seen' in message
    ]
    said = [
        *observer.reasons(began),
        *map(plain, unseen[:1]),
        *(f'a report of the joints is refused ({REFUSED[kind]})' for kind in refused),
    ]
    numbers = (0.0, 0.0)
    if stop is not None:
        numbers = float(np.rad2deg(stop.travel_rad)), observer.share(stop)
    return Seen('; '.join(said) or 'nothing', commanded, goes_on, *numbers)


def _refused(bench: Bench, kind: str, began: float) -> int:
    """Return how many reports of the joints were refused for a reason since then."""
    counts = [
        (at, int(values.get(f'joints_refused_{kind}', 0)))
        for at, node, _, values in list(bench.observer.summaries)
        if node == 'robot_bridge'
    ]
    before = [0, *(count for at, count in counts if at <= began)][-1]
    since = [before, *(count for at, count in counts if at > began)]
    # A bridge that was started again counts from zero.
    return sum(max(later - earlier, 0) for earlier, later in pairwise(since))


def wait_until(bench: Bench, until_s: float) -> None:
    bench.until(lambda: time.monotonic() > until_s, 60, 'time')


def _blocked(bench: Bench, began: float, ended: float) -> bool:
    """Whether the bridge reported for most of a second that it must not move the arm."""
    words = [
        message
        for at, node, message, _ in list(bench.observer.summaries)
        if node == 'robot_bridge' and began < at < ended + 1.0
    ]
    idle = ('moving or measuring', 'waiting for a pose')
    return sum(word not in idle for word in words) >= 2


def _go_on(bench: Bench) -> str:
    """Let the collection go on until another configuration is recorded; say who had to do what."""
    took: list[str] = []
    deadline = time.monotonic() + PATIENCE * GOES_ON_S
    since = time.monotonic()
    while True:
        said = {name: latest[1:] for name, latest in bench.observer.latest.items()}
        assert time.monotonic() < deadline, f'it does not go on: {bench.halted}, {said}'
        if bench.halted or bench.planner in ('paused', 'idle', 'stopped'):
            # As a person does: look, and only then.
            wait_until(bench, time.monotonic() + 0.7)
            steps = bench.operate()
            took += [step for step in steps if step not in took]
            since = time.monotonic()
        done = bench.observer.find(ConfigurationEnded, since_s=since)
        if any(event.result == 'recorded' for _, event in done):
            break
        wait_until(bench, time.monotonic() + 0.1)
    return f'after {" and ".join(took)}' if took else 'by itself'
