"""An interrupt reaches the program, wherever the signal comes up."""

import subprocess
import sys

import pytest
from ros.rig import child_environment

PROGRAM = """
import ctypes, signal, sys, time
from xpbd_ros.ros.signals import interrupt_on_signals
{begin}
@ctypes.CFUNCTYPE(None)
def callback():
    signal.raise_signal(signal.{name})
    for _ in range(100):
        pass
try:
    callback()
    time.sleep(20.0)
    print('went on')
except KeyboardInterrupt:
    print('interrupted')
signal.raise_signal(signal.SIGINT)
signal.raise_signal(signal.SIGTERM)
print('in peace')
"""


def run(begin, name):
    return subprocess.run([sys.executable, '-c', PROGRAM.format(begin=begin, name=name)],
                          env=child_environment(), capture_output=True, text=True, check=False)


@pytest.mark.parametrize('name', ['SIGINT', 'SIGTERM'])
def test_a_signal_within_a_callback_is_not_lost(name):
    done = run('interrupt_on_signals()', name)
    assert done.stdout.split('\n') == ['interrupted', 'in peace', ''], done
    assert done.stderr == ''


def test_other_lost_exceptions_are_told():
    done = run("""interrupt_on_signals()
@ctypes.CFUNCTYPE(None)
def broken():
    raise ValueError('seven')
broken()""", 'SIGINT')
    assert 'ValueError: seven' in done.stderr
    assert done.stdout.startswith('interrupted')
