# SPDX-License-Identifier: Apache-2.0
"""What a command loads before it does anything: told by its modules, not by a clock."""

import subprocess
import sys

import pytest

HEAVY = {
    'numpy',
    'scipy',
    'matplotlib',
    'arviz_stats',
    'coal',
    'pinocchio',
    'rich',
    'yaml',
    'rclpy',
}
TOLD = """
import sys
from remaster_ros.cli.main import main
try:
    main(sys.argv[1:])
except SystemExit as end:
    status = end.code
print(status, *sorted({name.partition('.')[0] for name in sys.modules}), file=sys.stderr)
"""


@pytest.mark.parametrize(
    ('words', 'status'),
    [(['fit', '--help'], 0), (['fit', '--out', 'f', '--sampler', 'slow', 's'], 2)],
    ids=['help', 'mistyped'],
)
def test_what_fits_nothing_loads_no_library(words, status):
    done = subprocess.run(
        [sys.executable, '-c', TOLD, *words], capture_output=True, text=True, check=True
    )
    found, *loaded = done.stderr.splitlines()[-1].split()
    assert int(found) == status
    assert 'remaster_ros' in loaded
    assert not HEAVY & {*loaded}
