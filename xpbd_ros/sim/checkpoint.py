"""
A simulation's whole state as bytes, from which another process continues bit for bit.

Besides positions and velocities it contains all that the next frame depends on: the integrator's
history, pins and their targets, colliders and their motion, lists of candidates, counters, and a
state kept by ``SaveState``, as a second pickle. Meshes, kernels and threads are left out; the
simulation that restores it has its own. Arrays are stored as they lie in memory, which depends on
the width of vectors: that must be the same. The bytes are a pickle whose classes are restricted to
those of the simulation, so that a log of unknown origin runs no code.
"""

from collections.abc import Iterator
import copy
from io import BytesIO
import pickle
from types import MethodType
from typing import Any
import zlib

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.sim.backend.simd import BITS, WIDTH_VARIABLE
from xpbd_ros.sim.simulation import SavedState, Simulation

PROTOCOL = 5
PACKAGES = ('xpbd_ros.sim.', 'xpbd_ros.effects.', 'scipy.sparse.')
"""packages whose classes a checkpoint may contain"""
NUMPY = {'_frombuffer', '_reconstruct', 'dtype', 'ndarray', 'scalar'}
"""names of the functions and classes that NumPy unpickles arrays with"""
OTHERS = {('collections', 'deque'), ('fractions', 'Fraction'),
          ('xpbd_ros.sim.checkpoint', '_method')}
"""further classes and functions by module and name"""
LARGEST = 2**32
"""size of a checkpoint, at most [bytes]"""


def checkpoint(simulation: Simulation) -> bytes:
    """Return the whole state of a simulation, between two frames."""
    simulation.fetch()
    stream = BytesIO()
    _Pickler(stream, simulation).dump((BITS, simulation.__dict__))
    if simulation.saved:
        saved = simulation.saved.simulation()
        _Pickler(stream, saved).dump(saved.__dict__)
    return zlib.compress(stream.getbuffer(), 1)


def restore(simulation: Simulation, data: bytes) -> None:
    """
    Continue from a checkpoint.

    Parameters
    ----------
    simulation : compiled from the scene as it was at the checkpoint, with as many threads
    data : from ``checkpoint``

    Raises
    ------
    InputError : the checkpoint is damaged, or of another scene, version or width of vectors;
        nothing has changed

    """
    try:
        reader = zlib.decompressobj()
        raw = reader.decompress(data, LARGEST)
        if not reader.eof:
            raise EOFError('no end, and no checksum')
        stream = BytesIO(raw)
        bits, found = _Unpickler(stream, simulation).load()
        saved = None
        if stream.tell() < len(raw):
            saved = copy.deepcopy(simulation)
            _adopt(saved, _Unpickler(stream, saved).load())
        same = (list(found) == list(simulation.__dict__)
                and np.array_equal(found['slot'], simulation.slot)
                and list(found['effects']) == list(simulation.effects))
    except Exception as error:    # unpickling raises anything on arbitrary bytes
        raise InputError(f'the checkpoint cannot be read: it is damaged, or of another version '
                         f'({type(error).__name__}: {error})') from None
    if bits != BITS:
        raise InputError(f'the checkpoint has vectors of {bits} bits, and this process has vectors'
                         f' of {BITS}; set the environment variable {WIDTH_VARIABLE}={bits}')
    if not same:
        raise InputError('the checkpoint is of another scene')
    _adopt(simulation, found)
    simulation.saved = None if saved is None else SavedState(saved)


def _adopt(simulation: Simulation, found: dict[str, Any]) -> None:
    """Give a simulation the attributes of another one of its scene."""
    simulation.__dict__.update(found)
    if simulation._retune is not None:
        simulation._retune.rebind(simulation.state, simulation.effects)


def _shared(simulation: Simulation) -> Iterator[tuple[str, Any]]:
    """Yield the objects that compiling the scene creates, by name."""
    yield 'simulation', simulation
    for name in ('_step', '_crew', '_retune'):
        yield name, getattr(simulation, name)
    for cloth in simulation.cloths:
        yield f'cloth {cloth.name}', cloth
        yield f'mesh {cloth.name}', cloth.mesh


class _Pickler(pickle.Pickler):
    def __init__(self, stream, simulation: Simulation):
        super().__init__(stream, PROTOCOL)
        self._names = {id(each): name for name, each in _shared(simulation) if each is not None}

    def persistent_id(self, obj) -> str | None:
        return self._names.get(id(obj))

    def reducer_override(self, obj):
        if isinstance(obj, MethodType):
            return _method, (obj.__self__, obj.__name__)
        return NotImplemented


def _method(owner, name: str):
    """Return a bound method of an object of the simulation."""
    if type(owner).__module__.startswith(PACKAGES):
        return getattr(owner, name)
    raise pickle.UnpicklingError(f'{type(owner).__name__}.{name} is no part of a simulation')


class _Unpickler(pickle.Unpickler):
    def __init__(self, stream, simulation: Simulation):
        super().__init__(stream)
        self._shared = dict(_shared(simulation))

    def persistent_load(self, name):
        return self._shared[name]

    def find_class(self, module: str, name: str):
        package = module.partition('.')[0]
        known = (module, name) in OTHERS or package == 'numpy' and name in NUMPY
        if known or module.startswith(PACKAGES):
            found = super().find_class(module, name)
            if known or isinstance(found, type) and found.__module__ == module:    # not imported
                return found
        raise pickle.UnpicklingError(f'{module}.{name} is no part of a simulation')
