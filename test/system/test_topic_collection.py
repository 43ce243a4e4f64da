# SPDX-License-Identifier: Apache-2.0
"""Collections whose sensors are topics of nodes of other packages: faults and kills."""

import pytest
from rigs.topic_rig import Collection

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(900)]


@pytest.mark.qualify
def test_sensors_of_other_packages_lose_nothing_to_faults_and_kills(start, client, tmp_path):
    """test/qualification/test_topic_sensors.py has further faults."""
    c = Collection(start, client, tmp_path, candidates=4)
    c.spoil('mocap', c.refused('mocap: scattered'), jumping=1)
    # The driver of the bar sends all the time: that it is gone is no hidden marker.
    c.kill_source('mocap', c.waits_for('nothing on /vrpn_mocap/tool/pose'))
    c.kill('recorder')
    c.finish()
