"""
NVIDIA's driver (libcuda) through ctypes: memory, kernels from PTX, launches in a CUDA graph.

Reference: CUDA Driver API, docs.nvidia.com/cuda/cuda-driver-api. Kernels with a barrier are
cooperative launches: their blocks are on the card at once.
"""

from collections.abc import Callable, Sequence
import ctypes
from ctypes import byref, c_int, c_size_t, c_uint64, c_void_p
import mmap

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.sim.backend.nvptx import ENTRY, THREADS

LIBRARY = 'libcuda.so.1'
WARP = 32
"""threads of a block, where few threads are spread over the card"""
PROCESSORS, MAJOR, MINOR, COOPERATIVE = 16, 75, 76, 95
"""numbers of CUdevice_attribute"""
OLDEST = 70
"""compute capability whose barriers and memory order the kernels need, times ten"""
REGISTERS = 4
"""number of CUfunction_attribute"""
ERROR_LOG, ERROR_LOG_SIZE = 5, 6
"""numbers of CUjit_option"""
PAGE = mmap.PAGESIZE
RELAXED = 2
"""capture mode: other threads may call the driver"""


class Card:
    """The first card of this machine."""

    def __init__(self):
        try:
            self._driver = ctypes.CDLL(LIBRARY)
            self._call('cuInit', 0)
            self._device, context = c_int(), c_void_p()
            self._call('cuDeviceGet', byref(self._device), 0)
        except (OSError, RuntimeError) as error:
            raise InputError('solver.device: cuda needs an NVIDIA card and its driver '
                             f'({error}); take device: cpu') from None
        major, minor = self._attribute(MAJOR), self._attribute(MINOR)
        self.arch = f'sm_{major}{minor}'
        """compute capability"""
        if 10 * major + minor < OLDEST or not self._attribute(COOPERATIVE):
            raise InputError(f'solver.device: cuda needs compute capability {OLDEST / 10:g} or '
                             f'more, and this card has {major}.{minor}; take device: cpu')
        self._call('cuDevicePrimaryCtxRetain', byref(context), self._device)
        self._context, self._stream = context, c_void_p()
        self._enter()
        self._call('cuStreamCreate', byref(self._stream), 1)
        name = ctypes.create_string_buffer(100)
        self._call('cuDeviceGetName', name, len(name), self._device)
        self.name = name.value.decode()
        self.processors = self._attribute(PROCESSORS)
        self._locked: dict[int, tuple[int, int]] = {}    # pages by the address of their array

    def _call(self, name: str, *arguments) -> None:
        code = getattr(self._driver, name)(*arguments)
        if code:
            text = ctypes.c_char_p()
            self._driver.cuGetErrorString(code, byref(text))
            raise RuntimeError(f'{name}: error {code}, {(text.value or b"unknown").decode()}')

    def _attribute(self, number: int) -> int:
        value = c_int()
        self._call('cuDeviceGetAttribute', byref(value), number, self._device)
        return value.value

    def _enter(self) -> None:
        """Make the card's context that of this thread."""
        self._call('cuCtxSetCurrent', self._context)

    def load(self, ptx: str) -> c_void_p:
        """Return the kernel of a PTX module, which the driver compiles."""
        self._enter()
        log = ctypes.create_string_buffer(8192)
        options = (c_int * 2)(ERROR_LOG, ERROR_LOG_SIZE)
        values = (c_void_p * 2)(ctypes.cast(log, c_void_p), len(log))
        module, kernel = c_void_p(), c_void_p()
        try:
            self._call('cuModuleLoadDataEx', byref(module), ctypes.c_char_p(ptx.encode()), 2,
                       options, values)
        except RuntimeError as error:
            raise RuntimeError(f'{error}: {log.value.decode()}') from None
        self._call('cuModuleGetFunction', byref(kernel), module, ENTRY.encode())
        return kernel

    def registers(self, kernel: c_void_p) -> int:
        """Return how many registers a thread of a kernel has."""
        value = c_int()
        self._call('cuFuncGetAttribute', byref(value), REGISTERS, kernel)
        return value.value

    def blocks(self, kernel: c_void_p) -> int:
        """Return how many blocks of a kernel are on the card at once."""
        value = c_int()
        self._call('cuOccupancyMaxActiveBlocksPerMultiprocessor', byref(value), kernel,
                   THREADS, c_size_t(0))
        return value.value * self.processors

    def allocate(self, size: int) -> int:
        """Return the address of new memory."""
        self._enter()
        address = c_uint64()
        self._call('cuMemAlloc_v2', byref(address), c_size_t(size))
        return address.value

    def free(self, address: int) -> None:
        """Give memory back."""
        self._enter()
        self._call('cuMemFree_v2', c_uint64(address))

    def put(self, address: int, array: np.ndarray) -> None:
        """Copy a contiguous array to the card, before all that is begun later."""
        self._enter()
        for offset, host, size in self._pieces(array):
            self._call('cuMemcpyHtoDAsync_v2', c_uint64(address + offset), c_void_p(host),
                       c_size_t(size), self._stream)

    def get(self, address: int, array: np.ndarray) -> None:
        """Copy from the card into a contiguous array, after all that was begun before."""
        self._enter()
        for offset, host, size in self._pieces(array):
            self._call('cuMemcpyDtoHAsync_v2', c_void_p(host), c_uint64(address + offset),
                       c_size_t(size), self._stream)
        self.wait()

    def _pieces(self, array: np.ndarray) -> list[tuple[int, int, int]]:
        """Return the offset, address and size of what to copy at once: locked pages, or not."""
        start, end = array.ctypes.data, array.ctypes.data + array.nbytes
        first, last = self._locked.get(start, (start, end))
        cuts = [start, min(first, end), min(last, end), end]
        return [(begin - start, begin, stop - begin)
                for begin, stop in zip(cuts, cuts[1:]) if stop > begin]

    def lock(self, array: np.ndarray) -> bool:
        """
        Lock the pages that an array fills, for faster copies; return False if that is not allowed.

        Pages that it shares with others stay as they are: no copy may reach into locked ones.
        """
        self._enter()
        start = array.ctypes.data
        first, last = -(-start // PAGE) * PAGE, (start + array.nbytes) // PAGE * PAGE
        if first >= last:
            return False
        try:
            self._call('cuMemHostRegister_v2', c_void_p(first), c_size_t(last - first), 0)
        except RuntimeError:
            return False
        self._locked[start] = first, last
        return True

    def unlock(self, array: np.ndarray) -> None:
        """Undo ``lock``."""
        self._enter()
        self._call('cuMemHostUnregister', c_void_p(self._locked.pop(array.ctypes.data)[0]))

    def copy(self, target: int, source: int, size: int) -> None:
        """Begin a copy within the card."""
        self._call('cuMemcpyDtoDAsync_v2', c_uint64(target), c_uint64(source), c_size_t(size),
                   self._stream)

    def launch(self, kernel: c_void_p, parameters: np.ndarray, threads: int) -> None:
        """Begin a kernel on so many threads, or on all that the card has at once."""
        pointers = (c_void_p * 1)(parameters.ctypes.data)
        few = threads <= WARP * self.processors
        block = min(threads, WARP if few else THREADS)
        blocks = min(-(-threads // block), self.blocks(kernel))
        self._call('cuLaunchCooperativeKernel', kernel, blocks, 1, 1, block, 1, 1, 0,
                   self._stream, pointers)

    def sequence(self, launches: Sequence[tuple]) -> Callable[[], None]:
        """Return what runs (kernel, parameters, threads) in order, to the end, as one graph."""
        def all_launches() -> None:
            for each in launches:
                self.launch(*each)
        begin = self.graph(all_launches)

        def run() -> None:
            self._enter()
            begin()
            self.wait()
        return run

    def graph(self, work: Callable) -> Callable[[], None]:
        """Return what begins all launches of ``work`` again, as one CUDA graph."""
        graph, ready = c_void_p(), c_void_p()
        self._enter()
        self._call('cuStreamBeginCapture_v2', self._stream, RELAXED)
        work()
        self._call('cuStreamEndCapture', self._stream, byref(graph))
        self._call('cuGraphInstantiateWithFlags', byref(ready), graph, c_uint64(0))
        self._call('cuGraphDestroy', graph)
        return lambda: self._call('cuGraphLaunch', ready, self._stream)

    def wait(self) -> None:
        """Wait until all that was begun is done."""
        self._call('cuStreamSynchronize', self._stream)

    def seconds(self, work: Callable, times: int = 20) -> float:
        """Return the median time of ``work`` [s] by the card's clock, after a first one."""
        self._enter()
        events = [c_void_p(), c_void_p()]
        for event in events:
            self._call('cuEventCreate', byref(event), 0)
        work()
        found = []
        for _ in range(times):
            self._call('cuEventRecord', events[0], self._stream)
            work()
            self._call('cuEventRecord', events[1], self._stream)
            self._call('cuEventSynchronize', events[1])
            elapsed = ctypes.c_float()
            self._call('cuEventElapsedTime', byref(elapsed), *events)
            found.append(elapsed.value / 1e3)
        return float(np.median(found))
