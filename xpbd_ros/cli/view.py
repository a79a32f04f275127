"""
Show a scene in a browser page, running in real time.

Drag the gizmo of a pin and the cloth follows; click the cloth to grasp it there, click again to
release it. All that is done in the page is recorded as commands, so that a recorded session
repeats bit for bit with 'xpbd_ros resim'. The page is on this machine only, unless --host names
another address.
"""

import threading
import webbrowser

from xpbd_ros.cli.output import add_json_argument, check_output, write_json
from xpbd_ros.cli.run import parse_keys
from xpbd_ros.log.folder import fresh_folder
from xpbd_ros.share import share_folder

EXAMPLE = 'xpbd_ros view towel'


def add_arguments(parser):
    """Add the verb's arguments to a parser."""
    parser.add_argument('scene', help='a scene file, or the name of a shipped scene')
    parser.add_argument('--port', type=int, default=8080, metavar='N',
                        help='port of the page; 0 takes any (default: 8080)')
    parser.add_argument('--host', default='127.0.0.1', metavar='H',
                        help='address to serve on (default: this machine only)')
    parser.add_argument('--set', action='append', default=[], metavar='KEY=VALUE', dest='keys',
                        help='override one key of the scene, such as solver.substeps=32')
    parser.add_argument('--duration', type=float, metavar='S',
                        help='end after this wall time in s (default: on Ctrl-C)')
    parser.add_argument('--no-browser', action='store_true', help='open no browser')
    add_json_argument(parser)


def run(arguments) -> int:
    """Serve the page until Ctrl-C."""
    from xpbd_ros.scene.compile import compile_scene
    from xpbd_ros.scene.load import load_scene
    from xpbd_ros.view.live import LiveView
    from xpbd_ros.view.server import close_server, open_server, reach, url_of

    check_output(arguments.json)
    keys = parse_keys(arguments.keys)
    compile_scene(load_scene(arguments.scene, keys))    # before the page is there
    server = open_server(arguments.host, arguments.port)
    url = url_of(server)
    ended = threading.Event()
    try:
        names = sorted(file.stem for file in (share_folder() / 'scenes').glob('*.yaml'))
        if arguments.scene not in names:
            names.insert(0, arguments.scene)
        view = LiveView(server, arguments.scene, keys, names, recorder())
        if arguments.json != '-':
            print(f'{url}  ({reach(arguments.host)}); Ctrl-C ends it', flush=True)
        if not arguments.no_browser:
            webbrowser.open(url)
        if arguments.duration is not None:
            timer = threading.Timer(arguments.duration, ended.set)
            timer.daemon = True
            timer.start()
        try:
            view.run(ended.is_set)
        except KeyboardInterrupt:
            view.stop_recording()
    finally:
        close_server(server)
    write_json(arguments.json, {'url': url, 'pictures': [], 'frames': view.frames,
                                'drawing_ms_per_frame': 1e3 * view.drawing_s / max(1, view.frames),
                                'state_hash': f'{view.simulation.hash():016x}'})
    return 0


def recorder():
    """Return a function that opens a recorder; None if ROS messages are not installed."""
    from xpbd_ros.cli.ros import need_ros, new_log
    from xpbd_ros.errors import InputError
    try:
        need_ros('view')
    except InputError:
        return None
    return lambda scene, simulation: new_log(fresh_folder('view'), scene, simulation,
                                             program='view')
