"""The C++ baselines: compiled into a temporary folder, called in this process through ctypes."""

import ctypes
import os
from pathlib import Path
import shlex
import shutil
import subprocess
import tempfile
import weakref

import numpy as np

from works import LineWork, Work

HERE = Path(__file__).parent
FLAGS = ('-std=c++17', '-O3', '-march=native', '-shared', '-fPIC')
BITS = {'float32': 32, 'float64': 64}


class NotAvailableError(Exception):
    """What cannot be measured here, and why."""


class Compiler:
    """g++ or clang++, whichever there is; CXX names another, CXXFLAGS adds to our flags."""

    def __init__(self):
        names = [os.environ['CXX']] if os.environ.get('CXX') else ['g++', 'clang++', 'c++']
        found = [path for path in map(shutil.which, names) if path]
        if not found:
            raise NotAvailableError(f'no C++ compiler (looked for {", ".join(names)})')
        self.path = found[0]
        self.flags = (*FLAGS, *shlex.split(os.environ.get('CXXFLAGS', '')))
        version = subprocess.run([self.path, '--version'], capture_output=True, text=True)
        self.version = version.stdout.partition('\n')[0]

    def load(self, source: str, folder: str) -> ctypes.CDLL:
        """Compile one of our files and load it."""
        library = Path(folder) / f'{Path(source).stem}.so'
        done = subprocess.run([self.path, *self.flags, str(HERE / source), '-o', str(library)],
                              capture_output=True, text=True)
        if done.returncode:
            lines = [line for line in done.stderr.splitlines() if 'error' in line]
            raise NotAvailableError(f'{source}: {(lines or ["cannot be compiled"])[0]}')
        return ctypes.CDLL(str(library))


class Native:
    """Both libraries; each is None where it cannot be built, and ``why`` says so."""

    def __init__(self):
        self.compiler, self.textbook, self.bound, self.why = None, None, None, {}
        try:
            self.compiler = Compiler()
        except NotAvailableError as error:
            self.why = {'textbook': str(error), 'bound': str(error)}
            return
        with tempfile.TemporaryDirectory(prefix='xpbd_ros_benchmark_') as folder:
            for name in ('textbook', 'bound'):
                try:
                    setattr(self, name, self.compiler.load(f'{name}.cpp', folder))
                except NotAvailableError as error:
                    self.why[name] = str(error)

    def need(self, name: str) -> ctypes.CDLL:
        """Return a library, or say why there is none."""
        if getattr(self, name) is None:
            raise NotAvailableError(self.why[name])
        return getattr(self, name)


class _Object:
    """A C++ object behind functions ``<prefix>_new``, ``<prefix>_delete`` and so on."""

    prefix = ''

    def __init__(self, library: ctypes.CDLL, *arguments):
        self._library = library
        new = getattr(library, f'{self.prefix}_new')
        new.restype = ctypes.c_void_p
        self._pointer = ctypes.c_void_p(new(*map(_to_c, arguments)))
        weakref.finalize(self, getattr(library, f'{self.prefix}_delete'), self._pointer)

    def _call(self, name: str, *arguments) -> int:
        return getattr(self._library, f'{self.prefix}_{name}')(
            self._pointer, *map(_to_c, arguments))


def _to_c(value):
    if isinstance(value, float):
        return ctypes.c_double(value)
    if isinstance(value, np.ndarray):
        assert value.flags.c_contiguous and value.dtype in (np.float64, np.int32)
        return value.ctypes.data_as(ctypes.c_void_p)
    return ctypes.c_int(value)


def _doubles(array) -> np.ndarray:
    return np.ascontiguousarray(array, np.float64)


class Textbook(_Object):
    """``textbook.cpp`` on one work: its constraints in the order in which the work lists them."""

    prefix = 'cloth'

    def __init__(self, native: Native, work: Work, precision: str):
        self.count = len(work.x)
        super().__init__(native.need('textbook'), BITS[precision], self.count,
                         _doubles(work.inv_mass), _doubles(work.gravity))
        self.work = work
        hinges, edges = work.hinges, work.edges
        if hinges is not None:
            self._call('hinges', len(hinges.particles), hinges.particles.astype(np.int32),
                       _doubles(hinges.weight), _doubles(hinges.compliance))
        if edges is not None:
            self._call('edges', len(edges.particles), edges.particles.astype(np.int32),
                       _doubles(edges.rest_length), _doubles(edges.compliance))
        self.reset()

    def reset(self) -> None:
        """Go back to the work's start."""
        self._call('set', _doubles(self.work.x), np.zeros((self.count, 3)))

    def positions(self) -> np.ndarray:
        """Return x [m], shape (particles, 3)."""
        x, v = np.empty((self.count, 3)), np.empty((self.count, 3))
        self._call('get', x, v)
        return x

    def advance(self, frames: int, dt: float, substeps: int, iterations: int = 1) -> None:
        """Advance by whole frames."""
        self._call('advance', frames, dt, substeps, iterations)

    def project(self, passes: int, h: float) -> None:
        """Project all constraints, so many times; the multipliers are zeroed once, before."""
        self._call('project', passes, h)

    def leapfrog(self, frames: int, dt: float, substeps: int) -> None:
        """Advance explicitly, without a constraint solver."""
        self._call('leapfrog', frames, dt, substeps)


class GridBound(_Object):
    """``bound_grid.hpp``: Gauss-Seidel on the grid work, whole steps."""

    prefix = 'grid'

    def __init__(self, native: Native, work: Work, precision: str, *, estimate: bool, strip: int):
        self.work, self.n = work, work.n
        rest, compliance = (np.array([work.kinds[kind][k] for kind in range(3)]) for k in (0, 1))
        super().__init__(native.need('bound'), BITS[precision], int(estimate), min(strip, work.n),
                         work.n, _doubles(work.inv_mass), rest, compliance,
                         float(work.gravity[2]))
        self.reset()

    def reset(self) -> None:
        """Go back to the work's start."""
        self._call('set', _doubles(self.work.x), np.zeros((self.n**2, 3)))

    def positions(self) -> np.ndarray:
        """Return x [m], shape (particles, 3)."""
        x, v = np.empty((self.n**2, 3)), np.empty((self.n**2, 3))
        self._call('get', x, v)
        return x

    def order(self) -> np.ndarray:
        """Return the edges in the order in which they are projected, shape (edges, 2)."""
        pairs = np.empty((6 * self.n**2, 2), np.int32)
        return pairs[:self._call('order', pairs)]

    def advance(self, substeps: int, h: float) -> None:
        """Advance by whole substeps."""
        self._call('advance', substeps, h)


class LinesBound(_Object):
    """``bound_line.hpp``: every line of one direction as a tridiagonal system."""

    prefix = 'lines'

    def __init__(self, native: Native, work: LineWork, precision: str, *, estimate: bool):
        self.work, self.n = work, work.n
        super().__init__(native.need('bound'), BITS[precision], int(estimate), int(work.along),
                         work.n, work.h, _doubles(work.inv_mass), _doubles(work.rest_length),
                         _doubles(work.compliance))
        self.reset()

    def reset(self) -> None:
        """Go back to the work's start."""
        self._call('set', _doubles(self.work.x))

    def state(self) -> tuple[np.ndarray, np.ndarray]:
        """Return x [m], shape (n, n, 3), and the multipliers [N s²], shape (n, n)."""
        x, multiplier = np.empty((self.n, self.n, 3)), np.empty((self.n, self.n))
        self._call('get', x, multiplier)
        return x, multiplier

    def solve(self, passes: int) -> None:
        """Solve all lines, so many times."""
        self._call('solve', passes)


class BendBound(_Object):
    """``bound_bend.hpp``: isometric bending of a grid with alternating diagonals."""

    prefix = 'bend'

    def __init__(self, native: Native, work: Work, precision: str):
        self.work, self.n = work, work.n
        super().__init__(native.need('bound'), BITS[precision], work.n, _doubles(work.inv_mass))

    def order(self) -> np.ndarray:
        """Return the hinges in the order in which they are projected, shape (hinges, 4)."""
        particles = np.empty((3 * self.n**2, 4), np.int32)
        return particles[:self._call('order', particles)]

    def weigh(self, weight: np.ndarray, alpha: float) -> None:
        """Take the weights [1/m] of the hinges in that order, and their compliance over h²."""
        self._call('weigh', _doubles(weight), alpha)

    def reset(self) -> None:
        """Go back to the work's start."""
        self._call('set', _doubles(self.work.x))

    def positions(self) -> np.ndarray:
        """Return x [m], shape (particles, 3)."""
        x = np.empty((self.n**2, 3))
        self._call('get', x)
        return x

    def project(self, passes: int) -> None:
        """Project all hinges, so many times; the multipliers are zeroed once, before."""
        self._call('project', passes)
