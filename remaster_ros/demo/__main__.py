# SPDX-License-Identifier: Apache-2.0
"""Run the demo: ``python -m remaster_ros.demo --ros-args …``."""

import sys

from remaster_ros.demo.demo import main

if __name__ == '__main__':
    raise SystemExit(main(sys.argv[1:]))
