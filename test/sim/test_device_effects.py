"""Every effect and method that a GPU has, on an emulated card: the CPU's bits, and no race."""

import numpy as np
import pytest

from support.meshes import file_of
from support.ptx_emulator import EmulatedCard
from support.scenes import disc_file, EXAMPLES, SHAPES
from xpbd_ros.effects import EFFECTS
from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import scene_from_mapping
from xpbd_ros.sim.backend import cuda
from xpbd_ros.sim.commands import (
    Grasp,
    MoveCollider,
    MovePin,
    PlaceCollider,
    Pose,
)

pytestmark = pytest.mark.slow
SHEET = ('stretch', 'shear', 'bend')
CONTACT = ('stretch', 'contact', 'friction')
TABLE = {'table': {'plane': {}, 'position': [0.0, 0.0, -0.005]}}
COLLIDERS = {
    'two': {**TABLE, 'ball': {'sphere': {'radius': 0.2}, 'position': [0.5, 0.5, -0.1]}},
    'pad': {**TABLE, 'ball': {'sphere': {'radius': 0.2}, 'position': [0.5, 0.5, -0.1],
                              'pad': {'stiffness': 1e5}}},
    'many': {**TABLE, 'ball': {'sphere': {'radius': 0.2}, 'position': [0.5, 0.5, -0.1],
                               'restitution': 0.7},
             'box': {'box': {'size': [0.3, 0.3, 0.1]}, 'position': [0.8, 0.4, 0.0],
                     'static_friction': 0.9},
             'roof': {'box': {'size': [0.6, 0.6, 0.1]}, 'position': [0.8, 0.4, 0.105]},
             'hills': {'heights': {'size': [1.0, 0.8], 'values': [[0.0, 0.02], [0.03, 0.01]]},
                       'position': [0.5, 0.4, -0.01]},
             **{f'rod_{k}': {'capsule': {'radius': 0.05, 'length': 0.3}, 'position':
                             [0.1 * k, 0.1 * k, -0.03]} for k in range(5)}},
}
"""more than are searched at once, with corners that particles are squeezed into"""
LAYERS = ('stretch', 'self_collision', 'friction')
SEAMS = {'open': {'between': [{'cloth': 'c', 'at': [3, 9]}, {'cloth': 'c', 'at': [20, 15]}]},
         'soft': {'between': [{'cloth': 'c', 'at': 'edge_0x'}, {'cloth': 'c', 'at': 'edge_1x'}],
                  'compliance': 0.01}}
CARDS = [{'order': 'shuffled', 'grid': 2, 'block': 8},
         {'order': 'backwards', 'grid': 6, 'block': 2}]
CASES = {
    'bdf2, symmetric': (SHEET, {'method': 'gauss_seidel_symmetric', 'integrator': 'bdf2'}),
    'ndf2, line': (SHEET, {'method': 'line', 'integrator': 'ndf2'}),
    'jacobi': (SHEET, {'method': 'jacobi', 'iterations': 2}),
    'float64': (SHEET, {'precision': 'float64'}),
    'compensated': (SHEET, {'substeps': 40}),
    'oblong cells': (SHEET, {'size': [1.0, 0.5]}),
    'damping, force': (('stretch', 'damping', 'force'), {}),
    'drag, wind': (('stretch', 'drag', 'wind'), {}),
    'contact': (CONTACT, {}),
    'contact, many colliders': (CONTACT, {'colliders': 'many', 'iterations': 2}),
    'contact, after': (CONTACT, {'iterations': 2, 'contact': {'when': 'after'}}),
    'contact, history': (CONTACT, {'integrator': 'ndf2', 'precision': 'float64'}),
    'contact, pad': (CONTACT, {'colliders': 'pad'}),
    'explicit': (CONTACT, {'method': 'explicit', 'integrator': 'leapfrog', 'substeps': 12}),
    'explicit, compliant pin': (('stretch',), {
        'method': 'explicit', 'integrator': 'leapfrog', 'substeps': 12, 'precision': 'float64',
        'pin': {'compliance': 0.01}}),
    'self_collision': (LAYERS, {'layers': 2}),
    'self_collision, particles': (LAYERS, {'layers': 2, 'mode': 'particles'}),
    'self_collision, contact, pads': ((*LAYERS, 'contact'), {'layers': 2, 'colliders': 'pad'}),
    'strain_limit, contact, seam': ((*CONTACT, 'strain_limit', 'seam'), {}),
    **{name: (('stretch', name), {}) for name in (
        'cross_bend', 'hinge', 'area', 'membrane', 'rayleigh', 'tether', 'seam', 'strain_limit')},
    **{f'mesh, {name}': ((name,), {'mesh': disc_file}) for name in (
        'stretch', 'bend', 'hinge', 'area', 'membrane', 'strain_limit')},
    **{name: ((name,), {'mesh': lambda name=name: file_of(*SHAPES[name]())}) for name in SHAPES},
}


OWN = {'method', 'integrator', 'iterations', 'precision', 'substeps', 'size'}
METHODS = {'gauss_seidel_symmetric': 'bdf2', 'jacobi': 'backward_euler', 'line': 'backward_euler',
           'explicit': 'leapfrog'}
"""methods and an integrator of each, besides that of the cases"""
PAIRS = [(case, method) for case, (_, options) in CASES.items() if not OWN & set(options)
         for method in METHODS if (case, method) not in {
             ('rayleigh', 'line'), ('rayleigh', 'explicit'), ('mesh, stretch', 'line')}]
"""without those that a CPU refuses too"""


def scene(names, *, device='cpu', mesh=None, size=(1.0, 0.8), pin=None, colliders='two',
          contact=None, layers=1, mode='surface', **solver):
    """Return sheets of square cells, a disc or a body, pinned, with some effects."""
    examples = {**EXAMPLES, 'contact': {**EXAMPLES['contact'], **(contact or {})},
                'strain_limit': {'max': 0.02}, 'self_collision': {'thickness': 0.03, 'mode': mode}}
    of = {scope: {name: examples[name] for name in (*names, 'pin') if EFFECTS[name] == scope}
          for scope in ('cloth', 'scene')}
    shape = ({'grid': {'size': list(size), 'resolution': [6, 5]}} if mesh is None
             else {'mesh': {'file': mesh()}})
    return compile_scene(scene_from_mapping({
        'solver': {'method': 'gauss_seidel', 'integrator': 'backward_euler', 'substeps': 2,
                   'precision': 'float32', 'order': 'coloured', 'device': device, **solver},
        'cloths': {name: {**shape, 'density': 1.0, 'effects': of['cloth'],
                          'pose': {'position': [0.03 * k, 0.02 * k, 0.02 * k]}}
                   for k, name in enumerate('cd'[:layers])},
        'pins': {'a': {'cloth': 'c', 'at': [0], **(pin or {})}}, 'effects': of['scene'],
        **({'colliders': COLLIDERS[colliders]} if 'contact' in names else {}),
        **({'seams': SEAMS} if 'seam' in names else {})},
        where='x', name='x'))


def test_the_cases_cover_what_a_gpu_has():
    assert {name for names, _ in CASES.values() for name in names} | {'pin'} == set(EFFECTS)


def both(names, monkeypatch, **options) -> list:
    """Return a scene on the CPU and on an emulated card."""
    monkeypatch.setattr(cuda, 'Card', EmulatedCard)
    return [scene(names, device=device, **options) for device in ('cpu', 'cuda')]


def same_frames(case, cards, monkeypatch, **solver) -> None:
    """Compare the frames of a case on the CPU with those on some cards."""
    names, options = CASES[case]
    options = {**options, **solver}
    found = [scene(names, **options)]
    for card in cards:
        monkeypatch.setattr(cuda, 'Card', lambda card=card: card)
        found.append(scene(names, device='cuda', **options))
    noise = np.random.default_rng(3).normal(0.0, 0.02, (3, len(found[0].slot)))
    for each in found:
        state, slot = each.state, each.slot
        state.x[:, slot] += (noise * (state.inv_mass[slot] > 0.0)).astype(state.x.dtype)
    layers = 0
    for index in range(4):
        commands = [MovePin('a', Pose((0.0, 0.01 * index, 0.02)))]
        if 'contact' in names:
            commands.append(MoveCollider('ball', Pose((0.5, 0.5, -0.1 + 0.01 * index))))
        ours, *theirs = (each.step(commands) for each in found)
        assert not ours.refused
        for other in theirs:
            assert all(getattr(ours, name).tobytes() == getattr(other, name).tobytes()
                       for name in ('x', 'v', 'inv_mass'))
            assert (ours.pins['a'].force == other.pins['a'].force).all()
            for name, collider in ours.colliders.items():
                np.testing.assert_array_equal(other.colliders[name].force, collider.force)
                np.testing.assert_array_equal(other.colliders[name].torque, collider.torque)
        layers += found[0].stats().get('self_contacts', 0)
    stats = [each.stats() for each in found]
    assert all(each == stats[0] for each in stats)
    assert len({each.hash() for each in found}) == 1
    if 'contact' in names:
        assert np.abs(ours.colliders['ball'].force).max() > 0.0
    assert layers > 0 or 'self_collision' not in names
    for name in {'strain_limit', 'seam'} & set(names):
        assert any(part.force.any() for part in found[0].effects[name].parts)
    assert np.abs(ours.v).max() > 0.01


def same_frames_without_race(case, monkeypatch, **solver) -> None:
    """Compare the frames of a case with those on two emulated cards."""
    cards = [EmulatedCard(**keys) for keys in CARDS]
    same_frames(case, cards, monkeypatch, **solver)
    for card in cards:
        assert (card.races, card.astray) == (0, 0)
        assert card.launches > 30


@pytest.mark.parametrize('case', CASES)
def test_frames_have_the_bits_of_the_cpu_and_no_race(case, monkeypatch):
    same_frames_without_race(case, monkeypatch)


@pytest.mark.parametrize(('case', 'method'), PAIRS)
def test_so_have_those_of_all_other_methods(case, method, monkeypatch):
    same_frames_without_race(case, monkeypatch, method=method, integrator=METHODS[method])


@pytest.mark.parametrize('compliance', [0.0, 1e-3])
def test_what_expires_or_slips_does_so_on_the_card(compliance, monkeypatch):
    """A pin and a collider with a lifetime, and a pin with a slip force; BDF2 has a history."""
    found = both(('stretch', 'contact', 'friction'), monkeypatch, integrator='bdf2',
                 pin={'slip': 0.3, 'compliance': compliance})
    commands = {1: [Grasp('g', Pose((1.0, 0.8, 0.0)), radius=0.3, lifetime_ns=30_000_000),
                    PlaceCollider('box', 'box', (0.4, 0.4, 0.1), Pose((0.8, 0.2, -0.05)),
                                  lifetime_ns=60_000_000)],
                6: [MovePin('a', Pose((0.0, 0.0, 0.1)))]}    # a target, which fetches nothing
    seen = set()
    for index in range(10):
        ours, theirs = (each.step(commands.get(index, ())) for each in found)
        assert not ours.refused
        for name in ('x', 'v', 'inv_mass'):
            assert getattr(ours, name).tobytes() == getattr(theirs, name).tobytes(), index
        seen.add((tuple(ours.pins), tuple(ours.colliders)))
        assert ours.pins.keys() == theirs.pins.keys()
    assert {'box' in colliders for _, colliders in seen} == {True, False}
    assert {'g' in pins for pins, _ in seen} == {'a' in pins for pins, _ in seen} == {True, False}
    assert found[0].stats() == found[1].stats()


def test_hinges_of_a_frame_that_is_rolled_back_are_those_before(monkeypatch):
    found = both(('stretch', 'hinge'), monkeypatch)
    for each in found:
        for _ in range(2):
            each.step()
        each.state.v[:, each.slot[9]] = 1e9
        each._crew.host_changed()    # as a command does, but nothing is fetched
        each.step()
        each.fetch()
        assert each.stats()['frames_taken_back'] == 1
    ours, theirs = (each.effects['hinge'].data.angle for each in found)
    assert np.abs(ours).max() > 1e-4
    np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize('rough', [{}, {'rough_frames': 2, 'rough_substeps': 3,
                                        'rough_integrator': 'ndf2'}])
def test_an_unstable_frame_is_computed_again_on_the_card(rough, monkeypatch):
    """And those after it with ``line``; what either method leaves to the next is the CPU's."""
    found = both(CONTACT, monkeypatch, method='explicit', integrator='leapfrog', substeps=12,
                 **rough)
    for index in range(9):
        if index in {3, 7}:
            for each in found:
                each.fetch()
                each.state.v[2, each.slot[13]] = 40.0
        ours, theirs = (each.step() for each in found)
        for name in ('x', 'v'):
            assert getattr(ours, name).tobytes() == getattr(theirs, name).tobytes(), index
        np.testing.assert_array_equal(ours.colliders['ball'].force, theirs.colliders['ball'].force)
    ours, theirs = (each.stats() for each in found)
    assert ours == theirs
    assert ours['method_switches' if rough else 'explicit_redone'] > 1
    assert len({each.hash() for each in found}) == 1


def test_a_frame_that_is_kept_has_the_wrenches_of_the_cpu(monkeypatch):
    """``keep`` brings all arrays to the host, after what the frame begins with."""
    found = both(CONTACT, monkeypatch)
    for _ in range(3):
        ours, theirs = (each.step(keep=True) for each in found)
        np.testing.assert_array_equal(ours.colliders['ball'].force, theirs.colliders['ball'].force)
    assert np.abs(ours.colliders['ball'].force).max() > 0.0


@pytest.fixture(scope='module')
def card():
    """Return the card of this machine."""
    try:
        return cuda.Card()
    except InputError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize('case', CASES)
def test_frames_on_a_card_have_the_bits_of_the_cpu(case, card, monkeypatch):
    same_frames(case, [card], monkeypatch)


@pytest.mark.parametrize(('case', 'method'), PAIRS)
def test_so_have_those_of_all_other_methods_on_a_card(case, method, card, monkeypatch):
    same_frames(case, [card], monkeypatch, method=method, integrator=METHODS[method])
