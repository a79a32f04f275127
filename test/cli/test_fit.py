"""``fit``: values come back from recordings with noise and gaps, or are told not to be known."""

import json
from pathlib import Path

import numpy as np
import pytest
from rclpy.serialization import serialize_message

from support.logs import COMMANDS, recorded, SHEET
from support.scenes import DOWN
from xpbd_ros import load
from xpbd_ros.cli.fit import lines, unit_of
from xpbd_ros.cli.main import main
from xpbd_ros.fit import picture, solve
from xpbd_ros.fit.solve import Fit, Value
from xpbd_ros.fit.surface import to_points
from xpbd_ros.log.qos import Qos
from xpbd_ros.log.writer import LogWriter
from xpbd_ros.ros.clouds import cloud_of
from xpbd_ros.scene.load import scene_from_text

NOISE = 0.002
"""standard deviation of each coordinate [m]"""
MISSING = 1.0 / 3.0
STRETCH = """
duration: 0.8
solver: {method: gauss_seidel, integrator: backward_euler, substeps: 12, iterations: 2}
cloths:
  c:
    grid: {size: [0.5, 0.3], resolution: [9, 6]}
    pose: {orientation: [0.0, 0.5, 0.0, 0.8660254]}
    density: 0.3
    effects:
      stretch: {warp: 60.0, weft: 150.0}
      shear: {stiffness: 10.0}
      bend: {stiffness: 2.0e-4}
pins:
  top: {cloth: c, at: edge_x0}
effects: {damping: {rate: 1.0}, contact: {thickness: 0.003}, friction: {}}
"""
"""a strip that is held by its upper edge, and falls"""
BEND = """
duration: 0.5
solver: {method: gauss_seidel, integrator: backward_euler, substeps: 12, iterations: 2}
cloths:
  c:
    grid: {size: [0.3, 0.16], resolution: [13, 7]}
    density: 0.2
    effects:
      stretch: {warp: 300.0, weft: 300.0}
      shear: {stiffness: 20.0}
      bend: {stiffness: 4.0e-3}
pins:
  end: {cloth: c, at: [0, 1, 13, 14, 26, 27, 39, 40, 52, 53, 65, 66, 78, 79]}
effects: {damping: {rate: 1.0}, contact: {thickness: 0.003}, friction: {}}
"""
"""a strip that is clamped at its end, and sags"""
FRICTION = """
duration: 0.5
solver: {method: gauss_seidel, integrator: backward_euler, substeps: 12, iterations: 2}
gravity: [4.9, 0.0, -8.5]
cloths:
  c:
    grid: {size: [0.2, 0.21], resolution: [6, 6]}
    pose: {position: [0.0, 0.0, 0.003]}
    density: 0.3
    friction: 0.3
    effects:
      stretch: {warp: 300.0, weft: 300.0}
      shear: {stiffness: 20.0}
      bend: {stiffness: 1.0e-3}
colliders:
  table: {plane: {normal: [0, 0, 1]}, friction: 0.3}
effects: {damping: {rate: 0.1}, contact: {thickness: 0.003}, friction: {}, pin: {}}
"""
"""a cloth that slides down a slope of 30°"""
KEYS = {'stretch': (STRETCH, 'cloths.c.effects.stretch.warp', 60.0),
        'bend': (BEND, 'cloths.c.effects.bend.stiffness', 4e-3),
        'friction': (FRICTION, 'cloths.c.friction', 0.3)}


def record(scene: str, folder: Path, *, organised: bool = True, seed: int = 1,
           late_s: float = 0.0, **keys) -> Path:
    """Write the clouds that a camera might see of a scene, and return the scene's file."""
    folder.mkdir()
    (folder / 'scene.yaml').write_text(scene)
    simulation, noise = load(folder / 'scene.yaml', **keys), np.random.default_rng(seed)
    frames = round(60.0 * float(scene.split('duration: ')[1].split()[0]))
    triangles = simulation.cloths[0].mesh.triangles
    with LogWriter(folder / 'log', scene=None, settings={}, flush_period=3600.0) as log:
        log.add_channel('/camera/points', 'sensor_msgs/msg/PointCloud2', Qos(depth=5))
        frame = simulation.frame()
        for index in range(frames + 1):
            frame = simulation.step() if index else frame
            if organised:
                points = frame.x + noise.normal(0.0, NOISE, frame.x.shape)
                points[noise.random(len(points)) < MISSING] = np.nan
            else:
                weights = noise.dirichlet(np.ones(3), 3 * len(frame.x))
                corners = frame.x[triangles[noise.integers(len(triangles), size=len(weights))]]
                points = (weights[:, :, None] * corners).sum(1)
                points += noise.normal(0.0, NOISE, points.shape)
                points = points[noise.random(len(points)) > MISSING]
            time_ns = 10**18 + simulation.time_ns(index)
            stamp_ns = time_ns - round(1e9 * late_s)
            log.write('/camera/points', serialize_message(cloud_of(
                points.ravel(), 'world', stamp_ns)), time_ns=time_ns, frame=index)
    return folder / 'scene.yaml'


def fit(scene: Path, *words, code: int = 0, capsys) -> dict:
    """Return the numbers of a fit to the log beside a scene."""
    assert main(['fit', str(scene), '--log', str(scene.parent / 'log'), '--json', '-', '-o',
                 str(scene.parent / 'out'), *map(str, words)]) == code
    return json.loads(capsys.readouterr().out)


@pytest.mark.parametrize('what', KEYS)
def test_a_value_comes_back_within_a_tenth(what, tmp_path, capsys):
    """From another start, and from a recording with twice the substeps."""
    text, key, expected = KEYS[what]
    scene = record(text, tmp_path / what, **{'solver.substeps': 24})
    found = fit(scene, '--vary', key, '--set', f'{key}={3.0 * expected}', capsys=capsys)
    value = found['values'][key]
    assert value['determined'], value['why_not']
    assert value['value'] == pytest.approx(expected, rel=0.1)
    assert value['low'] < value['value'] < value['high'] < 1.2 * value['low']
    assert value['unit'] == {'stretch': 'N/m', 'bend': 'N m', 'friction': ''}[what]
    assert found['organised']
    assert found['residual_m'] == pytest.approx(NOISE, rel=0.1)
    assert Path(found['pictures'][0]).stat().st_size > 10_000


@pytest.mark.slow
@pytest.mark.parametrize('organised', [True, False])
@pytest.mark.parametrize('seed', [2, 3, 4])
@pytest.mark.parametrize('what', KEYS)
def test_a_value_comes_back_whatever_the_noise(what, seed, organised, tmp_path, capsys):
    """A falling strip has local minima, out of which the profiles lead."""
    text, key, expected = KEYS[what]
    scene = record(text, tmp_path / what, seed=seed, organised=organised)
    found = fit(scene, '--vary', key, '--set', f'{key}={2.0 * expected}', capsys=capsys)
    value = found['values'][key]
    assert value['value'] == pytest.approx(expected, rel=0.1)
    assert value['low'] / 1.02 < expected < 1.02 * value['high']


@pytest.mark.slow
def test_two_values_come_back_from_one_recording(tmp_path, capsys):
    scene = record(STRETCH, tmp_path / 'stretch')
    keys = {f'cloths.c.effects.{name}': expected for name, expected in (
        ('stretch.warp', 60.0), ('bend.stiffness', 2e-4))}
    found = fit(scene, *(word for key in keys for word in ('--vary', key)),
                *(word for key, value in keys.items()
                  for word in ('--set', f'{key}={0.4 * value}')), capsys=capsys)
    for key, expected in keys.items():
        assert found['values'][key]['value'] == pytest.approx(expected, rel=0.1)


def test_a_value_comes_back_from_points_anywhere_on_the_cloth(tmp_path, capsys):
    """Points beyond the outline bias it, since the closest point of the cloth is on its edge."""
    scene = record(BEND, tmp_path / 'bend', organised=False)
    key = KEYS['bend'][1]
    found = fit(scene, '--vary', key, '--set', f'{key}=1e-2', capsys=capsys)
    assert not found['organised']
    assert found['values'][key]['value'] == pytest.approx(4e-3, rel=0.1)
    assert found['residual_m'] == pytest.approx(NOISE, rel=0.15)


@pytest.mark.parametrize('unit, said', [('N m', '0.004 N m, 95 %: 0.0039 to 0.0041 N m'),
                                        ('', '0.004, 95 %: 0.0039 to 0.0041')])
def test_a_value_is_printed_with_its_unit(unit, said):
    value = {'value': 4e-3, 'low': 3.9e-3, 'high': 4.1e-3, 'unit': unit, 'determined': True}
    first, *_ = lines({
        'values': {'k': value}, 'residual_m': 0.0, 'points': 1, 'clouds': 1, 'organised': True,
        'solver': {'method': 'line', 'integrator': 'bdf2', 'substeps': 1, 'iterations': 1},
        'runs': 1, 'pictures': ['p']})
    assert first == f'k  {said}'


def test_the_picture_has_the_unit_of_each_value(tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(picture, 'save', lambda figure, _: seen.extend(
        axis.get_xlabel() for axis in figure.axes))
    value = Value(0.01, 0.009, 0.011, True, '', ((0.005, 0.002), (0.01, 0.001)))
    picture.draw(Fit({'b': value, 'f': value}, 0.001, 9), tmp_path, {'b': 'N m', 'f': ''})
    assert seen == ['value [N m]', 'value']


def test_labels_of_values_do_not_overlap(tmp_path, monkeypatch):
    """Over less than a decade a logarithmic axis has a label at each tick, such as 1.4 × 10⁻¹."""
    seen = []

    def looked_at(figure, _):
        figure.canvas.draw()
        for axis in figure.axes:
            ticks = [*axis.get_xticklabels(), *axis.get_xticklabels(minor=True)]
            boxes = sorted((tick.get_window_extent() for tick in ticks if tick.get_text()),
                           key=lambda box: box.x0)
            seen.append(len(boxes))
            assert all(a.x1 < b.x0 for a, b in zip(boxes, boxes[1:])), ticks
    monkeypatch.setattr(picture, 'save', looked_at)
    found = {key: Value(low, low, low, False, '', ((low, 0.002), (high, 0.001)))
             for key, low, high in (('a', 0.1, 0.15), ('b', 1e-6, 1e-4), ('c', 0.1, 1.2))}
    picture.draw(Fit(found, 0.001, 9), tmp_path, dict.fromkeys(found, ''))
    assert min(seen) >= 2


def test_units_of_keys_also_of_those_that_are_not_live():
    scene = scene_from_text(FRICTION + 'pins: {p: {cloth: c, at: corner_00}}',
                            where='here', name='here')
    assert {key: unit_of(scene, key) for key in (
        'cloths.c.density', 'cloths.c.friction', 'cloths.c.effects.stretch.warp',
        'pins.p.compliance', 'effects.damping.rate', 'pins.p.none')} == {
            'cloths.c.density': 'kg/m²', 'cloths.c.friction': '',
            'cloths.c.effects.stretch.warp': 'N/m', 'pins.p.compliance': 'm/N',
            'effects.damping.rate': '1/s', 'pins.p.none': ''}


def test_a_value_that_the_motion_does_not_depend_on_is_not_determined(tmp_path, capsys):
    """A sheet that hangs straight does not bend."""
    scene = record(STRETCH, tmp_path / 'straight', **{'cloths.c.pose.orientation': DOWN})
    found = fit(scene, '--vary', 'cloths.c.effects.bend.stiffness', '--vary',
                'cloths.c.effects.stretch.warp=20:200', '--set',
                f'cloths.c.pose.orientation={DOWN}', code=1, capsys=capsys)
    bend = found['values']['cloths.c.effects.bend.stiffness']
    assert not bend['determined']
    assert bend['why_not'] == 'the residual is flat: this motion does not depend on it'
    stretch = found['values']['cloths.c.effects.stretch.warp']
    assert stretch['determined']
    assert stretch['value'] == pytest.approx(60.0, rel=0.1)


def test_a_value_without_any_effect_is_not_determined(tmp_path, capsys):
    """The friction of a cloth that touches nothing: all derivatives are exactly 0."""
    key = 'cloths.c.friction'
    found = fit(record(STRETCH, tmp_path / 'free'), '--vary', key, code=1, capsys=capsys)
    assert found['values'][key]['why_not'] == (
        'the residual is flat: this motion does not depend on it')


class Straight:
    """A model whose residuals are lines over the logarithm of the value, 0.2, and noise."""

    numbers = 50

    def __init__(self, slope: float):
        self.slope = slope

    def residuals(self, values):
        noise = 1e-3 * np.random.default_rng(1).standard_normal(self.numbers)
        return noise + self.slope * np.log(values['c'] / 0.2)


@pytest.mark.parametrize('slope, low, high, why_not', [
    (0.05, 0.002, 20.0, ''),
    (0.05, 0.15, 0.25, ''),
    (0.05, 0.1, 0.15, 'at the end of its range'),
    (0.05, 0.3, 0.4, 'at the end of its range'),
    (0.0, 0.002, 20.0, 'the residual is flat: this motion does not depend on it'),
    (0.0, 0.15, 0.25, 'the residual is flat: this motion does not depend on it')])
def test_a_value_is_determined_in_a_narrow_range_too(slope, low, high, why_not):
    found = solve.fit(Straight(slope), [solve.Key('c', low, low, high)]).values['c']
    assert (found.determined, found.why_not) == (not why_not, why_not)
    if found.determined:
        assert found.value == pytest.approx(0.2, rel=0.01)
        assert found.low < 0.2 < found.high


def test_a_log_of_this_package_brings_its_inputs(tmp_path, capsys):
    """Its clouds are float32 without noise, and its grasp and its change of gravity act again."""
    (tmp_path / 'sheet.yaml').write_text(SHEET)
    recorded(tmp_path / 'sheet.yaml', tmp_path / 'log', {2: COMMANDS[2][:2], **{
        frame: COMMANDS[frame] for frame in (5, 9)}})
    found = fit(tmp_path / 'sheet.yaml', '--vary', 'cloths.sheet.effects.stretch.warp', '--set',
                'cloths.sheet.effects.stretch.warp=200', capsys=capsys)
    value = found['values']['cloths.sheet.effects.stretch.warp']
    assert value['value'] == pytest.approx(300.0, rel=1e-3)
    assert found['residual_m'] < 1e-6


def test_points_near_a_surface_are_measured_to_the_closest_point():
    x = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    points = np.array([[0.7, 0.2, 0.3], [0.2, 0.7, -0.1], [1.5, 0.5, 0.0], [-3.0, -4.0, 2.0]])
    assert to_points(x, triangles, points) == pytest.approx(
        np.array([[0, 0, 0.3], [0, 0, -0.1], [0.5, 0, 0], [-3, -4, 2]]))


@pytest.mark.parametrize('words, said', [
    (('--vary', 'cloths.c.effects.strech.warp'), "unknown effect; did you mean 'stretch'?"),
    (('--vary', 'cloths.c.friction=1:0'), 'LOW must be > 0 and less than HIGH'),
    (('--vary', 'cloths.c.friction', '--set', 'cloths.c.friction=0'), 'give --vary cloths.c.fr'),
    (('--vary', 'cloths.c.friction', '--cloud', '/nothing'), 'known: /camera/points'),
    (('--vary', 'cloths.c.friction', '--set', 'frame_id=map'), "in the TF frame 'world'"),
    (('--vary', 'cloths.c.friction', '--start', '9'), 'holds no cloud after its start'),
    (('--vary', 'cloths.c.friction', '--start', '-5'), '--start: must be >= 0 s, the start of'),
    (('--vary', 'cloths.c.friction', '--start', 'nan'), 'recording (got nan s)'),
    (('--vary', 'cloths.c.friction', '--duration', '0'),
     '--duration: must be at least a frame (0.0167 s; got 0 s); leave it out'),
    (('--vary', 'solver.method'), 'is not a number in the scene'),
    (('--vary', 'cloths.c.friction', '--set', 'cloths.c.grid.resolution=[5, 1]'),
     "36 points are not the 5 particles of 'c', which has no triangles"),
])
def test_bad_input_is_refused_in_one_line(words, said, tmp_path, capsys):
    scene = record(FRICTION.replace('0.5\n', '0.05\n', 1), tmp_path / 'slope')
    assert main(['fit', str(scene), '--log', str(scene.parent / 'log'), '-o',
                 str(tmp_path / 'out'), *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
    assert not (tmp_path / 'out').exists()


@pytest.mark.parametrize('late_s', [1e9 - 5.0, -1e6])
def test_stamps_of_another_clock_are_refused(late_s, tmp_path, capsys):
    """Simulation time, or the future, up to which the scene would be simulated."""
    scene = record(FRICTION.replace('0.5\n', '0.05\n', 1), tmp_path / 'slope', late_s=late_s)
    assert main(['fit', str(scene), '--log', str(scene.parent / 'log'), '--vary',
                 'cloths.c.friction', '-o', str(tmp_path / 'out')]) == 2
    said = f'of a cloud are {abs(late_s):.3g} s apart, so they are of two clocks'
    assert said in capsys.readouterr().err
