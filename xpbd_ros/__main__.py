"""``python -m xpbd_ros VERB``: the same program as ``xpbd_ros``."""

import sys

from xpbd_ros.cli.main import main

if __name__ == '__main__':
    sys.exit(main())
