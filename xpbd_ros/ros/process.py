"""The process of a lifecycle node: start it, spin until a signal, and shut it down."""

from functools import partial
import sys
from threading import Event

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.signals import SignalHandlerOptions

from xpbd_ros.ros.signals import handle_signals, ignore_signals, shut_down_on_signals


def spin(node, executor, ending: Event) -> None:
    """
    Spin until ``ending`` is set or stepping has failed; a task of the executor ends the wait.

    A /clock before time 0, at which rclpy raises, is reported and skipped.
    """
    while not (ending.is_set() or node.failed):
        try:
            executor.spin_once()
        except ValueError as error:
            if 'must not be negative' not in str(error):
                raise
            node.get_logger().error(f'/clock: refused: {error}', throttle_duration_sec=1.0)


def answer_every_transition(node) -> None:
    """Answer invalid transitions with ``success=False``; rclpy would end the node."""
    change = node._service_change_state.callback

    def answer(request, response):
        try:
            return change(request, response)
        except RuntimeError:    # rcl has logged the reason
            response.success = False
            return response
    node._service_change_state.callback = answer


def run(create, args: list[str] | None = None) -> int:
    """
    Run a node until a signal; return 0, 1 if stepping failed, 2 if it cannot start.

    Parameters
    ----------
    create : creates the node; it has ``value(parameter)``, ``failed`` and ``close()``
    args : ROS arguments; None for those of the process

    """
    handle_signals()
    node, executor, ending = None, None, Event()
    try:
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
        executor = SingleThreadedExecutor()
        shut_down_on_signals(partial(executor.create_task, ending.set))
        node = create()
        executor.add_node(node)
        if node.value('autostart'):
            good = TransitionCallbackReturn.SUCCESS
            if node.trigger_configure() != good or node.trigger_activate() != good:
                return 2
        spin(node, executor, ending)
    except ParameterException as error:
        print(f'cloth_node: {error}', file=sys.stderr)
        return 2
    except RuntimeError as error:
        if node is not None:
            raise
        told = str(error).splitlines()[0]
        if isinstance(error, rclpy_implementation.UnknownROSArgsError):
            told = f'unknown ROS arguments: {told}'
        print(f'cloth_node: {told}', file=sys.stderr)
        return 2
    finally:
        ignore_signals()
        if node is not None:
            node.close()
            node.destroy_node()
        if executor is not None:
            executor.shutdown()
        rclpy.try_shutdown()
    return 1 if node is not None and node.failed else 0
