"""
Start the node: the same program as 'ros2 run xpbd_ros cloth_node'.

Its options are ROS parameters, given with --ros-args. 'ros2 param list /cloth' lists them while
the node runs; share/xpbd_ros/cloth_node.yaml has their defaults.
"""

import argparse

from xpbd_ros.ros.signals import handle_signals

EXAMPLE = 'xpbd_ros node --ros-args -p scene:=drape -p mode:=realtime'


def main(argv: list[str]) -> int:
    """Check that all arguments are for ROS, and start the node with them."""
    parser = argparse.ArgumentParser(
        prog='xpbd_ros node', usage='xpbd_ros node [-h] [--ros-args ...]',
        description=__doc__.strip(), formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog=f'example:\n  {EXAMPLE}')
    _, others = parser.parse_known_args(not_for_ros(argv))
    if others:
        parser.error(f'unrecognized arguments: {" ".join(others)}; parameters follow --ros-args: '
                     f'{EXAMPLE}')
    handle_signals()
    from xpbd_ros.cli.ros import need_ros
    need_ros('node')
    from xpbd_ros.ros.entry import main as node_main
    return node_main(argv)


def not_for_ros(argv: list[str]) -> list[str]:
    """Return the arguments outside of ``--ros-args ... --``."""
    found, outside = [], True
    for word in argv:
        if outside and word != '--ros-args':
            found.append(word)
        outside = word == '--' if not outside else word != '--ros-args'
    return found
