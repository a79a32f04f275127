"""The hard cases of the node, as ``stress`` runs them."""

from importlib.util import find_spec
import json

import pytest

from xpbd_ros.cli.main import main

pytestmark = pytest.mark.skipif(
    find_spec('rclpy') is None, reason="rclpy is missing: source a ROS, or pip install '.[ros]'")


@pytest.mark.slow
@pytest.mark.parametrize('case', ['H20', 'H21', 'H23'])
def test_case_of_the_node(case, capsys):
    assert main(['stress', '--case', case, '--json', '-']) == 0
    numbers = json.loads(capsys.readouterr().out)
    assert numbers['passed'] == len(numbers['cases']) > 0
