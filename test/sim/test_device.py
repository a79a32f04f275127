"""``solver.device: cuda`` on a card that is emulated: the CPU's bits, and no race of threads."""

import gc

import numpy as np
import pytest

from sim.test_coloured import BOTH, cloths, crumpled, FEW
from sim.test_device_effects import scene as effects_scene
from support.ptx_emulator import EmulatedCard
from support.scenes import SMALL_SHEET
from support.tiers import slow
from xpbd_ros.cli.main import main
from xpbd_ros.errors import InputError
from xpbd_ros.sim.backend import cuda, device_memory
from xpbd_ros.sim.commands import (
    Grasp,
    MovePin,
    Pose,
    Release,
    Reset,
    SetKey,
    SetState,
)

CARDS = [{'order': 'shuffled', 'grid': 2, 'block': 8},
         {'order': 'backwards', 'grid': 6, 'block': 2}]
"""two orders of threads, and two grids of them"""


@pytest.fixture
def on_card(monkeypatch):
    """Return a function that compiles a simulation for an emulated card."""
    def simulation(card, make=cloths, shapes=BOTH, **options):
        monkeypatch.setattr(cuda, 'Card', lambda: card)
        return make(shapes, device='cuda', **{'effects': FEW, 'pin': True, **options})
    return simulation


def on_cpu(shapes=BOTH, **options):
    return cloths(shapes, **{'effects': FEW, 'pin': True, **options})


def same(ours, theirs) -> bool:
    """Return True if two frames have the same bits."""
    return (all(getattr(ours, name).tobytes() == getattr(theirs, name).tobytes()
                for name in ('x', 'v', 'inv_mass'))
            and ours.pins.keys() == theirs.pins.keys()
            and all((ours.pins[name].force == theirs.pins[name].force).all()
                    for name in ours.pins))


@pytest.mark.parametrize('options', CARDS)
def test_frames_have_the_bits_of_the_cpu_and_no_race(on_card, options):
    card = EmulatedCard(**options)
    ours, theirs = crumpled(on_cpu()), crumpled(on_card(card))
    before = ours.frame().x
    for _ in range(3):
        left, right = ours.step(), theirs.step()
        assert same(left, right)
    assert np.abs(left.x - before).max() > 1e-3
    assert ours.hash() == theirs.hash()
    assert (card.races, card.astray) == (0, 0)
    assert card.barriers > 50


def test_an_uncoloured_sweep_is_caught(on_card):
    card = EmulatedCard()
    theirs = crumpled(on_card(card))
    for part in theirs.effects['stretch'].parts:
        colours = getattr(part.edges, 'colours', None)
        colours = part.edges.runs.colour if colours is None else colours
        colours[1:] = colours[-1]    # all constraints at once
    theirs.step()
    assert card.races > 100


def test_a_missing_barrier_is_caught(on_card):
    class Careless(EmulatedCard):
        def load(self, ptx):
            begin, end = '{ // meet_all', '} // all met'
            while begin in ptx:
                head, _, rest = ptx.partition(begin)
                ptx = head + rest.partition(end)[2].lstrip(';')
            return super().load(ptx)

    card = Careless()
    crumpled(on_card(card)).step()
    assert card.races > 100


@pytest.mark.slow
def test_a_missing_barrier_of_a_block_is_caught(monkeypatch):
    """Rounds of a group of pairs, and groups, wait for one another."""
    class Careless(EmulatedCard):
        def load(self, ptx):
            return super().load(ptx.replace('bar.sync 0; // meet_block', ''))

    card = Careless()
    monkeypatch.setattr(cuda, 'Card', lambda: card)
    layers = effects_scene(('stretch', 'self_collision', 'friction'), device='cuda', layers=2)
    crumpled(layers).step()
    assert card.races > 20


@pytest.mark.parametrize('holds', [True, False])
def test_the_barrier_holds_whatever_thread_goes_on(on_card, holds):
    """Its own instructions, one thread at a time, at random; one that does not wait is caught."""
    class Card(EmulatedCard):
        def load(self, ptx):
            assert '@%mp2 bra $L_look;' in ptx or '// meet_all' not in ptx
            return super().load(ptx if holds else ptx.replace('@%mp2 bra $L_look;', ''))

    card = Card(order='random', grid=3, block=2, barrier_too=True)
    ours, theirs = crumpled(on_cpu()), crumpled(on_card(card))
    assert same(ours.step(), theirs.step()) == holds


COMMANDS = {
    2: [Grasp('b', Pose((0.2, 0.1, 0.0)), radius=0.15)],
    3: [MovePin('b', Pose((0.25, 0.1, 0.05))), MovePin('a', Pose((0.0, 0.0, 0.1)))],
    5: [SetKey('cloths.c0.effects.stretch.warp', 3.0)],
    6: [Release('b')],
    7: [SetState('c0', tuple(np.linspace(0.0, 1.0, 90)))],
    9: [Reset()],
}


@pytest.mark.parametrize('integrator', ['backward_euler', slow('bdf2')])
def test_commands_reach_the_card(on_card, integrator):
    card = EmulatedCard()
    ours, theirs = on_cpu(integrator=integrator), on_card(card, integrator=integrator)
    for index in range(11):
        left, right = (each.step(COMMANDS.get(index, ())) for each in (ours, theirs))
        assert not left.refused
        assert same(left, right), f'frame {index}'
        assert np.abs(left.v).max() > 0.0
    assert card.races == 0


def test_a_saved_state_continues_with_the_same_bits(on_card):
    ours, theirs = crumpled(on_cpu()), crumpled(on_card(EmulatedCard()))
    for each in (ours, theirs):
        each.step()
    saved = theirs.save()
    expected = [ours.step() for _ in range(2)]
    for _ in range(2):
        theirs.restore(saved)
        assert all(same(frame, theirs.step()) for frame in expected)


def test_a_frame_that_is_rolled_back_leaves_the_card_as_the_cpu(on_card):
    ours, theirs = crumpled(on_cpu()), crumpled(on_card(EmulatedCard()))
    for each in (ours, theirs):
        each.step()
        each.state.v[:, each.slot[9]] = 1e9
        each.apply([SetKey('gravity', (0.0, 0.0, -1.0))])    # the host has changed something
    for _ in range(3):
        assert same(ours.step(), theirs.step())
    assert ours.stats()['frames_taken_back'] == theirs.stats()['frames_taken_back'] == 1
    assert ours.hash() == theirs.hash()


def test_memory_is_unlocked_before_it_is_anothers(on_card, monkeypatch):
    monkeypatch.setattr(device_memory, 'LARGE', 1)
    card = EmulatedCard()
    theirs = on_card(card)
    theirs.step()
    assert len(card.locked) == 3    # x, v, inv_mass
    del theirs
    gc.collect()
    assert not card.locked


def test_little_goes_up_and_down_in_a_frame(on_card):
    class Counting(EmulatedCard):
        up = down = 0

        def put(self, address, array):
            self.up += array.nbytes
            super().put(address, array)

        def get(self, address, array):
            self.down += array.nbytes
            super().get(address, array)

    card = Counting()
    theirs = on_card(card)
    theirs.step()
    card.up = card.down = 0
    theirs.step()
    pin, state = theirs.effects['pin'].data, theirs.state
    assert card.up < 0.2 * card.down
    assert card.down <= sum(array.nbytes for array in (
        state.x, state.v, state.inv_mass, state.reaction, *pin)) + card.up


def refusal(**options) -> str:
    with pytest.raises(InputError) as told:
        on_cpu([(3, 2)], device='cuda', **options)
    return str(told.value)


def test_without_a_card_there_is_one_line(monkeypatch, tmp_path, capfd):
    monkeypatch.setattr(cuda, 'LIBRARY', 'libcuda_of_no_machine.so')
    assert refusal().startswith('x: solver.device: cuda needs an NVIDIA card and its driver (')
    file = tmp_path / 'scene.yaml'
    solver = 'solver: {device: cuda, order: coloured, method: gauss_seidel}'
    file.write_text(solver + SMALL_SHEET)
    assert main(['run', str(file)]) == 2
    said, = capfd.readouterr().err.splitlines()
    assert said.endswith('; take device: cpu')


@pytest.mark.parametrize('options, expected', [
    ({'order': 'sequential'}, 'solver.device: cuda sweeps constraints by colours; add '
     'solver.order: coloured'),
    ({'method': 'auto'}, 'solver.method: auto predicts the times of a CPU; for solver.device: '
     'cuda take one of gauss_seidel, '),
    ({'error_target': 1e-3}, 'solver.error_target: changes substeps as it runs'),
])
def test_what_a_gpu_cannot_do_is_told_with_the_way_out(options, expected, monkeypatch):
    monkeypatch.setattr(cuda, 'Card', EmulatedCard)
    assert refusal(**options).startswith(f'x: {expected}')
