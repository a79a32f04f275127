"""A signal reaches the program, wherever it comes up."""

from pathlib import Path
import re
import subprocess
import sys

import pytest

from support.node import child_environment

PROGRAM = """
import ctypes, signal, time
from xpbd_ros.ros.signals import interrupt_on_signals, exit_at_once_on_signals
interrupt_on_signals()
@ctypes.CFUNCTYPE(None)
def callback():
    signal.raise_signal(signal.{name})
    for _ in range(100):
        pass
with exit_at_once_on_signals():
    print('compiling')
    {early}
try:
    {late}
    print('went on')
except KeyboardInterrupt:
    print('interrupted')
signal.raise_signal(signal.SIGINT)
signal.raise_signal(signal.SIGTERM)
print('in peace')
"""
IMPORTING = """
import importlib, signal, sys
class Finder:
    def find_spec(name, path=None, target=None):
        if name == 'rclpy.lifecycle':
            signal.raise_signal(signal.SIGINT)
sys.meta_path.insert(0, Finder)
module, name = {script!r}.split(':')
sys.exit(getattr(importlib.import_module(module), name)())
"""


def run(name, early='pass', late='pass'):
    return subprocess.run(
        [sys.executable, '-c', PROGRAM.format(name=name, early=early, late=late)],
        env=child_environment(), capture_output=True, text=True, check=False)


@pytest.mark.parametrize('name', ['SIGINT', 'SIGTERM'])
def test_exit_at_once_on_signals_ends_within_a_callback(name):
    done = run(name, early='callback()')
    assert (done.returncode, done.stdout, done.stderr) == (0, 'compiling\n', '')


@pytest.mark.parametrize('name', ['SIGINT', 'SIGTERM'])
def test_the_first_signal_interrupts_and_no_other(name):
    done = run(name, late=f'signal.raise_signal(signal.{name})')
    assert done.stdout.split('\n') == ['compiling', 'interrupted', 'in peace', '']
    assert (done.returncode, done.stderr) == (0, '')


def test_a_signal_while_the_node_is_imported_ends_it_in_peace():
    setup = (Path(__file__).parents[2] / 'setup.py').read_text()
    script = re.search(r"'cloth_node = (\S+)'", setup)[1]
    done = subprocess.run([sys.executable, '-c', IMPORTING.format(script=script)],
                          env=child_environment(), capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, '', '')
