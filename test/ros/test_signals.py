"""A signal reaches the program, wherever it comes up."""

from pathlib import Path
import re
import subprocess
import sys

import pytest

from support.node import child_environment, PATIENCE

PROGRAM = """
import ctypes, signal, threading, time
from xpbd_ros.ros.signals import (
    exit_at_once_on_signals, handle_signals, ignore_signals, shut_down_on_signals)
handle_signals()
ended = threading.Event()
def end():
    print('ending')
    ended.set()
@ctypes.CFUNCTYPE(None)
def callback():
    signal.raise_signal(signal.{name})
    for _ in range(100):
        pass
if {begun}:
    shut_down_on_signals(end)
with exit_at_once_on_signals():
    print('compiling', flush=True)
    {early}
{late}
print('whole', ended.wait(10.0))
signal.raise_signal(signal.SIGINT)
signal.raise_signal(signal.SIGTERM)
time.sleep(0.2)
print('in peace')
ignore_signals()
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

SPINNING = """
import signal, sys
from rclpy.lifecycle import LifecycleNode
from xpbd_ros.ros.process import run
class Node(LifecycleNode):
    failed = False
    def __init__(self):
        super().__init__('spinning')
        self.create_timer(0.01, self.tick)
    def value(self, name):
        return False
    def tick(self):
        signal.raise_signal(signal.{name})
        for _ in range(100):
            pass
        print('whole')
    def close(self):
        signal.raise_signal(signal.{name})
        print('closed')
sys.exit(run(Node))
"""


def run(name, early='pass', late='pass', begun=True):
    return subprocess.run(
        [sys.executable, '-c', PROGRAM.format(name=name, early=early, late=late, begun=begun)],
        env=child_environment(), capture_output=True, text=True, check=False, timeout=PATIENCE)


@pytest.mark.parametrize('name', ['SIGINT', 'SIGTERM'])
def test_exit_at_once_on_signals_ends_within_a_callback(name):
    done = run(name, early='callback()')
    assert (done.returncode, done.stdout, done.stderr) == (0, 'compiling\n', '')


@pytest.mark.parametrize('begun', [False, True])
def test_it_ends_where_the_main_thread_runs_no_line_of_python(begun):
    """As while a compiler runs, which lasts for seconds."""
    stuck = ('import subprocess, sys; lock = ctypes.create_string_buffer(64); '
             'subprocess.Popen([sys.executable, "-c", "import os, signal, time; time.sleep(0.5); '
             'os.kill(os.getppid(), signal.SIGINT)"]); '
             '[ctypes.CDLL(None).pthread_mutex_lock(lock) for _ in range(2)]')
    done = run('SIGINT', early=stuck, begun=begun)
    assert (done.returncode, done.stdout, done.stderr) == (0, 'compiling\n', '')


@pytest.mark.parametrize('name', ['SIGINT', 'SIGTERM'])
def test_the_first_signal_shuts_down_and_no_other(name):
    done = run(name, late=f'signal.raise_signal(signal.{name})')
    words = done.stdout.splitlines()
    assert sorted(words) == sorted(['compiling', 'ending', 'whole True', 'in peace'])
    assert (done.returncode, done.stderr) == (0, '')


@pytest.mark.parametrize('name', ['SIGINT', 'SIGTERM'])
def test_a_signal_cuts_no_callback_short(name, own_domain):
    """rclpy turns an exception amid some of its functions into another one, as while it warns."""
    done = subprocess.run([sys.executable, '-c', SPINNING.format(name=name)],
                          env=child_environment(), capture_output=True, text=True, check=False,
                          timeout=PATIENCE)
    words = done.stdout.split()
    assert words[0] == 'whole'
    assert words[-1] == 'closed'
    assert (done.returncode, done.stderr) == (0, '')


def test_a_signal_while_the_node_is_imported_ends_it_in_peace():
    setup = (Path(__file__).parents[2] / 'setup.py').read_text()
    script = re.search(r"'cloth_node = (\S+)'", setup)[1]
    done = subprocess.run([sys.executable, '-c', IMPORTING.format(script=script)],
                          env=child_environment(), capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, '', '')
