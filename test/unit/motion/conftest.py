# SPDX-License-Identifier: Apache-2.0
"""The supervisor of most tests here."""

import pytest
from supervisor_rig import begun


@pytest.fixture
def rig():
    """Return a supervisor and its arm, in stepped time."""
    return begun()
