# SPDX-License-Identifier: Apache-2.0
"""A bag that several files of tests read."""

import pytest
from foreign.bag_messages import messages

from remaster_ros.session.bags.bag_writer import BagWriter


@pytest.fixture
def bag(tmp_path):
    with BagWriter(tmp_path / 'bag') as writer:
        for message in messages():
            writer.write(*message)
    return tmp_path / 'bag'
