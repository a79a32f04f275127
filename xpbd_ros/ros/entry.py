"""The program ``cloth_node``: a signal ends it in peace from the first import on."""

from xpbd_ros.ros.signals import handle_signals


def main(args: list[str] | None = None) -> int:
    """Import the node, which takes a second or two, and run it as ``cloth_node.main`` does."""
    handle_signals()
    from xpbd_ros.ros.cloth_node import main as node_main
    return node_main(args)
