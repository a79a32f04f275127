"""
Show a scene in a browser page, running in real time; or logs, a study, or a running node.

Drag the gizmo of a pin and the cloth follows; click the cloth to grasp it there, click again to
release it. All that is done in the page is recorded as commands, so that a recorded session
repeats bit for bit with 'xpbd_ros resim'. A log is played with plots of its forces; --beside shows
others next to it, coloured by the distance to it. The folder of a study of 'xpbd_ros accuracy'
shows its reference, its recommended and its cheapest setting side by side. --node shows a node
that runs elsewhere, and drags its pins over DDS. The page is on this machine only, unless --host
names another address.
"""

from collections.abc import Callable
from contextlib import contextmanager, suppress
from pathlib import Path
import signal
import sys
import threading
import webbrowser

from xpbd_ros.cli.output import add_json_argument, check_outputs, write_json, write_text
from xpbd_ros.cli.overrides import add_set_argument, parse_keys
from xpbd_ros.cli.progress import progress
from xpbd_ros.cli.ros import commands_of, need_ros, new_log
from xpbd_ros.cli.run import LONGEST
from xpbd_ros.errors import InputError
from xpbd_ros.log.folder import fresh_folder
from xpbd_ros.share import shipped_scenes

EXAMPLE = 'xpbd_ros view towel'
PICTURE_WIDTH = 1000
"""[pixels]"""


def add_arguments(parser):
    """Add the verb's arguments to a parser."""
    parser.add_argument('shown', metavar='SCENE|RUN', nargs='?',
                        help='a scene file, the name of a shipped scene, the folder of a log or '
                             'the .mcap file in it, or the folder of a study by accuracy')
    parser.add_argument('--node', metavar='NAME',
                        help='show this running node instead, such as /cloth')
    parser.add_argument('--beside', action='append', default=[], metavar='RUN2',
                        help='a further log of the same cloths; may be given several times')
    parser.add_argument('--every', type=int, metavar='N',
                        help='of a log, only frames whose index is a multiple of N (default: 1)')
    parser.add_argument('--export', metavar='FILE.html',
                        help='write a page of the log that plays without a server, and end')
    parser.add_argument('--screenshot', metavar='FILE.png',
                        help='draw the scene or the log at one time, or the node as it is; end '
                             'without opening a page')
    parser.add_argument('--at', type=float, metavar='S',
                        help='time of the screenshot in s (default: the end)')
    parser.add_argument('--port', type=int, default=8080, metavar='N',
                        help='port of the page; 0 takes any (default: 8080)')
    parser.add_argument('--host', default='127.0.0.1', metavar='H',
                        help='address to serve on (default: this machine only)')
    add_set_argument(parser)
    parser.add_argument('--duration', type=float, metavar='S',
                        help='end after this wall time in s (default: on Ctrl-C)')
    parser.add_argument('--no-browser', action='store_true', help='open no browser')
    add_json_argument(parser)


def run(arguments) -> int:
    """Serve the page until Ctrl-C, or write it to a file."""
    check_outputs(arguments.json, arguments.export, arguments.screenshot)
    if arguments.at is not None and not arguments.screenshot:
        raise InputError('--at: is the time of a --screenshot, which is not asked for')
    if arguments.duration is not None and not 0.0 < arguments.duration <= LONGEST:
        raise InputError(f'--duration: must be > 0 and at most {LONGEST:g} s (got '
                         f'{arguments.duration:g} s); leave it out to end on Ctrl-C')
    if (arguments.shown is None) == (arguments.node is None):
        raise InputError('name one of a scene, a log, a study or --node, such as xpbd_ros view '
                         'towel')
    if arguments.node is not None:
        refuse(arguments, 'a log', '--node shows a running node', 'beside', 'export', 'every')
        refuse(arguments, 'a scene or a log', '--node shows a running node', 'at', 'keys')
        return (picture_of_node if arguments.screenshot else show_node)(arguments)
    path = Path(arguments.shown)
    if path.exists() and (report := report_at(path)) is not None:
        refuse(arguments, 'a scene or a log', f'{path} is a study', 'beside', 'screenshot')
        refuse(arguments, 'a log', f'{path} is a study', 'every')
        refuse(arguments, 'a scene', f'{path} is a study', 'keys')
        return show_report(arguments, report)
    if path.suffix == '.mcap' or path.is_dir():
        refuse(arguments, 'a scene', f'{path} is a log; solve it again with other keys by '
               'xpbd_ros resim', 'keys')
        return (picture_of_log if arguments.screenshot else show_log)(arguments)
    refuse(arguments, 'a log', f'{path} is a scene; record one with xpbd_ros run', 'beside',
           'export', 'every')
    return (picture_of_scene if arguments.screenshot else show_scene)(arguments)


def refuse(arguments, needed: str, given: str, *names: str) -> None:
    """Raise InputError if one of these options is given."""
    for name in names:
        if getattr(arguments, name) not in (None, []):
            raise InputError(f'--{"set" if name == "keys" else name}: needs {needed}, and {given}')


@contextmanager
def served(arguments, port: int | None = None):
    """Yield a server, and the address of its page."""
    from xpbd_ros.view.server import close_server, open_server, url_of

    server = open_server(arguments.host, arguments.port if port is None else port)
    try:
        yield server, url_of(server)
    finally:
        close_server(server)


def show_scene(arguments) -> int:
    """Serve a page of a running scene."""
    from xpbd_ros.view.live import LiveView

    keys = parse_keys(arguments.keys)
    names = list(shipped_scenes())
    if arguments.shown not in names:
        names.insert(0, arguments.shown)
    with served(arguments) as (server, url):
        view = LiveView(server, arguments.shown, keys, names, recorder())
        serve(arguments, url, view.run)
    write_json(arguments.json, {'url': url, 'pictures': [], 'frames': view.frames,
                                'drawn': view.drawn,
                                'drawing_ms_per_frame': 1e3 * view.drawing_s / max(1, view.frames),
                                'state_hash': f'{view.simulation.hash():016x}'})
    return 0


def show_node(arguments) -> int:
    """Serve a page of a running node."""
    need_ros('view --node')
    from xpbd_ros.ros.cloth_client import ClothClient
    from xpbd_ros.view.node import NodeView

    client = ClothClient(arguments.node)
    try:
        scene = client.connect()
        with served(arguments) as (server, url):
            view = NodeView(server, client, scene)
            serve(arguments, url, view.run)
    finally:
        client.close()
    write_json(arguments.json, {'url': url, 'pictures': [], 'frames': view.frames})
    return 0


def show_log(arguments) -> int:
    """Serve a page of logs, or write it to a file."""
    need_ros('view')
    from xpbd_ros.ros.logged_commands import Recording

    every = 1 if arguments.every is None else arguments.every
    if every < 1:
        raise InputError(f'--every: must be at least 1 (got {every})')
    track = track_of(arguments.shown, every)    # tells the damage of a log first
    recording = Recording(arguments.shown)
    tracks = [with_energy(recording, track)]
    for run in arguments.beside:
        track = track_of(run, every)
        try:
            tracks.append(with_energy(Recording(run), track))
        except InputError:    # of a damaged log, whose states can be shown
            tracks.append(track)
    scene = recording.scene
    return show_tracks(arguments, tracks, scene)


def report_at(path: Path):
    """Return the report of a study at a path; None if there is none."""
    from xpbd_ros.study.accuracy.motion import report_of
    return report_of(path)


def show_report(arguments, report) -> int:
    """Run the settings of a study, and serve a page of them, or write it to a file."""
    from xpbd_ros.scene.compile import compile_scene
    from xpbd_ros.study.accuracy.measure import without_solver
    from xpbd_ros.view.recorded import Track

    scene = report.settings[0].scene
    commands = without_solver({} if report.commands is None else commands_of(
        'view', report.commands, scene, report.frames))
    tracks = [Track.stepped(name, compile_scene(scene), commands, progress(
        range(1, report.frames + 1), name.split('\n')[0])) for name, scene in report.settings]
    return show_tracks(arguments, tracks, scene, [name for name, _ in report.settings])


def show_tracks(arguments, tracks, scene, names=()) -> int:
    """Serve a page of runs, or write it to a file."""
    from xpbd_ros.view.recorded import RecordedView

    with served(arguments, 0 if arguments.export else None) as (server, url):
        view = RecordedView(server, tracks, scene.sections.get('colliders', {}), names)
        if arguments.export:
            file = Path(arguments.export).absolute()
            write_text(file, view.as_html())
            url = file.as_uri()
            if arguments.json != '-':
                print(file)
        else:
            serve(arguments, url, view.run)
    write_json(arguments.json, {'url': url, 'pictures': [], 'frames': len(tracks[0].times)})
    return 0


def states_of(run: str, every: int = 1):
    """Return the states of a log; its damage is printed."""
    from xpbd_ros.export.states import States
    return States(run, every=every, tell=lambda text: print(
        f'xpbd_ros view: damaged log: {text}', file=sys.stderr))


def track_of(run: str, every: int):
    """Return a log, read into arrays."""
    from xpbd_ros.view.recorded import Track
    states = states_of(run, every)
    return Track.read(states, progress(states, 'frames'))


def with_energy(recording, track):
    """Return a log with its energy."""
    return track.with_energy(recording.scene, recording.commands,
                             progress(range(len(track.times)), 'energies'))


def picture_of_scene(arguments) -> int:
    """Simulate a scene up to a time, and draw it."""
    from xpbd_ros.scene.compile import compile_scene
    from xpbd_ros.scene.load import load_scene
    from xpbd_ros.study.picture import need_view
    from xpbd_ros.study.snapshots import instant

    need_view('--screenshot')
    scene = load_scene(arguments.shown, parse_keys(arguments.keys))
    end = scene.top.duration if arguments.at is None else arguments.at
    if not 0.0 <= end <= LONGEST:
        raise InputError(f'--at: must be from 0 to {LONGEST:g} s (got {end:g} s)')
    simulation = compile_scene(scene)
    frame = simulation.frame()
    for _ in progress(range(round(end * scene.top.frame_rate)), 'frames'):
        frame = simulation.step()
    return draw_instant(arguments, instant(simulation, frame), frame.index)


def picture_of_log(arguments) -> int:
    """Draw a log at a time."""
    need_ros('view')
    from xpbd_ros.ros.logged_commands import Recording
    from xpbd_ros.study.picture import need_view
    from xpbd_ros.study.snapshots import instant_of

    need_view('--screenshot')
    refuse(arguments, 'a page', 'it is drawn without one', 'beside', 'export', 'every')
    states = states_of(arguments.shown)
    entries = Recording(arguments.shown).scene.sections.get('colliders', {})
    wanted = state = next(iter(states))
    for state in states:
        if arguments.at is None or state.time_s <= arguments.at + 1e-6:
            wanted = state
    if arguments.at is not None and not 0.0 <= arguments.at <= state.time_s + 1e-6:
        raise InputError(f'--at: {arguments.shown} lasts from 0 to {state.time_s:.3g} s (got '
                         f'{arguments.at:g} s)')
    return draw_instant(arguments, instant_of(
        f'{wanted.time_s:.2f} s', zip(wanted.positions.values(), states.triangles.values()),
        [(entries[body.name], body.position, body.orientation) for body in wanted.colliders
         if body.name in entries]), wanted.frame)


def picture_of_node(arguments) -> int:
    """Draw the present state of a running node."""
    need_ros('view --node')
    from xpbd_ros.export.states import bodies_of
    from xpbd_ros.ros.cloth_client import ClothClient
    from xpbd_ros.study.picture import need_view
    from xpbd_ros.study.snapshots import instant_of

    need_view('--screenshot')
    client = ClothClient(arguments.node)
    try:
        scene = client.connect()
        client.wait_for_state(scene)
        entries = scene.sections.get('colliders', {})
        shown = instant_of(client.name, (
            (client.positions[cloth], client.triangles[cloth]) for cloth in scene.cloths), [
            (entries[body.name], body.position, body.orientation)
            for body in bodies_of(client.colliders) if body.name in entries])
    finally:
        client.close()
    return draw_instant(arguments, shown, client.count)


def draw_instant(arguments, shown, frame: int) -> int:
    """Draw one instant to the file of ``--screenshot``."""
    from xpbd_ros.study.picture import draw

    file = Path(arguments.screenshot).absolute()
    draw([shown], file, width_px=PICTURE_WIDTH)
    if arguments.json != '-':
        print(file)
    write_json(arguments.json, {'url': None, 'pictures': [file], 'frames': frame})
    return 0


def serve(arguments, url: str, run: Callable[[Callable[[], bool]], None]) -> None:
    """Tell the address, open a browser, and call ``run`` until a signal or ``--duration``."""
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
    with signals_set(ended), suppress(KeyboardInterrupt):
        run(ended.is_set)


@contextmanager
def signals_set(ended: threading.Event):
    """
    Set an event on the first SIGINT or SIGTERM: the present frame and the log are finished.

    A second one interrupts, such as a long compilation.
    """
    def stop(number, frame):
        if ended.is_set():
            raise KeyboardInterrupt
        ended.set()
    before = {each: signal.signal(each, stop) for each in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for each, handler in before.items():
            signal.signal(each, handler)


def recorder():
    """Return a function that opens a recorder; None if ROS messages are not installed."""
    try:
        need_ros('view')
    except InputError:
        return None
    return lambda scene, simulation: new_log(fresh_folder('view'), scene, simulation,
                                             program='view')
