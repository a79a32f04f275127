"""
Compile scenes ahead of time, and print the folder of the compiled kernels.

The first run of a scene compiles its kernels, which takes from seconds to a minute. Later
runs, by any process that uses the same folder, load them from it. For container images and for
robots with a read-only home, set NUMBA_CACHE_DIR for this command and for the node.
"""

import time

from xpbd_ros.cli.output import add_json_argument, check_output, write_json
from xpbd_ros.cli.progress import progress

EXAMPLE = 'xpbd_ros compile towel demo'


def add_arguments(parser):
    """Add the verb's arguments to a parser."""
    parser.add_argument('scenes', nargs='*', metavar='SCENE',
                        help='scene files, or names of shipped scenes; default: all shipped ones')
    add_json_argument(parser)


def run(arguments) -> int:
    """Compile each scene."""
    from xpbd_ros.scene.compile import compile_scene
    from xpbd_ros.scene.load import load_scene
    from xpbd_ros.share import shipped_scenes
    from xpbd_ros.sim.backend.disk_cache import CACHE_FOLDER
    from xpbd_ros.sim.backend.jit import WHY_PLAIN
    check_output(arguments.json)
    names = arguments.scenes or list(shipped_scenes())
    scenes = [load_scene(name) for name in names]    # all, before the first one is compiled
    quiet, seconds = arguments.json == '-', {}
    for name, scene in progress(list(zip(names, scenes)), 'scenes'):
        begin = time.perf_counter()
        compile_scene(scene).compile()
        seconds[name] = time.perf_counter() - begin
        if not quiet:
            print(f'{name}: {seconds[name]:.1f} s', flush=True)
    write_json(arguments.json, {'cache': CACHE_FOLDER, 'scenes': seconds, 'plain': WHY_PLAIN})
    if not quiet:
        print(f'kernels are in {CACHE_FOLDER}')
        if WHY_PLAIN:
            print(f'note: compiled without linking, which takes longer: {WHY_PLAIN}')
    return 0
