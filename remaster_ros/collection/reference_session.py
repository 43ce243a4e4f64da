"""What has changed by the references of a recorded session."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from remaster_ros.collection.reference_readings import ReferenceReading, SetupChange
from remaster_ros.collection.reference_watch import ReferenceWatch
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.types import FloatArray, Session


def changes(
    session: Session, chain: SerialChain, T_R_N: Mapping[str, FloatArray]
) -> tuple[int, list[SetupChange]]:
    """Return how many rounds of the references there are, and what has changed by them.

    Each change is returned once, as the last round that shows it has it.
    """
    m = session.references
    if m is None:
        return 0, []
    readings = [
        ReferenceReading(
            session.sensor_names[m.sensor[i]],
            session.marker_names[m.marker[i]],
            float(m.stamp_s[i]),
            m.q[i],
            m.position[i],
            m.std[i] if np.all(np.isfinite(m.std[i])) else None,
            max(int(m.samples[i]), 1),
            configuration=int(m.configuration[i]),
        )
        for i in range(len(m))
    ]
    watch = ReferenceWatch(chain, session.markers)
    found = replay(watch, readings, session.measurements.configuration.tolist(), T_R_N)
    last = {(change.subject, change.after): change for change in found}
    return watch.rounds, list(last.values())


def replay(
    watch: ReferenceWatch,
    readings: Sequence[ReferenceReading],
    others: Sequence[int],
    T_R_N: Mapping[str, FloatArray],
) -> list[SetupChange]:
    """Judge the references of a recorded session; return what was found, round by round.

    Parameters
    ----------
    readings
        In the order measured.
    others
        Numbers of the configurations that are no references, in any order.
    """
    other = np.sort(np.asarray(others, dtype=int))
    found: list[SetupChange] = []
    for i, reading in enumerate(readings):
        if i:
            between = (readings[i - 1].configuration, reading.configuration)
            if np.ptp(np.searchsorted(other, between)) > 0:
                watch.end_round()
        if watch.rounds and watch.begins_round(reading):
            change = watch.judge(T_R_N)
            found += [change] if change is not None else []
        watch.add(reading)
    change = watch.judge(T_R_N)
    return found + ([change] if change is not None else [])
