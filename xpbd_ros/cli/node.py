"""The node: the same program as ``ros2 run xpbd_ros cloth_node``; it takes --ros-args."""

from xpbd_ros.cli.ros import need_ros

EXAMPLE = 'xpbd_ros node --ros-args -p scene:=drape -p mode:=realtime'


def main(argv: list[str]) -> int:
    """Hand everything to the node."""
    need_ros('node')
    from xpbd_ros.ros.cloth_node import main as node_main
    return node_main(argv)
