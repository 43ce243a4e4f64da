"""Run a node as a process: signals, one-line errors, exit status."""

from __future__ import annotations

import inspect
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable
from functools import wraps
from typing import Any

import rclpy
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.executors import (
    Executor,
    ExternalShutdownException,
    MultiThreadedExecutor,
    SingleThreadedExecutor,
)
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.service import Service
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from std_srvs.srv import Trigger

from remaster_ros.errors import InsufficientDataError, RemasterError
from remaster_ros.nodes.runtime_files import NameLock

TRACEBACK = 'REMASTER_TRACEBACK'
"""Environment variable: also print where in this program a fault came from."""

ANSWERS_DELIVERED_S = 3.0
"""How long a node that has failed, and is closed, waits for its last answers to arrive, s."""


class RemasterNode(Node):
    """A node that `run` can end, and of whose name there is one in a ROS domain.

    Raises InputError: another process on this computer is that node.
    """

    # Set, from any thread, to end the process with this error, or with status 0.
    failure: RemasterError | None = None
    finished = False
    # A fault of this program in one of its services ends it otherwise: a node that others count on
    # is better gone, which they notice and hold the arm for, than there in an unforeseen state.
    outlives_faults = False

    def __init__(self, node_name: str, **options: Any) -> None:
        super().__init__(node_name, **options)
        self._name_lock = NameLock(self.context.get_domain_id(), self.get_fully_qualified_name())

    def destroy_node(self) -> None:
        """As in rclpy; another process may be this node from then on."""
        super().destroy_node()
        self._name_lock.release()

    # rclpy gives every endpoint an event handler that only warns of QoS mismatches, and looks at
    # each of them for every message: half of what a message costs. The status shows now and then
    # what the graph shows not to match (`status.mismatches`).

    def create_publisher(self, *args: Any, **kwargs: Any) -> Publisher:
        """As in rclpy, without default event handlers."""
        kwargs.setdefault('event_callbacks', PublisherEventCallbacks(use_default_callbacks=False))
        return super().create_publisher(*args, **kwargs)

    def create_subscription(self, *args: Any, **kwargs: Any) -> Subscription:
        """As in rclpy, without default event handlers."""
        kwargs.setdefault(
            'event_callbacks', SubscriptionEventCallbacks(use_default_callbacks=False)
        )
        return super().create_subscription(*args, **kwargs)

    def create_service(
        self, srv_type: Any, srv_name: str, callback: Callable[..., Any], **kwargs: Any
    ) -> Service:
        """As in rclpy, but the caller of a Trigger is answered whatever the callback raises.

        rclpy lets an exception out of the callback end the process, and the caller waits for ever.
        The answer of such a call is that of `failed`: no success, and one line.
        """
        if srv_type is not Trigger:  # Those of rclpy itself, for parameters.
            return super().create_service(srv_type, srv_name, callback, **kwargs)
        return super().create_service(srv_type, srv_name, _answering(self, callback), **kwargs)

    def failed(self, error: Exception, response: Any) -> Any:
        """Return a Trigger response with the reason why a service has failed, in one line."""
        response.success, response.message = False, str(error)
        if not isinstance(error, RemasterError):
            fault = fault_of_this_program(error)
            response.message = str(fault)
            self.get_logger().error(str(fault))
            if not self.outlives_faults:
                self.failure = fault
        return response

    def now_s(self) -> float:
        """Time of the node's clock, s; simulated where use_sim_time is set."""
        return self.get_clock().now().nanoseconds * 1e-9

    @property
    def clock_trouble(self) -> str:
        """Why the node's clock has no time: a simulated one that was not received yet; ''."""
        if self.get_clock().now().nanoseconds > 0:
            return ''
        topic = self.resolve_topic_name('/clock')
        inside = self.get_namespace() != '/' and topic == '/clock'
        hint = ' (that of a fake cell in this namespace: -r /clock:=clock)' if inside else ''
        return f'no message of the simulated clock has come: which node publishes {topic}?{hint}'

    def close(self) -> None:
        """Finish: files closed, threads joined. Called once, before the node is destroyed."""


def fault_of_this_program(error: Exception) -> RemasterError:
    """Return the error to report for an exception that was not foreseen."""
    if os.environ.get(TRACEBACK):
        traceback.print_exception(error)
    return RemasterError(
        f'a fault of this program, please report it: {type(error).__name__}: {error} '
        f'(set {TRACEBACK}=1 to see where)'
    )


def _answering(node: RemasterNode, callback: Callable[..., Any]) -> Callable[..., Any]:
    """Return the callback of a service, one that waits for others or not, with `failed`."""

    @wraps(callback)
    async def serve(request: Any, response: Any) -> Any:
        try:
            answer = callback(request, response)
            return await answer if inspect.isawaitable(answer) else answer
        except Exception as error:
            return node.failed(error, response)

    return serve


class _Executor(MultiThreadedExecutor):
    """rclpy's, but it waits for the callbacks under way before it takes their guards away."""

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """Stop executing callbacks and wait for their end."""
        self._executor.shutdown(wait=True, cancel_futures=True)
        # What was in the queue never runs; without this Python complains of each of them.
        for task, _, _ in self._tasks:
            task.cancel()
        return super().shutdown(timeout_sec)


def run(
    make_node: Callable[[], RemasterNode], args: list[str] | None = None, threads: int = 1
) -> int:
    """Spin the node that `make_node` returns until a signal, its failure or its finish.

    ``threads``: more than one lets a callback block (a service that measures) while others run.
    Returns the exit status, see `report`; 0 after SIGINT or SIGTERM. An error is one line on
    stderr.
    """
    stopping: list[int] = []

    def stop(signum: int, frame: Any) -> None:
        # launch sends SIGINT twice: the second must not interrupt the clean-up.
        stopping.append(signum)

    signal.signal(signal.SIGINT, stop)
    signal.signal(signal.SIGTERM, stop)
    try:
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
        node = make_node()
        executor: Executor = SingleThreadedExecutor() if threads == 1 else _Executor(threads)
        try:
            executor.add_node(node)
            while not (stopping or node.finished or node.failure) and rclpy.ok():
                executor.spin_once(timeout_sec=0.2)
        except ExternalShutdownException:
            pass
        finally:
            # First, as it ends what a callback may be waiting for.
            node.close()
            if node.failure is not None:
                # An answer sent just now is lost with its sender if the caller has not got it yet.
                time.sleep(ANSWERS_DELIVERED_S)
            executor.shutdown(2.0)
            node.destroy_node()
        if node.failure is not None:
            raise node.failure
        return 0
    except RemasterError as error:
        return report(error)
    finally:
        rclpy.try_shutdown()


def report(error: RemasterError) -> int:
    """Print an error as one line on stderr; return its exit status.

    2 for wrong usage, bad input or a device that does not do its part; 1 where the data do not
    allow an answer.
    """
    print(f'error: {" ".join(str(error).split())}', file=sys.stderr)
    return 1 if isinstance(error, InsufficientDataError) else 2
