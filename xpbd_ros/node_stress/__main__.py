"""Run cases and print their outcomes as JSON: ``python -m xpbd_ros.node_stress H23``."""

from dataclasses import asdict
import json
from pathlib import Path
import sys
import tempfile
import time

import rclpy

from xpbd_ros.node_stress.cases import CASES
from xpbd_ros.node_stress.node import LostError
from xpbd_ros.study.stress.case import Outcome


def main() -> int:
    """Run the cases named on the command line."""
    rclpy.init()
    found = {}
    with tempfile.TemporaryDirectory(prefix='xpbd_ros_stress_') as folder:
        for id_ in sys.argv[1:]:
            start = time.perf_counter()
            rows: list[Outcome] = []
            try:
                rows += CASES[id_](Path(folder) / id_)
            except LostError as error:
                rows.append(Outcome('node', False, why=str(error)))
            found[id_] = {'rows': [asdict(row) for row in rows],
                          'seconds': time.perf_counter() - start}
    rclpy.try_shutdown()
    print(json.dumps(found))
    return 0


if __name__ == '__main__':
    sys.exit(main())
