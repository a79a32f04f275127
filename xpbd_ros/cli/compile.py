"""
Compile scenes ahead of time, and say where the compiled kernels are kept.

A scene compiles in seconds to half a minute the first time; later runs of the same scene, by any
process that shares the folder, read the kernels from it. For container images, and for robots
whose home is read-only: set NUMBA_CACHE_DIR, there and where the node runs. Without scenes all
shipped ones are compiled.
"""

import time

EXAMPLE = 'xpbd_ros compile towel demo'


def add_arguments(parser):
    """Declare what the verb takes."""
    parser.add_argument('scenes', nargs='*', metavar='SCENE',
                        help='a scene file, or the name of a shipped scene; default: all shipped')


def run(arguments) -> int:
    """Compile each scene."""
    from xpbd_ros.scene.compile import compile_scene
    from xpbd_ros.scene.load import load_scene
    from xpbd_ros.share import share_folder
    from xpbd_ros.sim.backend.disk_cache import CACHE_FOLDER
    from xpbd_ros.sim.backend.jit import WHY_PLAIN
    names = arguments.scenes or sorted(
        file.stem for file in (share_folder() / 'scenes').glob('*.yaml'))
    scenes = [load_scene(name) for name in names]    # so that a mistake costs no time
    for name, scene in zip(names, scenes):
        begin = time.perf_counter()
        compile_scene(scene).compile()
        print(f'{name}: {time.perf_counter() - begin:.1f} s', flush=True)
    print(f'kernels are in {CACHE_FOLDER}')
    if WHY_PLAIN:
        print(f'note: compiled without linking, which takes longer: {WHY_PLAIN}')
    return 0
