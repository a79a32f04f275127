"""
Show a scene in a browser page, running in real time, or a log with a time slider.

Drag the gizmo of a pin and the cloth follows; click the cloth to grasp it there, click again to
release it. All that is done in the page is recorded as commands, so that a recorded session
repeats bit for bit with 'xpbd_ros resim'. A log is played with plots of its forces; --beside shows
a second one next to it, coloured by the distance between the two. The page is on this machine
only, unless --host names another address.
"""

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
import sys
import threading
import webbrowser

from xpbd_ros.cli.output import add_json_argument, check_output, write_json
from xpbd_ros.cli.progress import progress
from xpbd_ros.cli.ros import need_ros, new_log
from xpbd_ros.cli.run import parse_keys
from xpbd_ros.errors import InputError
from xpbd_ros.log.folder import fresh_folder
from xpbd_ros.share import share_folder

EXAMPLE = 'xpbd_ros view towel'


def add_arguments(parser):
    """Add the verb's arguments to a parser."""
    parser.add_argument('shown', metavar='SCENE|RUN',
                        help='a scene file, the name of a shipped scene, the folder of a log or '
                             'the .mcap file in it')
    parser.add_argument('--beside', metavar='RUN2', help='a second log of the same cloths')
    parser.add_argument('--every', type=int, default=1, metavar='N',
                        help='of a log, only frames whose index is a multiple of N (default: 1)')
    parser.add_argument('--export', metavar='FILE.html',
                        help='write a page of the log that plays without a server, and end')
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
    """Serve the page until Ctrl-C, or write it to a file."""
    for file in (arguments.json, arguments.export):
        check_output(file)
    path = Path(arguments.shown)
    if path.suffix == '.mcap' or path.is_dir():
        return show_log(arguments)
    for name in ('beside', 'export'):
        if getattr(arguments, name):
            raise InputError(f'--{name}: needs a log, and {arguments.shown} is a scene; record '
                             'one with xpbd_ros run')
    return show_scene(arguments)


def show_scene(arguments) -> int:
    """Serve a page of a running scene."""
    from xpbd_ros.view.live import LiveView
    from xpbd_ros.view.server import close_server, open_server, url_of

    keys = parse_keys(arguments.keys)
    server = open_server(arguments.host, arguments.port)
    url = url_of(server)
    try:
        names = sorted(file.stem for file in (share_folder() / 'scenes').glob('*.yaml'))
        if arguments.shown not in names:
            names.insert(0, arguments.shown)
        view = LiveView(server, arguments.shown, keys, names, recorder())
        serve(arguments, url, view.run)
        view.stop_recording()
    finally:
        close_server(server)
    write_json(arguments.json, {'url': url, 'pictures': [], 'frames': view.frames,
                                'drawing_ms_per_frame': 1e3 * view.drawing_s / max(1, view.frames),
                                'state_hash': f'{view.simulation.hash():016x}'})
    return 0


def show_log(arguments) -> int:
    """Serve a page of a log, or write it to a file."""
    need_ros('view')
    from xpbd_ros.ros.logged_commands import Recording
    from xpbd_ros.view.recorded import RecordedView
    from xpbd_ros.view.server import close_server, open_server, url_of

    if arguments.every < 1:
        raise InputError(f'--every: must be at least 1 (got {arguments.every})')
    track = track_of(arguments.shown, arguments.every)
    beside = track_of(arguments.beside, arguments.every) if arguments.beside else None
    scene = Recording(arguments.shown).scene
    server = open_server(arguments.host, 0 if arguments.export else arguments.port)
    url = url_of(server)
    try:
        view = RecordedView(server, track, scene, beside)
        if arguments.export:
            Path(arguments.export).write_text(view.as_html(), encoding='utf-8')
            url = Path(arguments.export).absolute().as_uri()
            if arguments.json != '-':
                print(Path(arguments.export).absolute())
        else:
            serve(arguments, url, view.run)
    finally:
        close_server(server)
    write_json(arguments.json, {'url': url, 'pictures': [], 'frames': len(track.times)})
    return 0


def track_of(run: str, every: int):
    """Return a log, read into arrays; its damage is printed."""
    from xpbd_ros.export.states import States
    from xpbd_ros.view.recorded import Track
    states = States(run, every=every, tell=lambda text: print(
        f'xpbd_ros view: damaged log: {text}', file=sys.stderr))
    return Track.read(states, progress(states, 'frames'))


def serve(arguments, url: str, run: Callable[[Callable[[], bool]], None]) -> None:
    """Tell the address, open a browser, and call ``run`` until Ctrl-C or ``--duration``."""
    from xpbd_ros.view.server import reach

    ended = threading.Event()
    if arguments.json != '-':
        print(f'{url}  ({reach(arguments.host)}); Ctrl-C ends it', flush=True)
    if not arguments.no_browser:
        webbrowser.open(url)
    if arguments.duration is not None:
        timer = threading.Timer(arguments.duration, ended.set)
        timer.daemon = True
        timer.start()
    with suppress(KeyboardInterrupt):
        run(ended.is_set)


def recorder():
    """Return a function that opens a recorder; None if ROS messages are not installed."""
    try:
        need_ros('view')
    except InputError:
        return None
    return lambda scene, simulation: new_log(fresh_folder('view'), scene, simulation,
                                             program='view')
