# SPDX-License-Identifier: Apache-2.0
"""Time of capture of a reading by the receiver's clock, from the device's time stamps."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from statistics import median


class ClockMapping:
    """Mapping of a device's time stamps to the receiver's clock.

    A datagram arrives after its capture with an unknown delay that is never negative. The smallest
    of (arrival - capture - known age) over the last readings is therefore the best estimate of the
    offset between the clocks: it excludes the delay's jitter, not its minimum (a network hop). A
    simulated clock stops between its ticks: by this clock an arrival may be too early as well as
    too late, and the median is the estimate that neither error affects.

    ``window``: number of last readings; it bounds the delay with which a drift of the clocks is
    followed; ``simulated``: whether the receiver's clock is a simulated one.
    """

    def __init__(self, window: int = 240, *, simulated: bool = False) -> None:
        self._estimate: Callable[[Iterable[float]], float] = median if simulated else min
        self._offsets: deque[float] = deque(maxlen=window)
        self._last_device_s: float | None = None

    def capture_time(self, device_s: float, age_s: float, received_s: float) -> float:
        """Time of capture of a reading by the receiver's clock, s.

        The offset is the least (of a simulated clock the median) of the last readings, this one
        included; a device's clock that goes back begins anew. ``device_s``: capture by the
        device's clock, s; ``age_s``: delay reported by the device, s; ``received_s``: arrival by
        the receiver's clock, s.
        """
        if self._last_device_s is not None and device_s < self._last_device_s:
            # The device's clock was restarted: offsets to the former clock are void.
            self._offsets.clear()
        self._last_device_s = device_s
        self._offsets.append(received_s - device_s - age_s)
        return device_s + self._estimate(self._offsets)
