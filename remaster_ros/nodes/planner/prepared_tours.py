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
    """A `TourPlanner` of which one thread prepares curves and another asks for them, and waits."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._preparing = threading.Lock()

    def prepare(self) -> None:
        """Choose the curves ahead, as `TourPlanner.prepare`."""
        with self._preparing:
            super().prepare()

    def moving(self, T_R_N: Mapping[str, FloatArray]) -> Tour:
        """Return the tour of `TourPlanner.moving`, once the curves that are prepared are there."""
        with self._preparing:
            return super().moving(T_R_N)
