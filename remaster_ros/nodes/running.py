# SPDX-License-Identifier: Apache-2.0
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
from pathlib import Path
from typing import Any

import rclpy
from rcl_interfaces.msg import SetParametersResult
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

from remaster_ros.errors import InputError, InsufficientDataError, RemasterError
from remaster_ros.nodes.runtime_files import NameLock

TRACEBACK = 'REMASTER_TRACEBACK'
"""Environment variable: also print where in this program a fault came from."""

PACKAGE = Path(__file__).parents[1]
LONGEST_TEXT = 300
"""Characters of an exception that are shown: it may quote a message of a megabyte."""
MOST_FAULTS = 100
"""So many different faults are written to the log: whoever provokes them must not fill a disk."""

ANSWERS_DELIVERED_S = 3.0
"""How long a node that has failed, and is closed, waits for its last answers to arrive, s."""
LEAVES_WITHIN_S = 20
"""The middleware takes a second to let go of a node, some on a busy computer."""


class RemasterNode(Node):
    """Node that `run` can end, and that is the only one of its name in a ROS domain.

    Raises InputError: another process on this computer is that node.
    """

    # Set, from any thread, to end the process with this error, or with status 0.
    failure: RemasterError | None = None
    finished = False
    # A fault of this program in one of its callbacks ends it otherwise: a node that others count
    # on is better gone, which they notice and hold the arm for, than there in an unforeseen state.
    outlives_faults = False

    def __init__(self, node_name: str, **options: Any) -> None:
        self._faults: set[str] = set()
        super().__init__(node_name, **options)
        self._name_lock = NameLock(self.context.get_domain_id(), self.get_fully_qualified_name())

    def destroy_node(self) -> None:
        """Destroy the node, and release the lock of its name for another process."""
        super().destroy_node()
        self._name_lock.release()

    # rclpy gives every endpoint an event handler that only warns of QoS mismatches, and looks at
    # each of them for every message: half of what a message costs. The status shows now and then
    # what the graph shows not to match (`status.mismatches`).

    def create_publisher(self, *args: Any, **kwargs: Any) -> Publisher:
        """Create a publisher as rclpy does, without its warnings of QoS mismatches."""
        kwargs.setdefault('event_callbacks', PublisherEventCallbacks(use_default_callbacks=False))
        return super().create_publisher(*args, **kwargs)

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[..., Any], *args: Any, **kwargs: Any
    ) -> Subscription:
        """Subscribe as rclpy does, without its warnings of QoS mismatches.

        A message for which the callback raises InputError is dropped, with a line in the log
        (`on_unreadable`).
        """
        kwargs.setdefault(
            'event_callbacks', SubscriptionEventCallbacks(use_default_callbacks=False)
        )
        taking = _leaving_out(self, topic, callback)
        return super().create_subscription(msg_type, topic, taking, *args, **kwargs)

    def create_service(
        self, srv_type: Any, srv_name: str, callback: Callable[..., Any], **kwargs: Any
    ) -> Service:
        """Create a service as rclpy does; its caller is answered whatever the callback raises.

        A Trigger is answered as by `failed` (no success, one line), which gives an error that
        is no RemasterError to `on_fault`, too: the node may end with it. For other types the
        error is logged, and the answer is empty or refuses the parameters of the request.
        """
        if srv_type is not Trigger:  # Those of rclpy itself, for parameters.
            callback = _refusing(self, srv_name, callback)
            return super().create_service(srv_type, srv_name, callback, **kwargs)
        return super().create_service(srv_type, srv_name, _answering(self, callback), **kwargs)

    def failed(self, error: Exception, response: Any) -> Any:
        """Return the Trigger response, without success, with the reason of a failure in one line.

        ``response``: changed in place. An error that is no RemasterError goes to `on_fault` too.
        """
        response.success, response.message = False, str(error)
        if not isinstance(error, RemasterError):
            response.message = str(fault_of_this_program(error))
            self.on_fault(error)
        return response

    def on_fault(self, error: Exception) -> None:
        """Report an exception that a callback has not caught, with its place in the code.

        Each text is logged once, `MOST_FAULTS` at most. The node ends with it (`failure`) unless
        it outlives faults. A node that leads an arm stops and halts the arm here, and lives on.
        """
        fault = fault_of_this_program(error)
        # The same message may come a thousand times a second.
        if str(fault) not in self._faults and len(self._faults) < MOST_FAULTS:
            self._faults.add(str(fault))
            self.get_logger().error(str(fault))
        if not self.outlives_faults:
            self.failure = fault

    def on_unreadable(self, name: str, error: Exception) -> None:
        """Log that a message, request or answer cannot be read, and is dropped.

        ``name``: topic or service. Each text is logged once, `MOST_FAULTS` at most.
        """
        text = str(error)[:LONGEST_TEXT] if isinstance(error, RemasterError) else ''
        why = f'{name}: a message is left out: {text or type(error).__name__}'
        if why not in self._faults and len(self._faults) < MOST_FAULTS:
            self._faults.add(why)
            self.get_logger().error(why)

    def now_s(self) -> float:
        """Time of the node's clock, s; simulated if use_sim_time is set."""
        return self.get_clock().now().nanoseconds * 1e-9

    @property
    def clock_trouble(self) -> str:
        """Why the node has no time (no simulated clock received yet), or ''.

        It has one once its clock is above 0.
        """
        if self.get_clock().now().nanoseconds > 0:
            return ''
        topic = self.resolve_topic_name('/clock')
        inside = self.get_namespace() != '/' and topic == '/clock'
        hint = ' (that of a fake cell in this namespace: -r /clock:=clock)' if inside else ''
        return f'no message of the simulated clock has come: which node publishes {topic}?{hint}'

    def close(self) -> None:
        """Finish: files closed, threads joined. Called once, before the node is destroyed."""


def fault_of_this_program(error: Exception) -> RemasterError:
    """Return the error to report for an exception that was not foreseen.

    Its text has type, message (`LONGEST_TEXT` characters) and place. With the environment variable
    `TRACEBACK` the traceback is printed.
    """
    if os.environ.get(TRACEBACK):
        traceback.print_exception(error)
    text = ' '.join(str(error).split())
    text = text if len(text) <= LONGEST_TEXT else f'{text[:LONGEST_TEXT]} …'
    return RemasterError(
        f'a fault of this program, please report it: {type(error).__name__}: {text} '
        f'({_place_of(error)}; set {TRACEBACK}=1 to see the whole way there)'
    )


def _place_of(error: Exception) -> str:
    """Return file, line and function of the innermost frame of this package, as text for a report.

    Of another package if there is none of this one; 'at no known place' without a traceback.
    """
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if PACKAGE in Path(frame.filename).parents]
    if not frames:
        return 'at no known place'
    frame = (ours or list(frames))[-1]
    return f'{Path(frame.filename).name}, line {frame.lineno}, {frame.name}'


def _answering(node: RemasterNode, callback: Callable[..., Any]) -> Callable[..., Any]:
    """Return a service's callback, sync or async, whose exceptions become `failed` responses."""

    @wraps(callback)
    async def serve(request: Any, response: Any) -> Any:
        try:
            answer = callback(request, response)
            return await answer if inspect.isawaitable(answer) else answer
        except Exception as error:
            return node.failed(error, response)

    return serve


def _leaving_out(
    node: RemasterNode, topic: str, callback: Callable[..., Any]
) -> Callable[..., Any]:
    """Return a topic's callback that drops a message for which `callback` raises InputError.

    The error is logged (`on_unreadable`); other exceptions are raised.
    """

    @wraps(callback)
    def take(*message: Any) -> Any:
        try:
            return callback(*message)
        except InputError as error:
            node.on_unreadable(topic, error)
            return None

    return take


def _refusing(node: RemasterNode, name: str, callback: Callable[..., Any]) -> Callable[..., Any]:
    """Return a service callback that answers with a refusal if `callback` raises.

    For rclpy's own services, whose requests may be unreadable, such as a parameter of no known
    type. The error is logged. The answer is a new one; its results, if it has any, say
    ``successful`` False with the reason. ``name``: of the service, for the log.
    """

    @wraps(callback)
    def serve(request: Any, response: Any) -> Any:
        try:
            return callback(request, response)
        except Exception as error:
            node.on_unreadable(name, error)
            answer = type(response)()
            why = SetParametersResult(successful=False, reason=f'not a request: {error}'[:1000])
            if hasattr(answer, 'results') and hasattr(request, 'parameters'):
                answer.results = [why] * len(request.parameters)
            elif hasattr(answer, 'result'):
                answer.result = why
            return answer

    return serve


class _Takes(Executor):
    """Executor mixin that drops messages, requests and answers that rclpy cannot read.

    rclpy raises out of its own bookkeeping there, and never takes from that topic again.
    """

    def _take_subscription(self, sub: Any) -> Any:
        """Take a message as rclpy does; None if it cannot be read."""
        return self._taken(super()._take_subscription, sub, sub.topic_name)

    def _take_client(self, client: Any) -> Any:
        """Take an answer as rclpy does; None if it cannot be read."""
        return self._taken(super()._take_client, client, client.srv_name)

    def _take_service(self, srv: Any) -> Any:
        """Take a request as rclpy does; None if it cannot be read."""
        return self._taken(super()._take_service, srv, srv.srv_name)

    def _taken(self, take: Callable[[Any], Any], entity: Any, name: str) -> Any:
        """Result of `take` for an entity; None if its message is unreadable, which is reported."""
        try:
            return take(entity)
        except Exception as error:
            # It is the sender's, and nothing of it was processed.
            for node in self.get_nodes():
                if isinstance(node, RemasterNode):
                    node.on_unreadable(name, error)
            return None


class OneThread(_Takes, SingleThreadedExecutor):
    """Executor of one thread of rclpy that survives unreadable messages; see `_Takes`."""


class _Threads(_Takes, MultiThreadedExecutor):
    """Executor of several threads that waits at its end for the callbacks under way."""

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """Stop executing callbacks and wait for the end of those under way; then as in rclpy."""
        self._executor.shutdown(wait=True, cancel_futures=True)
        # What was in the queue never runs; without this Python complains of each of them.
        for task, _, _ in self._tasks:
            task.cancel()
        return super().shutdown(timeout_sec)


def run(
    make_node: Callable[[], RemasterNode], args: list[str] | None = None, threads: int = 1
) -> int:
    """Spin the node that `make_node` returns until a signal, its failure or its finish.

    ``args``: command line, None for that of the process; ``threads``: more than one lets a
    callback block (a service that measures) while others run. The node is closed and destroyed at
    the end. Returns the exit status, see `report`; 0 after SIGINT or SIGTERM, or if finished. An
    error is one line on stderr.
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
        executor: Executor = OneThread() if threads == 1 else _Threads(threads)
        try:
            executor.add_node(node)
            while not (stopping or node.finished or node.failure) and rclpy.ok():
                spin_once(executor, node, 0.2)
        except ExternalShutdownException:
            pass
        finally:
            # First, as it ends what a callback may be waiting for.
            node.close()
            if node.failure is not None:
                # An answer sent just now is lost with its sender if the caller has not got it yet.
                time.sleep(ANSWERS_DELIVERED_S)
            executor.shutdown(2.0)
            # The middleware may wait for ever for peers that were killed, and holds Python's lock:
            # the kernel ends the process then. All that the node writes is written.
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
            signal.alarm(LEAVES_WITHIN_S)
            node.destroy_node()
        if node.failure is not None:
            raise node.failure
        return 0
    except RemasterError as error:
        return report(error)
    except Exception as error:
        return report(fault_of_this_program(error))
    finally:
        rclpy.try_shutdown()
        signal.alarm(0)


def spin_once(executor: Executor, node: RemasterNode, timeout_s: float) -> None:
    """Execute one callback that is due, or give it to the executor's threads, if it has several.

    An uncaught exception goes to the node's `on_fault`; a RemasterError becomes its `failure`
    unless the node outlives faults. With threads it may be that of an earlier callback. Returns
    after `timeout_s` at most if none is due. Raises ExternalShutdownException as rclpy.
    """
    try:
        executor.spin_once(timeout_sec=timeout_s)
    except ExternalShutdownException:
        raise
    except RemasterError as error:
        # What the user can mend is no fault of this program, but where it comes out here nobody
        # has processed it.
        if node.outlives_faults:
            node.on_fault(error)
        else:
            node.failure = error
    except Exception as error:
        node.on_fault(error)


def report(error: RemasterError) -> int:
    """Print an error as one line on stderr; return its exit status.

    1 for InsufficientDataError: the data do not allow an answer; 2 for all others, such as
    wrong usage, bad input or a device that does not do its part.
    """
    print(f'error: {" ".join(str(error).split())}', file=sys.stderr)
    return 1 if isinstance(error, InsufficientDataError) else 2
