"""A headless Chromium, driven through the DevTools protocol: real pages, a real pointer."""

import base64
from contextlib import contextmanager, suppress
from io import BytesIO
from itertools import count
import json
import os
from pathlib import Path
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from urllib.request import urlopen

from matplotlib.image import imread
import numpy as np

CHROMIUM = shutil.which('chromium') or shutil.which('chromium-browser')
MISSING = 'Chromium is not installed (Debian, Ubuntu: apt install chromium)'
PATIENCE = 60.0
"""[s]; only a failure takes that long"""
WIDTH, HEIGHT = 1200, 800
OPTIONS = ('[...document.querySelectorAll("[role=option]")].filter('
           'each => each.checkVisibility())')
"""options of the open menu, in JavaScript"""


def start_view(*words) -> subprocess.Popen:
    """Start ``xpbd_ros view`` in a process of its own."""
    environment = {**os.environ, 'PYTHONPATH': os.pathsep.join(filter(None, sys.path))}
    return subprocess.Popen(
        [sys.executable, '-m', 'xpbd_ros', 'view', *map(str, words), '--port', '0',
         '--no-browser'], env=environment, text=True, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE)


def address(view: subprocess.Popen) -> str:
    """Return the address that ``view`` prints."""
    for line in view.stdout:
        if line.startswith('http'):
            return line.split()[0]
    raise AssertionError(view.stderr.read())


@contextmanager
def viewed(*words):
    """Yield a browser with the page of ``view`` once it shows figures; then end both in order."""
    view, browser = start_view(*words), Browser()
    try:
        browser.open(address(view))
        browser.until(lambda: 'real time' in browser.text(), 'the figures')
        yield browser
    finally:
        browser.close()
        view.send_signal(signal.SIGINT)
        _, said = view.communicate()
    assert (view.returncode, said) == (0, '')


class Browser:
    """One page in a browser of its own."""

    def __init__(self):
        from websockets.sync.client import connect

        self._folder = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        self._process = subprocess.Popen(
            [CHROMIUM, '--headless=new', '--no-sandbox', '--remote-debugging-port=0',
             '--use-angle=swiftshader', '--enable-unsafe-swiftshader', '--no-first-run',
             '--disable-dev-shm-usage', f'--window-size={WIDTH},{HEIGHT}',
             f'--user-data-dir={self._folder.name}', 'about:blank'],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
        port = self._port()
        with urlopen(f'http://127.0.0.1:{port}/json') as answer:
            page = next(each for each in json.load(answer) if each['type'] == 'page')
        self._socket = connect(page['webSocketDebuggerUrl'], max_size=2**27)
        self._numbers = count(1)
        self.errors: list[str] = []
        """exceptions, and messages of the level error, of the page's console"""
        for domain in ('Runtime', 'Log', 'Page'):
            self.call(f'{domain}.enable')

    def _port(self) -> int:
        file = Path(self._folder.name) / 'DevToolsActivePort'
        deadline = time.monotonic() + PATIENCE
        while not file.exists() or not file.read_text():
            assert self._process.poll() is None, 'Chromium ended'
            assert time.monotonic() < deadline, 'Chromium opened no port'
            time.sleep(0.05)
        return int(file.read_text().splitlines()[0])

    def call(self, method: str, **parameters) -> dict:
        """Call a method of the protocol, and return its result."""
        number = next(self._numbers)
        self._socket.send(json.dumps({'id': number, 'method': method, 'params': parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=PATIENCE))
            if message.get('id') == number:
                assert 'error' not in message, message['error']
                return message['result']
            self._note(message)

    def _note(self, message: dict) -> None:
        about = message.get('params', {})
        if message.get('method') == 'Runtime.exceptionThrown':
            details = about['exceptionDetails']
            self.errors.append(details.get('exception', details).get('description', str(details)))
        elif message.get('method') == 'Runtime.consoleAPICalled' and about['type'] == 'error':
            self.errors.append(' '.join(str(each.get('value', each.get('description')))
                                        for each in about['args']))
        elif message.get('method') == 'Log.entryAdded' and about['entry']['level'] == 'error':
            self.errors.append(about['entry']['text'])

    def open(self, url: str) -> None:
        """Open a page, and wait until it is loaded."""
        self.call('Page.navigate', url=url)
        self.until(lambda: self.value('document.readyState') == 'complete', url)
        time.sleep(0.5)    # a page of another origin runs in another process, which takes over

    def value(self, expression: str):
        """Return the value of a JavaScript expression."""
        return self.call('Runtime.evaluate', expression=expression,
                         returnByValue=True)['result'].get('value')

    def until(self, true, what: str) -> None:
        """Wait until a function returns something true."""
        deadline = time.monotonic() + PATIENCE
        while not true():
            assert time.monotonic() < deadline, f'waited in vain for {what}'
            time.sleep(0.1)

    def text(self) -> str:
        """Return the text of the page."""
        return self.value('document.body ? document.body.innerText : ""') or ''

    def picture(self) -> np.ndarray:
        """Return what the page looks like; sRGB from 0 to 1, shape (height, width, 3)."""
        data = self.call('Page.captureScreenshot', format='png')['data']
        return imread(BytesIO(base64.b64decode(data)))[..., :3]

    def press(self, label: str) -> None:
        """Click the button with a label."""
        self._click(self._button(label), f'the button {label}')

    def unfold(self, label: str) -> None:
        """Click the innermost element with a text."""
        self._click('[...document.querySelectorAll("p, div, span")].filter(each => '
                    f'each.textContent.trim() === {json.dumps(label)}).at(-1)', label)

    def _click(self, element: str, what: str) -> None:
        """Click the middle of an element, given as a JavaScript expression."""
        self.until(lambda: self.value(f'!!{element}'), what)
        self.value(f'{element}.scrollIntoView({{block: "nearest"}})')
        seen: list[str] = []

        def rests() -> bool:
            seen.append(self.value(f'JSON.stringify({element}.getBoundingClientRect())'))
            return len(seen) > 1 and seen[-1] == seen[-2]
        self.until(rests, f'the end of scrolling to {what}')
        box = json.loads(seen[-1])
        self.click(box['x'] + 0.5 * box['width'], box['y'] + 0.5 * box['height'])

    def _button(self, label: str) -> str:
        return ('[...document.querySelectorAll("button")].find('
                f'each => each.innerText.trim() === {json.dumps(label)})')

    @staticmethod
    def box(label: str) -> str:
        """Return a JavaScript expression for the input box behind a label."""
        return ('(() => { let at = [...document.querySelectorAll("label")].find(each => '
                f'each.textContent.trim() === {json.dumps(label)} && each.checkVisibility()); '
                'while (at && !at.querySelector("input")) at = at.parentElement; '
                'return at && at.querySelector("input"); })()')

    def type_into(self, label: str, text: str) -> None:
        """Replace the text in the input box behind a label."""
        def has_focus() -> bool:
            self._click(self.box(label), f'the box {label}')
            time.sleep(0.3)
            return self.value(f'document.activeElement === {self.box(label)}')
        self.until(has_focus, f'the focus on {label}')
        self._key('a', modifiers=2, commands=['selectAll'])
        self.call('Input.insertText', text=text)
        self._key('Enter', windowsVirtualKeyCode=13)

    def choose(self, label: str, option: str) -> None:
        """Choose an option of the menu behind a label."""
        assert option in self.options(label)
        self._click(f'{OPTIONS}.find(each => each.textContent.trim() === {json.dumps(option)})',
                    option)

    def options(self, label: str) -> list[str]:
        """Open the menu behind a label, and return its options."""
        found: list[str] = []

        def is_open() -> bool:
            self._click(self.box(label), f'the menu {label}')
            time.sleep(0.5)
            found[:] = self.value(f'{OPTIONS}.map(each => each.textContent.trim())')
            return bool(found)
        self.until(is_open, f'the options of {label}')
        return found

    def _key(self, key: str, **about) -> None:
        for kind in ('keyDown', 'keyUp'):
            self.call('Input.dispatchKeyEvent', type=kind, key=key, code=key, **about)

    def click(self, x: float, y: float) -> None:
        """Click at a place [pixels]."""
        self.drag((x, y))

    def drag(self, *places) -> None:
        """Press the pointer at the first place [pixels], move it over the others, release it."""
        self._mouse('mouseMoved', places[0], button='none', buttons=0)
        time.sleep(0.2)    # the page finds out what is below the pointer
        self._mouse('mousePressed', places[0], button='left', buttons=1, clickCount=1)
        for place in places[1:]:
            self._mouse('mouseMoved', place, button='left', buttons=1)
            time.sleep(0.05)
        self._mouse('mouseReleased', places[-1], button='left', buttons=0, clickCount=1)

    def _mouse(self, kind: str, place, **about) -> None:
        self.call('Input.dispatchMouseEvent', type=kind, x=place[0], y=place[1], **about)

    def freeze(self) -> None:
        """Stop all processes of the browser; it can only be closed from then on."""
        os.killpg(self._process.pid, signal.SIGSTOP)

    def close(self) -> None:
        """End the browser."""
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._socket.close_timeout = 1.0
        self._socket.close()
        self._process.wait()
        self._folder.cleanup()
