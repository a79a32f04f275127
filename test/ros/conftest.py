"""Fixtures: nodes under test in other processes, and a peer node in this process."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from rclpy.context import Context
from visualization_msgs.msg import MarkerArray

from support.node import Cloth, NodeProcess, Peer, pose_stamped, targets, TOWEL


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
