# SPDX-License-Identifier: Apache-2.0
"""Run a node: ``python -m remaster_ros.nodes NAME --ros-args …``; without a name, list them."""

import importlib
import signal
import sys

from remaster_ros.errors import did_you_mean

NODES = {
    'pose_planner': 'plans the poses in all their joint solutions and announces them',
    'robot_bridge': 'moves the arm there, if nothing forbids it',
    'optitrack_markers': 'publishes the markers of an OptiTrack system',
    'laser_tracker_markers': 'publishes the points of a laser tracker, and measures on request',
    'sensor_markers': 'publishes the markers of any other registered sensor',
    'recorder': 'pairs robot and sensors, and writes the session',
    'optimizer': 'fits a session, publishes the offsets, looks for causes',
    'replay': 'publishes a recorded session again',
    'compensator': 'corrects what other planners send to the controller',
    'watch': 'shows a collection on a local web page',
    'fake_robot': 'a simulated arm',
    'fake_optitrack': 'a simulated OptiTrack system',
    'fake_laser_tracker': 'a simulated laser tracker',
}


def main(argv: list[str]) -> int:
    """Run the node that the first argument names; list the nodes without one, or for -h or --list.

    Returns the exit status: 0 after a list, 2 with a line on stderr for an unknown name, else the
    node's. ``argv``: arguments without the program's name.
    """
    if not argv or argv[0] in ('-h', '--help', '--list'):
        print('usage: python -m remaster_ros.nodes NAME --ros-args …\n')
        for name, text in NODES.items():
            print(f'  {name:22s} {text}')
        return 0
    if argv[0] not in NODES:
        meant = did_you_mean(argv[0], NODES) or f'; there are {", ".join(NODES)}'
        print(f'error: there is no node {argv[0]!r}{meant}', file=sys.stderr)
        return 2
    # A node takes a second to import; stopped meanwhile it ends like any program, without output.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    node = importlib.import_module(f'remaster_ros.nodes.{argv[0]}')
    return int(node.main(argv))


if __name__ == '__main__':
    raise SystemExit(main(sys.argv[1:]))
