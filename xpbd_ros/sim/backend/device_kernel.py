"""
Kernels of a GPU by name and argument types: compiled once, in a process with one lane, and kept.

The width of vectors is fixed when the package is imported, so another process compiles:

    python -m xpbd_ros.sim.backend.device_kernel < requests > PTX, both pickled

The PTX lies beside Numba's cache, in a folder named by a hash of the package's kernels.
"""

from collections.abc import Sequence
import hashlib
import importlib
import os
import pickle
import subprocess
import sys
from typing import Any, NamedTuple

from numba import types
from numba.core import datamodel

from xpbd_ros.errors import InputError
from xpbd_ros.sim.backend.device_team import DeviceTeam
from xpbd_ros.sim.backend.disk_cache import CACHE_FOLDER
from xpbd_ros.sim.backend.jit import WHY_PLAIN
from xpbd_ros.sim.backend.packed_arguments import is_compact, leaves
from xpbd_ros.sim.backend.simd import WIDTH_VARIABLE

ONE_LANE = '32'
REGISTERING = f'{__name__.partition(".")[0]}.effects.'
"""modules that register kernels as they are imported"""


class Request(NamedTuple):
    """A kernel to compile."""

    find: Any
    """function that returns the kernel, of a module (pickled by its name)"""
    name: tuple
    """arguments of ``find``"""
    signature: tuple
    """types of the kernel's arguments, as Numba has them"""
    arch: str
    """of the card, such as 'sm_90'"""

    @property
    def key(self) -> str:
        """Name of the file with its PTX."""
        text = f'{self.find.__module__} {self.name} {self.signature} {self.arch}'
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def compile_kernels(requests: Sequence[Request]) -> list[str]:
    """Return the PTX of some kernels; those that are not on disk are compiled."""
    if WHY_PLAIN:
        raise InputError(f'solver.device: cuda needs kernels that are linked, and {WHY_PLAIN}')
    folder = CACHE_FOLDER / 'ptx'
    folder.mkdir(exist_ok=True)
    files = [folder / request.key for request in requests]
    missing = {file: request for file, request in zip(files, requests) if not file.exists()}
    if missing:
        done = subprocess.run(
            [sys.executable, '-m', __name__], stdout=subprocess.PIPE,
            input=pickle.dumps(([name for name in sys.modules if name.startswith(REGISTERING)],
                                pickle.dumps(list(missing.values())))),
            env={**os.environ, WIDTH_VARIABLE: ONE_LANE, 'PYTHONPATH': os.pathsep.join(sys.path)})
        if done.returncode:
            raise RuntimeError(f'PTX: the compiler failed with status {done.returncode}')
        for file, text in zip(missing, pickle.loads(done.stdout)):
            part = file.with_suffix(f'.{os.getpid()}')
            part.write_text(text)
            part.replace(file)
    return [file.read_text() for file in files]


def compiled(request: Request) -> str:
    """Compile one kernel, in a process with one lane."""
    from xpbd_ros.sim.backend import nvptx
    part = request.find(*request.name).part()
    part.compile(request.signature)
    result = part.overloads[request.signature]
    models = [datamodel.default_manager[kind] for kind in request.signature]
    kinds = [str(kind) for model in models for kind in leaves(model.get_argument_type())]
    assert len(kinds) == sum(_count(kind, False) for kind in request.signature)
    return nvptx.ptx_of(str(result.library._final_module), result.fndesc.llvm_func_name,
                        ['ptr' if kind.endswith('*') else kind for kind in kinds],
                        _teams(request.signature), request.arch)


def _teams(kinds, at: int = 0, inside: bool = False) -> list[int]:
    """Return the parameters where a DeviceTeam begins; the first type is at ``at``."""
    found = []
    for kind in kinds:
        if getattr(kind, 'instance_class', None) is DeviceTeam:
            found.append(at)
        elif isinstance(kind, types.BaseTuple):
            found += _teams(kind, at, isinstance(kind, types.NamedTuple))
        at += _count(kind, inside)
    return found


def _count(kind, inside: bool) -> int:
    """Return how many parameters an argument takes; ``inside`` as in ``flat``."""
    if isinstance(kind, types.BaseTuple):
        return sum(_count(each, isinstance(kind, types.NamedTuple)) for each in kind)
    if isinstance(kind, types.Array):
        return 1 + kind.ndim if is_compact(kind, inside) else 5 + 2 * kind.ndim
    return 1


def main() -> None:
    """Compile what another process asks for."""
    modules, requests = pickle.load(sys.stdin.buffer)
    for name in modules:
        importlib.import_module(name)
    sys.stdout.buffer.write(pickle.dumps(list(map(compiled, pickle.loads(requests)))))


if __name__ == '__main__':
    main()
