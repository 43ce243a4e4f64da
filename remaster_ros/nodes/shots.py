"""Ask single-shot sensors for their measurement, again where the answer was lost."""

from __future__ import annotations

import time
from collections.abc import Mapping

from rclpy.client import Client
from rclpy.task import Future
from std_srvs.srv import Trigger

from remaster_ros.core.pairing import Pairing

GRACE_WALL_S = 1.0
"""A refusal counts after so long: meanwhile its node may say that the instrument is gone."""


class Shots:
    """The measurements that one configuration after the other needs.

    Parameters
    ----------
    clients
        Client of the measure service (std_srvs/Trigger), per sensor.
    """

    def __init__(self, clients: Mapping[str, Client]) -> None:
        self._clients = clients
        self._pairing: Pairing | None = None
        self._asked: dict[str, Future] = {}
        self._refused: dict[str, tuple[float, str]] = {}

    def look(self, pairing: Pairing, absent: Mapping[str, str]) -> None:
        """Ask whoever has not been asked for this pairing, and note who refused.

        A sensor that goes absent while it is asked is asked again when it is back.
        """
        if pairing is not self._pairing:
            self._pairing, self._asked, self._refused = pairing, {}, {}
        now = time.monotonic()
        for name, client in self._clients.items():
            if name in pairing.decided:
                continue
            if name in absent:
                self._asked.pop(name, None)
                self._refused.pop(name, None)
            elif name in self._refused:
                since, message = self._refused[name]
                if now - since > GRACE_WALL_S:
                    pairing.fail(name, message)
            elif name in self._asked:
                self._take_answer(name, self._asked[name], now)
            elif client.service_is_ready():
                self._asked[name] = client.call_async(Trigger.Request())
            else:
                self._refused[name] = (now, f'the service {client.srv_name} is not there')

    def _take_answer(self, name: str, future: Future, now: float) -> None:
        response = future.result() if future.done() else None
        if response is not None and not response.success:
            self._refused[name] = (now, response.message)
