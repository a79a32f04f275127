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
    arguments = [datamodel.default_manager[kind].get_argument_type()
                 for kind in request.signature]
    return nvptx.ptx_of(str(result.library._final_module), result.fndesc.llvm_func_name,
                        ['ptr' if str(kind).endswith('*') else str(kind)
                         for kind in _leaves(arguments)],
                        _teams(request.signature, arguments), request.arch)


def _leaves(kind) -> list:
    """Return the types in LLVM of an argument, in order."""
    if isinstance(kind, tuple | list):
        return [leaf for each in kind for leaf in _leaves(each)]
    return [kind]


def _teams(kinds, arguments, at: int = 0) -> list[int]:
    """Return the parameters where a DeviceTeam begins; the first argument is at ``at``."""
    found = []
    for kind, argument in zip(kinds, arguments):
        if getattr(kind, 'instance_class', None) is DeviceTeam:
            found.append(at)
        elif isinstance(kind, types.BaseTuple):
            found += _teams(kind, argument, at)
        at += len(_leaves(argument))
    return found


def main() -> None:
    """Compile what another process asks for."""
    modules, requests = pickle.load(sys.stdin.buffer)
    for name in modules:
        importlib.import_module(name)
    sys.stdout.buffer.write(pickle.dumps(list(map(compiled, pickle.loads(requests)))))


if __name__ == '__main__':
    main()
