# SPDX-License-Identifier: Apache-2.0
"""A node whose middleware does not let go of it ends all the same."""

import signal
import subprocess
import sys

NODE = """
from remaster_ros.nodes import running

running.LEAVES_WITHIN_S = 1


class Held(running.RemasterNode):
    finished = True

    def close(self):
        print('closed', flush=True)

    def destroy_node(self):
        while True:
            pass


running.run(lambda: Held('held'))
"""


def test_a_node_that_the_middleware_holds_is_ended_by_the_kernel_after_it_is_closed():
    done = subprocess.run(
        [sys.executable, '-c', NODE], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.stdout == 'closed\n'
    assert done.returncode == -signal.SIGALRM
