# SPDX-License-Identifier: Apache-2.0
"""Tours whose curves are prepared in a thread of their own, before they are asked for."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any

from remaster_ros.planning.tour_order import Tour
from remaster_ros.planning.tour_planner import TourPlanner
from remaster_ros.types import FloatArray


class PreparedTours(TourPlanner):
    """A `TourPlanner` whose curves for measuring in motion are chosen ahead in another thread."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._preparing = threading.Lock()

    def prepare(self) -> None:
        """Choose the curves for measuring in motion ahead, as `TourPlanner.prepare`.

        To be called in a thread of its own; a call of `moving` waits for its end.
        """
        with self._preparing:
            super().prepare()

    def moving(self, T_R_N: Mapping[str, FloatArray]) -> Tour:
        """Return the tour of `TourPlanner.moving`, after the end of a `prepare` under way."""
        with self._preparing:
            return super().moving(T_R_N)
