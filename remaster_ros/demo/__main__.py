# SPDX-License-Identifier: Apache-2.0
"""Run the demo: ``python -m remaster_ros.demo --ros-args …``."""

import importlib
import signal
import sys

if __name__ == '__main__':
    # It takes a second to import; stopped meanwhile it ends like any program, without output.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    raise SystemExit(importlib.import_module('remaster_ros.demo.demo').main(sys.argv[1:]))
