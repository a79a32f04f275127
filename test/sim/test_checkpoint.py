"""Checkpoints: another simulation continues from the bytes, and hostile bytes run no code."""

import pickle
import zlib

import pytest

from support.logs import SHEET
from support.scenes import FEW, USUAL, with_effects
from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import scene_from_text
from xpbd_ros.sim.backend.simd import BITS
from xpbd_ros.sim.checkpoint import checkpoint, restore
from xpbd_ros.sim.commands import (
    Grasp,
    LoadState,
    MovePin,
    Pose,
    ReleaseAll,
    Reset,
    SaveState,
    SetKey,
)

MOVE = MovePin('hand', Pose((0.5, 0.5, 0.4)))


def after_a_grasp(make, frames: int = 5):
    """Return a simulation that grasped and moved its cloth."""
    simulation = make()
    simulation.step([Grasp('hand', Pose((0.5, 0.5, 0.0)), 0.3)])
    simulation.step([MOVE])
    for _ in range(frames):
        simulation.step()
    return simulation


@pytest.mark.parametrize('method, integrator', [
    ('gauss_seidel', 'backward_euler'), ('line', 'ndf2'),
    pytest.param('line', 'bdf2', marks=pytest.mark.slow),
    pytest.param('explicit', 'leapfrog', marks=pytest.mark.slow)])
def test_a_simulation_continues_from_a_checkpoint_bit_for_bit(method, integrator):
    def make():
        return with_effects(names=USUAL if method == 'gauss_seidel' else FEW, method=method,
                            integrator=integrator, substeps=12)
    first, second = after_a_grasp(make), make()
    restore(second, checkpoint(first))
    assert second.index == first.index
    for commands in ([], [MOVE], [], [Reset()], []):
        assert second.hash() == first.hash()
        one, other = first.step(commands), second.step(commands)
        assert (other.time_ns, other.refused) == (one.time_ns, one.refused)
    assert second.hash() == first.hash()


def test_a_kept_state_goes_along():
    """``LoadState`` gives the same bits, also where a live key has changed since."""
    def make():
        return compile_scene(scene_from_text(SHEET, where='here', name='here'))
    first, second = make(), make()
    first.step([Grasp('hand', Pose((0.0, 0.0, 0.0)), 0.1)])
    first.step([SaveState()])
    first.step([SetKey('gravity', (0.0, 0.0, -5.0))])
    first.step([ReleaseAll()])
    restore(second, checkpoint(first))
    faster = SetKey('gravity', (0.0, 0.0, -9.0))
    for commands in ([LoadState()], [], [faster], [LoadState()], []):
        one, other = first.step(commands), second.step(commands)
        assert (other.refused, second.hash()) == ((), first.hash())
        assert list(other.pins) == list(one.pins) == ['left', 'hand']
    restore(second, checkpoint(make()))
    assert second.step([LoadState()]).refused


def test_the_simulation_that_was_saved_is_left_as_it_was():
    first = after_a_grasp(lambda: with_effects())
    state = first.hash()
    second = with_effects()
    restore(second, checkpoint(first))
    second.step()
    assert first.hash() == state != second.hash()


class Call:
    """A pickle of this calls ``print``."""

    def __reduce__(self):
        return print, ('called',)


class Attribute:
    """A pickle of this calls ``getattr``."""

    def __reduce__(self):
        return getattr, (Call, '__name__')


def name(module, attribute):
    """A pickle (protocol 4) of an attribute of a module; dots lead to attributes of attributes."""
    strings = (b'\x8c%c%b' % (len(each), each) for each in (module, attribute))
    return b'\x80\x04' + b''.join(strings) + b'\x93.'


def refused(data, reason, capfd):
    """A simulation refuses the bytes for the reason, and nothing of it changes."""
    simulation = with_effects()
    state = simulation.hash()
    with pytest.raises(InputError, match=f'is damaged, or of another version.*{reason}'):
        restore(simulation, data)
    assert 'called' not in capfd.readouterr().out
    assert simulation.hash() == state


@pytest.mark.parametrize('data', [b'', b'no checkpoint', zlib.compress(b'no pickle')])
def test_other_bytes_are_refused(data, capfd):
    refused(data, '', capfd)


@pytest.mark.parametrize('missing', [1, 4, 100])
def test_a_checkpoint_cut_short_is_refused(missing, capfd):
    """Even one that lacks only the last bytes of its checksum is refused."""
    refused(checkpoint(with_effects())[:-missing], 'no end, and no checksum', capfd)


@pytest.mark.parametrize('pickled', [
    pickle.dumps(Call()), pickle.dumps(Attribute()),
    name(b'xpbd_ros.sim.backend.threads', b'np.load'),
    name(b'xpbd_ros.sim.backend.threads', b'ThreadPoolExecutor'),
    name(b'xpbd_ros.scene.load', b'load_scene')])
def test_code_of_others_is_refused_before_it_runs(pickled, capfd):
    refused(zlib.compress(pickled), 'is no part of a simulation', capfd)


@pytest.mark.parametrize('other', [{'grid': (5, 5)}, {'names': FEW}])
def test_a_checkpoint_of_another_scene_is_refused(other):
    first, other = with_effects(), with_effects(**other)
    with pytest.raises(InputError, match='of another scene'):
        restore(other, checkpoint(first))


def test_a_checkpoint_of_another_vector_width_is_refused_with_the_remedy(monkeypatch):
    """Its arrays lie in memory as these vectors need them."""
    first, other = with_effects(), with_effects()
    data = checkpoint(first)
    monkeypatch.setattr('xpbd_ros.sim.checkpoint.BITS', 64)
    state = other.hash()
    with pytest.raises(InputError, match=rf'vectors of {BITS} bits, and this process has vectors '
                       rf'of 64; set the environment variable XPBD_ROS_VECTOR_BITS={BITS}'):
        restore(other, data)
    assert other.hash() == state
