"""Fixtures of all tests: a private DDS domain, meshio, a small log."""

from collections.abc import Callable, Iterator
import os
from pathlib import Path
import random
import socket

import pytest

os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')    # before numpy is there, as in cli.main
from support.logs import sample_log
from xpbd_ros.demo.domain import loopback


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Refuse tests that are marked both smoke and slow: ``-m smoke`` would run them."""
    both = [item.nodeid for item in items
            if item.get_closest_marker('smoke') and item.get_closest_marker('slow')]
    if both:
        raise pytest.UsageError(f'smoke and slow: {", ".join(both)}')


@pytest.fixture(scope='session')
def domain_id() -> Iterator[int]:
    """Return a DDS domain that is free on this machine, and reserve it for this test run."""
    domains = list(range(1, 101))
    random.shuffle(domains)
    for domain in domains:
        lock = reserve(domain)
        if lock:
            with lock:
                yield domain
            return
    pytest.fail('no free DDS domain between 1 and 100')


@pytest.fixture(scope='session', autouse=True)
def own_domain(domain_id: int) -> Iterator[None]:
    """Keep every node of the tests, in this process or another, on loopback and this domain."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv('ROS_DOMAIN_ID', str(domain_id))
        for name, value in loopback().items():
            patch.setenv(name, value)
        patch.delenv('ROS_LOCALHOST_ONLY', raising=False)
        patch.delenv('ROS_STATIC_PEERS', raising=False)
        yield


@pytest.fixture(scope='module')
def context(own_domain: None):
    """Return a ROS context that is not the default one, which other tests use."""
    rclpy = pytest.importorskip('rclpy',
                                reason="rclpy is missing: source a ROS, or pip install '.[ros]'")
    context = rclpy.Context()
    rclpy.init(context=context)
    yield context
    context.try_shutdown()


def reserve(domain: int) -> socket.socket | None:
    """Return a socket that keeps a domain for this test run; None if its ports are in use."""
    first = 7400 + 250 * domain    # discovery; the first participant's own ports follow at + 10
    try:
        for port, host in ((first, '0.0.0.0'), (first + 10, '0.0.0.0'), (first + 10, '127.0.0.1')):
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
                probe.bind((host, port))
        lock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        lock.bind(('127.0.0.1', first + 248))    # of a participant that no test gets to
        return lock
    except OSError:
        return None


@pytest.fixture
def meshio():
    """Return the library that reads meshes other than OBJ; ``[test]`` brings it, a ROS may not."""
    return pytest.importorskip('meshio', reason="meshio is missing: pip install '.[mesh]'")


@pytest.fixture
def pyvista():
    """Return the library that draws pictures of runs; ``[view]`` brings it."""
    library = pytest.importorskip('pyvista', reason="pyvista is missing: pip install '.[view]'")
    from xpbd_ros.errors import InputError
    from xpbd_ros.study.picture import need_view
    try:
        need_view()
    except InputError as error:
        pytest.skip(str(error))
    return library


@pytest.fixture
def write_log(tmp_path: Path) -> Callable[..., Path]:
    """Return a function that writes a log of some frames and returns its folder."""
    return lambda name='run', **options: sample_log(tmp_path / name, **options)
