"""The process of a lifecycle node: start it, spin until a signal, and shut it down."""

import sys

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import TransitionCallbackReturn

from xpbd_ros.ros.signals import ignore_signals, interrupt_on_signals


def spin(node) -> None:
    """Spin until shutdown; report and skip a /clock before time 0, at which rclpy raises."""
    while True:
        try:
            rclpy.spin(node)
            return
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


def log_or_print(node, level: str, text: str) -> None:
    """Log a message; print it if the ROS context is shut down, where loggers do not work."""
    if not rclpy.ok():
        print(f'[{level.upper()}] [{node.get_name()}]: {text}', file=sys.stderr)
    elif level == 'error':    # on a line of its own: rclpy allows one severity per line
        node.get_logger().error(text)
    else:
        node.get_logger().info(text)


def run(create, args: list[str] | None = None) -> int:
    """
    Run a node until a signal; return 0, 1 if stepping failed, 2 if it cannot start.

    Parameters
    ----------
    create : creates the node
    args : ROS arguments; None for those of the process

    """
    interrupt_on_signals()
    node = None
    try:
        rclpy.init(args=args)
        node = create()
        if node.value('autostart'):
            good = TransitionCallbackReturn.SUCCESS
            if node.trigger_configure() != good or node.trigger_activate() != good:
                return 2 if rclpy.ok() else 0
        spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except ParameterException as error:
        print(f'cloth_node: {error}', file=sys.stderr)
        return 2
    except RuntimeError as error:
        if node is None:
            told = str(error).splitlines()[0]
            if isinstance(error, rclpy_implementation.UnknownROSArgsError):
                told = f'unknown ROS arguments: {told}'
            print(f'cloth_node: {told}', file=sys.stderr)
            return 2
        if rclpy.ok():    # otherwise the context was shut down during a call
            raise
    finally:
        if node is not None:
            node.close()
            node.destroy_node()
        rclpy.try_shutdown()
        ignore_signals()
    return 1 if node is not None and node.failed else 0
