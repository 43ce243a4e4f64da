"""Run a node by its name: ``python -m remaster_ros.nodes NAME --ros-args …``."""

import importlib
import signal
import sys

if __name__ == '__main__':
    # A node takes a second to import; stopped meanwhile it ends like any program, without output.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    node = importlib.import_module(f'remaster_ros.nodes.{sys.argv[1]}')
    raise SystemExit(node.main(sys.argv[1:]))
