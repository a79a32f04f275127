"""Fixtures: nodes under test in other processes, and a peer node in this process."""

from collections.abc import Callable, Iterator
import json
import os
from pathlib import Path
import subprocess
import sys
import time

import pytest
import rclpy
from rclpy.context import Context
from visualization_msgs.msg import MarkerArray

from support.node import Cloth, NodeProcess, Peer, pose_stamped, targets, TOWEL
from support.replayed import Listener, PATIENCE


@pytest.fixture(scope='module')
def peer(context: Context) -> Iterator[Peer]:
    """Return a node in this process."""
    peer = Peer(context)
    yield peer
    peer.close()


@pytest.fixture(scope='module')
def towel(tmp_path_factory) -> Path:
    """Return the file of a small scene: a towel on a table, a ball."""
    file = tmp_path_factory.mktemp('scene') / 'towel.yaml'
    file.write_text(TOWEL)
    return file


@pytest.fixture(scope='module')
def start(tmp_path_factory, own_domain: None) -> Iterator[Callable[..., NodeProcess]]:
    """Return a function that starts a node; with the module it ends, and in good order."""
    started = []

    def start(*arguments: str, environment: dict | None = None, **parameters) -> NodeProcess:
        parameters = {name.replace('__', '.'): value for name, value in parameters.items()}
        started.append(NodeProcess(tmp_path_factory.mktemp('node'), *arguments,
                                   parameters=parameters, environment=environment))
        return started[-1]

    yield start
    for node in started:
        if node.process.poll() is None:
            try:
                assert node.end() == 0, node.lines
                assert not node.said('Traceback'), node.lines
            finally:
                node.kill()


@pytest.fixture(scope='module')
def lockstep(start, peer, towel) -> Cloth:
    """Return a node that steps the towel on request, by its own clock, and has been met."""
    cloth = Cloth(peer, start(scene=towel, mode='lockstep', publish_clock='true'))
    cloth.meet(pins=MarkerArray(), pin_targets=targets(), collider_states=targets(),
               colliders=MarkerArray(),
               collider__ball__pose=pose_stamped((0.0, 1.0, 0.15)))
    return cloth


@pytest.fixture
def listener(own_domain):
    rclpy.init()
    listener = Listener()
    yield listener
    listener.close()
    rclpy.shutdown()


@pytest.fixture
def replay(own_domain):
    """Return a function that starts a replay."""
    started = []

    def start(run, *flags) -> subprocess.Popen:
        started.append(subprocess.Popen(
            [sys.executable, '-m', 'xpbd_ros', 'replay', str(run), *map(str, flags)],
            env={**os.environ, 'PYTHONPATH': os.pathsep.join(filter(None, sys.path))},
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True))
        return started[-1]

    yield start
    for process in started:
        if process.poll() is None:
            process.kill()
        process.communicate()


@pytest.fixture
def ended(replay):
    """Return a function that replays to the end; it gives JSON, stderr and the time it took."""
    def run(run, *flags) -> tuple[dict, str, float]:
        start = time.monotonic()
        process = replay(run, '--json', '-', *flags)
        out, err = process.communicate(timeout=PATIENCE)
        assert process.returncode == 0, err
        return json.loads(out), err, time.monotonic() - start
    return run
