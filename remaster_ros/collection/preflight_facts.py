"""Gather from the states of the nodes the facts of the preflight; times are arguments."""

from __future__ import annotations

from collections.abc import Iterable

from remaster_ros.collection.events import (
    BridgeState,
    Event,
    RecorderState,
    SensorReport,
    State,
)
from remaster_ros.collection.required_sensors import RequiredSensors
from remaster_ros.motion.preflight import Facts, SensorFacts

NEVER_S = float('inf')


class PreflightFacts:
    """The last state of bridge, recorder and sensors, and when each came.

    Parameters
    ----------
    sensors
        All sensors of the cell.
    """

    def __init__(self, sensors: Iterable[str]) -> None:
        self._names = tuple(sensors)
        self._bridge, self._recorder = BridgeState(halted=''), RecorderState(waiting_for='')
        self._sensors: dict[str, SensorReport] = {}
        self._came_wall: dict[str, float] = {}

    def take(self, body: State | Event, now: float) -> None:
        """Take what a node published; wall time, s."""
        match body:
            case BridgeState():
                self._bridge, source = body, body.sender
            case RecorderState():
                self._recorder, source = body, body.sender
            case SensorReport(sensor=name):
                self._sensors[name], source = body, f'sensor {name}'
            case _:
                return
        self._came_wall[source] = now

    def required(self) -> RequiredSensors:
        """Return the sensors that the arm waits for, as the recorder is set.

        Raises
        ------
        InputError
            The recorder waits for a sensor that this cell does not have.
        """
        return RequiredSensors(self._names, self._recorder.require)

    def facts(self, now: float, *, seen_before: bool) -> Facts:
        """Return what is known now; `InputError` as `required`.

        Parameters
        ----------
        seen_before
            The sensors have seen their markers in this session, and the arm may stand where
            they do not: a collection that is resumed.
        """
        required = self.required()
        return Facts(
            joints_age_s=_age_s(self._bridge.joints_age_s),
            joints_message=self._bridge.joints_trouble,
            bridge_age_s=self._since_s('robot_bridge', now),
            recorder_age_s=self._since_s('recorder', now),
            sensors=[self._sensor(name, now, seen_before) for name in required.names],
            any_sensor=required.any_of_them,
        )

    def _sensor(self, name: str, now: float, seen_before: bool) -> SensorFacts:
        report = self._sensors.get(name, SensorReport(sensor=name, ready=False))
        read_s = _age_s(self._recorder.read_age_s.get(name)) + self._since_s('recorder', now)
        return SensorFacts(
            name=name,
            node_age_s=self._since_s(f'sensor {name}', now),
            ready=report.ready,
            message=report.trouble,
            read_age_s=0.0 if seen_before else read_s,
        )

    def _since_s(self, source: str, now: float) -> float:
        return now - self._came_wall.get(source, -NEVER_S)


def _age_s(age_s: float | None) -> float:
    return NEVER_S if age_s is None else age_s
