# SPDX-License-Identifier: Apache-2.0
"""What a driver must have is asked for where its class is defined."""

import pytest

from remaster_ros.sensors.driver import TriggeredDriver


def test_several_markers_on_request_need_a_turn() -> None:
    with pytest.raises(TypeError, match='Half has several_markers, and no turn_to'):

        class Half(TriggeredDriver):
            several_markers = True

    class Whole(TriggeredDriver):
        several_markers = True

        def turn_to(self, marker, expected):
            pass

    class Sub(Whole):
        """Has it of the class above."""

    class Single(TriggeredDriver):
        """Needs none."""

    assert Sub.turn_to is Whole.turn_to
    assert Single.turn_to is TriggeredDriver.turn_to
