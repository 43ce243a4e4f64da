# SPDX-License-Identifier: Apache-2.0
"""A device's clock against ours: when was a reading captured, by our clock?"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from statistics import median


class ClockMapping:
    """Map a device's time stamps to the receiver's clock.

    A datagram arrives after it was captured by an unknown delay that is never negative, so the
    smallest of (arrival - capture - known age) over the last readings is the best estimate of the
    offset between the clocks: the delay's jitter drops out, its minimum (a network hop) stays.

    A simulated clock stands still between its ticks: by it an arrival may seem too early as well
    as too late, and the median is the estimate that neither error spoils.

    ``window``: how many readings are looked back on; bounds how long a drift of the clocks lags;
    ``simulated``: whether the receiver's clock is a simulated one.
    """

    def __init__(self, window: int = 240, *, simulated: bool = False) -> None:
        self._estimate: Callable[[Iterable[float]], float] = median if simulated else min
        self._offsets: deque[float] = deque(maxlen=window)
        self._last_device_s: float | None = None

    def capture_time(self, device_s: float, age_s: float, received_s: float) -> float:
        """Return when a reading was captured, by the receiver's clock, s.

        ``device_s``: capture by the device's clock, s; ``age_s``: delay that the device itself
        reports, s; ``received_s``: arrival by the receiver's clock, s.
        """
        if self._last_device_s is not None and device_s < self._last_device_s:
            # The device's clock has started anew; what was learned of the old one is void.
            self._offsets.clear()
        self._last_device_s = device_s
        self._offsets.append(received_s - device_s - age_s)
        return device_s + self._estimate(self._offsets)
