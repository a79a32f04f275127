"""Parameters: described, checked, applied between frames, and what a file of them does."""

from math import inf, nan

import numpy as np
import pytest
from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import ListParameters
from std_msgs.msg import String
import yaml

from support.node import Cloth, LATCHED
from xpbd_ros.cli.main import main
from xpbd_ros.ros.parameters import TABLE

HANGING = """
cloths:
  sheet:
    grid: {size: [0.2, 0.4], resolution: [2, 9]}
    pose: {position: [0, 0, 1], orientation: [-0.70710678118, 0, 0, 0.70710678118]}
    density: 0.25
    friction: 0.4
    static_friction: 0.6
    effects:
      stretch: {warp: 500.0, weft: 5.0}
pins: {top: {cloth: sheet, at: edge_0x}}
effects: {damping: {rate: 5.0}}
"""
"""a strip that hangs by its first row; nothing is said of the solver"""


@pytest.fixture
def cloth(lockstep):
    """Return the towel on its table, at the start; the test of another scene comes last."""
    assert lockstep.trigger('reset')[0]
    return lockstep


def names(cloth) -> list[str]:
    """Return all parameters but those that rclpy itself declares."""
    found = cloth.peer.ask(ListParameters, f'{cloth.name}/list_parameters').result.names
    return [name for name in found
            if not name.startswith('qos_overrides.') and name not in (
                'use_sim_time', 'start_type_description_service')]


def test_every_one_has_a_description_and_a_range(cloth):
    live = {'gravity', 'solver.substeps', 'solver.iterations', 'solver.compliance_scale',
            'cloths.towel.friction', 'cloths.towel.effects.stretch.warp',
            'cloths.towel.effects.stretch.weft', 'colliders.table.friction',
            'colliders.ball.friction', 'effects.contact.thickness', 'effects.damping.rate'}
    assert live | {row.name for row in TABLE} <= set(names(cloth))
    for about in cloth.describe(*names(cloth)):
        assert about.description, about.name
        assert about.type != ParameterType.PARAMETER_NOT_SET, about.name
        assert not about.dynamic_typing, about.name
        assert ('read when the node is configured' in about.additional_constraints) == (
            about.name in {row.name for row in TABLE if not row.live}), about.name
        ranged = about.floating_point_range or about.integer_range
        if about.name in live - {'gravity'}:
            assert ranged, about.name
        if about.name == 'solver.substeps':
            (span,) = about.integer_range
            assert (span.from_value, span.to_value) == (1, 10_000)
        if about.name == 'effects.contact.thickness':
            assert about.additional_constraints == 'must be > 0'
            assert about.description == 'distance kept between particles and surfaces [m]'


@pytest.mark.parametrize(('values', 'reason'), [
    ({'solver.substeps': 0}, 'solver.substeps out of range'),
    ({'solver.substeps': 10_001}, 'solver.substeps out of range'),
    ({'solver.substeps': 8.0}, "expected 'Type.INTEGER' got 'Type.DOUBLE'"),
    ({'cloths.towel.effects.stretch.warp': -1.0}, 'cloths.towel.effects.stretch.warp'),
    ({'cloths.towel.effects.stretch.warp': nan}, 'cloths.towel.effects.stretch.warp'),
    ({'cloths.towel.effects.stretch.warp': inf}, 'cloths.towel.effects.stretch.warp'),
    ({'effects.contact.thickness': 0.0}, 'effects.contact.thickness: must be > 0 m (got 0.0)'),
    ({'gravity': [0.0, 0.0]}, 'gravity: must be 3 numbers in m/s² (got 2)'),
    ({'gravity': [0.0, nan, 0.0]}, 'gravity[1]: must be finite m/s² (got nan)'),
    ({'gravity': -9.8}, "expected 'Type.DOUBLE_ARRAY' got 'Type.DOUBLE'"),
    ({'mode': 'slow'}, "mode: must be one of realtime, lockstep, fast (got 'slow')"),
    ({'publish_rate': 7.0}, 'publish_rate: must divide the frame rate of 60 Hz (got 7 Hz)'),
    ({'publish_rate': 120.0}, 'publish_rate: must divide the frame rate of 60 Hz (got 120 Hz)'),
    ({'publish_rate': nan}, 'publish_rate out of range'),
    ({'marker_rate': -1.0}, 'marker_rate out of range'),
    ({'scene': 'drape'},
     'scene: is read when the node is configured; call its cleanup transition first'),
    ({'frame_id': 'map'},
     'frame_id: is read when the node is configured; call its cleanup transition first'),
    ({'publish_clock': False}, 'publish_clock: is read when the node is configured'),
    ({'max_message_bytes': 5000}, 'max_message_bytes: is read when the node is configured'),
    ({'no_such': 1}, 'undeclared'),
    ({'solver.substeps': None}, 'Static parameter cannot be undeclared'),
    ({'solver.substeps': 12, 'solver.iterations': 0}, 'solver.iterations out of range'),
    ({'solver.substeps': 12, 'effects.contact.thickness': 0.0}, 'must be > 0 m'),
], ids=str)
def test_a_bad_value_is_refused_and_changes_nothing(cloth, values, reason):
    known = [name for name in values if name != 'no_such']
    before = cloth.get(*known)
    good, said = cloth.set(**values)
    assert not good
    assert reason in said
    assert cloth.get(*known) == before
    assert cloth.step(), 'goes on'
    assert not cloth.node.said('Traceback')


def test_substeps_change_live(cloth):
    assert cloth.set(solver__substeps=31) == (True, '')
    cloth.step()
    cloth.status(lambda status: status['substeps'] == '31')
    assert cloth.get('solver.substeps') == [31]
    assert cloth.set(solver__substeps=20) == (True, '')
    cloth.step()


def test_gravity_changes_live(cloth):
    assert cloth.set(gravity=[0.0, 0.0, 2.0]) == (True, '')
    assert cloth.cloud(cloth.step(30))[..., 2].min() > 0.1, 'it flies'
    assert cloth.set(gravity=[0.0, 0.0, -9.80665]) == (True, '')


def test_friction_changes_live(cloth):
    """On a slope that is not steep it stays; without friction it slides."""
    assert cloth.set(gravity=[2.0, 0.0, -9.80665]) == (True, '')
    start = cloth.cloud(cloth.step(5))
    stuck = cloth.cloud(cloth.step(30)) - start
    assert np.abs(stuck[..., 0]).max() < 1e-3
    assert cloth.set(colliders__table__friction=0.0) == (True, '')
    slid = cloth.cloud(cloth.step(30)) - start
    # from rest, damped at 2/s, for half a second
    assert slid[..., 0].mean() == pytest.approx(2.0 / 2.0 * (0.5 - (1 - np.exp(-1.0)) / 2.0),
                                                rel=0.05)
    assert cloth.set(colliders__table__friction=0.5, gravity=[0.0, 0.0, -9.80665]) == (True, '')


def test_the_mode_changes_live(cloth):
    frame = cloth.step()
    assert cloth.set(mode='fast') == (True, '')
    cloth.status(lambda status: int(status['frame']) > frame + 500)
    assert cloth.set(mode='lockstep') == (True, '')
    frame = cloth.step()
    assert cloth.step() == frame + 1


def test_a_file_of_them_overrides_the_scene_and_round_trips(cloth, start, towel, tmp_path):
    """What ``ros2 param dump`` writes makes the same node again."""
    mine = {'scene': str(towel), 'mode': 'lockstep', 'gravity': [0.0, 0.0, -3.0],
            'solver.substeps': 13, 'colliders.table.friction': 0.25, 'marker_rate': 5.0}
    file = tmp_path / 'mine.yaml'
    file.write_text(yaml.safe_dump({'/**': {'ros__parameters': mine}}))
    first = Cloth(cloth.peer, start('--params-file', str(file), '-r', '__node:=first'), '/first')
    assert first.trigger('step')[0]
    assert first.get(*mine) == list(mine.values())
    first.status(lambda status: status['substeps'] == '13')
    assert first.set(solver__substeps=17, publish_rate=30.0) == (True, '')
    assert first.trigger('step')[0]
    everything = names(first)
    values = dict(zip(everything, map(plain, first.get(*everything))))
    assert values['solver.substeps'] == 17
    file.write_text(yaml.safe_dump({'/robot/second': {'ros__parameters': values}}))
    second = Cloth(cloth.peer, start('--params-file', str(file), '-r', '__node:=second', '-r',
                                     '__ns:=/robot'), '/robot/second')
    assert second.trigger('step')[0]
    assert dict(zip(everything, map(plain, second.get(*everything)))) == values
    second.status(lambda status: status['substeps'] == '17')
    assert second.set(**values) == (True, ''), 'as ros2 param load sets them'


def plain(value):
    """Return a parameter's value as YAML has it."""
    return value if isinstance(value, bool | int | float | str) else list(value)


def test_stiffness_changes_live_and_auto_follows(lockstep, tmp_path):
    """The strip stretches by its weight; what ``auto`` makes of it is what the parameter says."""
    file = tmp_path / 'hanging.yaml'
    file.write_text(HANGING)
    lockstep.restart(scene=str(file))
    lockstep.meet()

    def length() -> float:
        cloud = lockstep.cloud(lockstep.step(300))
        return float(np.abs(cloud[-1, 0, 2] - cloud[0, 0, 2]))
    good, run = lockstep.record(True)
    assert good, run
    substeps = lockstep.get('solver.substeps')[0]
    soft = length()
    key = 'cloths.sheet.effects.stretch.weft'
    assert lockstep.get(key) == [5.0]
    assert lockstep.set(**{key: 2000.0}) == (True, '')
    stiff = length()
    weight = 0.25 * 0.08 * 9.80665
    assert soft - 0.4 == pytest.approx(weight * 0.4 / (2.0 * 5.0 * 0.2), rel=0.2)
    assert 0.0 < stiff - 0.4 < (soft - 0.4) / 20.0
    assert lockstep.get('solver.substeps')[0] > substeps
    now = str(lockstep.get('solver.substeps')[0])
    lockstep.status(lambda status: status['substeps'] == now)
    assert lockstep.record(False) == (True, run)
    assert main(['resim', run]) == 0, 'which does not choose again'


def test_keys_that_bound_one_another_change_together_or_in_turn(lockstep, tmp_path):
    """Accepted values take effect in any order, also while earlier ones are pending."""
    file = tmp_path / 'hanging.yaml'
    file.write_text(HANGING)
    lockstep.restart(scene=str(file))
    lockstep.meet()
    scenes = lockstep.peer.hear(String, '/cloth/scene', LATCHED)
    sliding, sticking = keys = 'cloths.sheet.friction', 'cloths.sheet.static_friction'
    assert lockstep.set(**{sliding: 0.8, sticking: 0.9}) == (True, ''), 'the first alone is above'
    good, reason = lockstep.set(**{sticking: 0.7})
    assert not good and 'must be at least friction (0.8)' in reason, 'which waits for the frame'
    assert lockstep.set(**{sliding: 0.2}) == lockstep.set(**{sticking: 0.3}) == (True, '')
    lockstep.step()
    lockstep.peer.until(lambda: scenes and 'static_friction: 0.3' in scenes[-1].data, 'the scene')
    assert lockstep.get(*keys) == [0.2, 0.3]
    assert lockstep.set(gravity=[0.0, 0.0, -3.0]) == (True, '')
    lockstep.step()
    lockstep.peer.until(lambda: '-3.0' in scenes[-1].data, 'the scene')
    assert yaml.safe_load(scenes[-1].data)['cloths']['sheet']['friction'] == 0.2, 'still'
    lockstep.status(lambda status: status['rejected_inputs'] == '0')
