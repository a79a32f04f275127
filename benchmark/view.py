"""
Cost of a page with a real browser, beside the physics.

    python benchmark/view.py                       20 s of the shipped towel: 41×57, contact, 60 Hz
    python benchmark/view.py --colour strain       with a coloured surface
    python benchmark/view.py --seconds 60 --json figures.json

Two processes: this one runs the page as ``xpbd_ros view`` does, and headless Chromium opens it. In
the last quarter of the run the browser is closed. At the end the same frames are computed once
more without a page; the state must have the same bits.

Times are processor times: of drawing in the simulation's thread, and of the threads of the web
server, while the browser is open. The share of a frame is their sum per picture times the pictures
of a page in real time (DRAWN_PER_SECOND), also where the machine is too busy for real time.
Pictures per second are large messages that the server's socket has sent.
"""

import argparse
from contextlib import contextmanager
import os
from pathlib import Path
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time

import numpy as np

from xpbd_ros.cli.output import add_json_argument, refuse_existing, STDOUT, write_json
from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import load_scene
from xpbd_ros.study.machine import describe, machine
from xpbd_ros.view.controls import COLOURS
from xpbd_ros.view.live import DRAWN_PER_SECOND, LiveView
from xpbd_ros.view.server import close_server, LOOPBACK, open_server, url_of

SCENE = 'towel'
WARM_UP = 3.0
"""from the browser's first picture to the first moment that counts [s]"""
PATIENCE = 300.0
"""longest wait for the kernels and the browser [s]"""
OPEN = 0.75
"""part of the run with a browser"""
PICTURE = 4096
"""size of a message above which it counts as a picture [bytes]"""
LOOP = 'loop'
"""name of the simulation's thread"""


def main() -> int:
    """Measure, and tell the figures."""
    arguments = _parser().parse_args()
    try:
        refuse_existing(arguments.json)
        found = measure(arguments)
        write_json(arguments.json, found)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    print(as_text(found), file=sys.stderr if arguments.json == STDOUT else sys.stdout)
    return 0


def measure(arguments) -> dict:
    """Run the page with a browser and then without one, and return the figures."""
    chromium = shutil.which('chromium') or shutil.which('chromium-browser')
    if chromium is None:
        raise InputError('Chromium is not installed (Debian, Ubuntu: apt install chromium)')
    here, sent = machine(), count_sent()
    ended, server = threading.Event(), open_server(LOOPBACK, 0)
    view = LiveView(server, arguments.scene, {}, [arguments.scene], None)
    loop = threading.Thread(target=view.run, args=(ended.is_set,), name=LOOP)
    loop.start()
    try:
        with browser(chromium, url_of(server)):
            wait(lambda: view.drawn > 0 and loop.is_alive(), 'a picture')
            view.stage.colour = arguments.colour
            time.sleep(WARM_UP)
            before = Reading(view, sent)
            time.sleep(OPEN * arguments.seconds)
            seen = Reading(view, sent) - before
        wait(lambda: not server.get_clients(), 'the end of the browser')
        before = Reading(view, sent)
        time.sleep((1.0 - OPEN) * arguments.seconds)
        unseen = Reading(view, sent) - before
    finally:
        ended.set()
        loop.join()
        close_server(server)
    drawing, serving = (seen[name] / max(1, seen['drawn']) for name in ('drawing_s', 'serving_s'))
    return {
        'cpu': describe(here), 'load': here['load'], 'scene': arguments.scene,
        'particles': len(view.frame.x), 'substeps': view.simulation.solver.substeps,
        'colour': arguments.colour, 'seconds': seen['wall_s'], 'frames': seen['frames'],
        'frames_per_s': seen['frames'] / seen['wall_s'],
        'pictures_per_s': seen['pictures'] / seen['wall_s'],
        'kB_per_picture': 1e-3 * seen['bytes'] / max(1, seen['pictures']),
        'step_ms': step_ms(view),
        'drawing_ms': 1e3 * drawing, 'serving_ms': 1e3 * serving,
        'share': (drawing + serving) * DRAWN_PER_SECOND,
        'drawn_without_browser': unseen['drawn'],
        'drawing_ms_without_browser': 1e3 * unseen['drawing_s'],
        'same_bits': view.simulation.hash() == hash_after(arguments.scene, view.frames)}


class Reading:
    """Counters of a page at one moment."""

    def __init__(self, view: LiveView, sent: dict[str, int]):
        self.values = {'wall_s': time.monotonic(), 'frames': view.frames, 'drawn': view.drawn,
                       'drawing_s': view.drawing_s, 'serving_s': serving_s(), **sent}

    def __sub__(self, other: 'Reading') -> dict:
        """Return the differences."""
        return {name: value - other.values[name] for name, value in self.values.items()}


def serving_s() -> float:
    """Return the processor time of all threads of Python but those of the simulation [s]."""
    total = 0.0
    for thread in threading.enumerate():
        if not thread.name.startswith((LOOP, 'MainThread', 'error_estimate')):
            stat = Path(f'/proc/self/task/{thread.native_id}/schedstat')
            total += 1e-9 * int(stat.read_text().split()[0])
    return total


def count_sent() -> dict[str, int]:
    """Count the large messages that the server sends from now on, and their bytes."""
    from websockets.asyncio.server import ServerConnection
    found, send = {'pictures': 0, 'bytes': 0}, ServerConnection.send

    async def counted(connection, message, *arguments, **options):
        await send(connection, message, *arguments, **options)
        if len(message) > PICTURE:
            found['pictures'] += 1
            found['bytes'] += len(message)
    ServerConnection.send = counted
    return found


@contextmanager
def browser(chromium: str, url: str):
    """Open a page in headless Chromium, which draws on the processor; close it at the end."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        process = subprocess.Popen(
            [chromium, '--headless=new', '--no-sandbox', '--remote-debugging-port=0',
             '--use-angle=swiftshader', '--enable-unsafe-swiftshader', '--no-first-run',
             '--disable-dev-shm-usage', '--window-size=1200,800', f'--user-data-dir={folder}',
             url], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
        try:
            yield
        finally:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def wait(true, what: str) -> None:
    """Wait until a function returns something true."""
    deadline = time.monotonic() + PATIENCE
    while not true():
        if time.monotonic() > deadline:
            raise InputError(f'waited in vain for {what}')
        time.sleep(0.05)


def step_ms(view: LiveView) -> float:
    """Return the median wall time of the latest steps [ms]."""
    return 1e3 * float(np.median([seconds for _, seconds in view.step_times]))


def hash_after(scene: str, frames: int) -> int:
    """Return the hash of the state after some frames without a page."""
    simulation = compile_scene(load_scene(scene))
    for _ in range(frames):
        simulation.step()
    return simulation.hash()


def as_text(found: dict) -> str:
    """Return the figures as lines."""
    return '\n'.join([
        f"{found['cpu']}; load {found['load']}",
        f"{found['scene']}: {found['particles']} particles, {found['substeps']} substeps, step "
        f"{found['step_ms']:.2f} ms, colour {found['colour']}",
        f"with a browser: {found['frames_per_s']:.1f} frames/s, {found['pictures_per_s']:.1f} "
        f"pictures/s of {found['kB_per_picture']:.0f} kB",
        f"processor time per picture: drawing {found['drawing_ms']:.2f} ms, serving "
        f"{found['serving_ms']:.2f} ms; of a frame {100.0 * found['share']:.1f} %",
        f"browser closed: {found['drawn_without_browser']} pictures in "
        f"{found['drawing_ms_without_browser']:.3f} ms; state "
        + ('as without a page' if found['same_bits'] else 'DIFFERS from that without a page')])


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--seconds', type=float, default=20.0, metavar='S')
    parser.add_argument('--scene', default=SCENE, help=f'{SCENE} unless given')
    parser.add_argument('--colour', choices=COLOURS, default='none',
                        help='quantity that colours the surface; none unless given')
    add_json_argument(parser)
    return parser


if __name__ == '__main__':
    sys.exit(main())
