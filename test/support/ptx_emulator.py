"""
A card that is emulated: PTX thread by thread, in any order, with every race between threads found.

    card = EmulatedCard(order='shuffled', grid=2, block=8)

has the methods of ``backend.cuda.Card``. Between two barriers each word of memory remembers who
wrote and who read it: two threads at one word, one of them writing, are a race, whatever the
values. What a block's barrier separates is a race only for threads of different blocks.
(compute-sanitizer's racecheck knows shared memory only.) Memory is consistent here; stale caches,
the assembler and the occupancy of a card are not emulated.
"""

from collections.abc import Callable, Sequence
import ctypes
from functools import cache

from llvmlite import binding as llvm
import numpy as np

from support.ptx_code import DONE, IN_BLOCK, MET, NUMBER, Translation

RACE = ('memory', 'end', 'readers', 'writers', 'epoch', 'races', 'place', 'astray', 'met')
"""
fields of the record of races, 8 bytes each: an epoch ends where all threads or those of a block
meet; all have met at the beginning of ``met``
"""
FLUSH = 0x8040
TOUCH = """
define internal void @touch(ptr %p, i64 %size, i1 %writes, i64 %place, ptr %special, ptr %race) {
  %arena = load i64, ptr %race
  %end_p = getelementptr i64, ptr %race, i64 1
  %end = load i64, ptr %end_p
  %a = ptrtoint ptr %p to i64
  %stop = add i64 %a, %size
  %under = icmp ult i64 %a, %arena
  %over = icmp ugt i64 %stop, %end
  %out = or i1 %under, %over
  br i1 %out, label %astray, label %in
astray:
  %astray_p = getelementptr i64, ptr %race, i64 7
  %astray_n = load i64, ptr %astray_p
  %astray_1 = add i64 %astray_n, 1
  store i64 %astray_1, ptr %astray_p
  ret void
in:
  %offset = sub i64 %a, %arena
  %first = lshr i64 %offset, 2
  %last_byte = sub i64 %stop, %arena
  %rounded = add i64 %last_byte, 3
  %last = lshr i64 %rounded, 2
  %readers_p = getelementptr ptr, ptr %race, i64 2
  %readers = load ptr, ptr %readers_p
  %writers_p = getelementptr ptr, ptr %race, i64 3
  %writers = load ptr, ptr %writers_p
  %epoch_p = getelementptr i64, ptr %race, i64 4
  %epoch = load i64, ptr %epoch_p
  %me_p = getelementptr i32, ptr %special, i64 NUMBER
  %me32 = load i32, ptr %me_p
  %me = zext i32 %me32 to i64
  %high = shl i64 %epoch, 32
  %met_p = getelementptr i64, ptr %race, i64 8
  %met = load i64, ptr %met_p
  %size_p = getelementptr i32, ptr %special, i64 3
  %size32 = load i32, ptr %size_p
  %size_of_block = zext i32 %size32 to i64
  %block = udiv i64 %me, %size_of_block
  %mine = or i64 %high, %me
  %many = or i64 %high, 4294967295
  br label %loop
loop:
  %word = phi i64 [%first, %in], [%word1, %next]
  %rp = getelementptr i64, ptr %readers, i64 %word
  %wp = getelementptr i64, ptr %writers, i64 %word
  %r = load i64, ptr %rp
  %w = load i64, ptr %wp
  %re = lshr i64 %r, 32
  %we = lshr i64 %w, 32
  %r_who = and i64 %r, 4294967295
  %r_block = udiv i64 %r_who, %size_of_block
  %r_since = icmp uge i64 %re, %met
  %r_else = icmp ne i64 %r_who, %me
  %r_apart = icmp ne i64 %r_block, %block
  %r_now = icmp eq i64 %re, %epoch
  %r_free = or i1 %r_apart, %r_now
  %r_may = and i1 %r_since, %r_else
  %r_other = and i1 %r_may, %r_free
  %w_who = and i64 %w, 4294967295
  %w_block = udiv i64 %w_who, %size_of_block
  %w_since = icmp uge i64 %we, %met
  %w_else = icmp ne i64 %w_who, %me
  %w_apart = icmp ne i64 %w_block, %block
  %w_now = icmp eq i64 %we, %epoch
  %w_free = or i1 %w_apart, %w_now
  %w_may = and i1 %w_since, %w_else
  %w_other = and i1 %w_may, %w_free
  %bad_r = and i1 %r_other, %writes
  %bad = or i1 %bad_r, %w_other
  br i1 %bad, label %race_found, label %fine
race_found:
  %count_p = getelementptr i64, ptr %race, i64 5
  %count = load i64, ptr %count_p
  %count1 = add i64 %count, 1
  store i64 %count1, ptr %count_p
  %place_p = getelementptr i64, ptr %race, i64 6
  store i64 %place, ptr %place_p
  br label %fine
fine:
  br i1 %writes, label %wrote, label %read
wrote:
  store i64 %mine, ptr %wp
  br label %next
read:
  %value = select i1 %r_other, i64 %many, i64 %mine
  store i64 %value, ptr %rp
  br label %next
next:
  %word1 = add i64 %word, 1
  %more = icmp ult i64 %word1, %last
  br i1 %more, label %loop, label %done
done:
  ret void
}
""".replace('NUMBER', str(NUMBER))
MODE = """
define i32 @swap(i32 %new) {
  %p = alloca i32
  call void @llvm.x86.sse.stmxcsr(ptr %p)
  %old = load i32, ptr %p
  store i32 %new, ptr %p
  call void @llvm.x86.sse.ldmxcsr(ptr %p)
  ret i32 %old
}
declare void @llvm.x86.sse.stmxcsr(ptr)
declare void @llvm.x86.sse.ldmxcsr(ptr)
"""


def compiled(code: str):
    """Return the machine code of an LLVM module for this machine, not optimised: made sooner."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    module = llvm.parse_assembly(code)
    module.verify()
    machine = llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=llvm.get_host_cpu_features().flatten(), opt=0)
    engine = llvm.create_mcjit_compiler(module, machine)
    engine.finalize_object()
    return engine


@cache
def mode():
    """Return a function that sets the floating-point mode and returns the one before."""
    engine = compiled(MODE)
    swap = ctypes.CFUNCTYPE(ctypes.c_uint32, ctypes.c_uint32)(
        engine.get_function_address('swap'))
    swap.engine = engine
    return swap


class EmulatedKernel:
    """One kernel; ``run`` takes a thread to its next stop."""

    def __init__(self, ptx: str, **options):
        translation = Translation(ptx, **options)
        self.size = translation.size
        self._engine = compiled(translation.llvm() + TOUCH)
        self.run = ctypes.CFUNCTYPE(ctypes.c_int, *[ctypes.c_void_p] * 4)(
            self._engine.get_function_address('run'))


kernel_of = cache(EmulatedKernel)


class EmulatedCard:
    """
    A card whose threads take turns on this CPU.

    Parameters
    ----------
    order : 'in turn', 'backwards', 'shuffled', or 'random' (a random thread goes on each time)
    grid, block : blocks of a launch, and threads of a block
    seed : of the order
    step : True to change threads before each access to memory, with the order 'random'
    barrier_too : True to run the barrier's own instructions instead of one that holds

    """

    name, arch = 'emulator', 'sm_90'

    def __init__(self, *, order: str = 'shuffled', grid: int = 2, block: int = 8, seed: int = 0,
                 **options):
        self.order, self.grid, self.block, self.options = order, grid, block, options
        self.races = self.astray = self.barriers = self.launches = 0
        self.locked: set[int] = set()
        self.told: dict[int, int] = {}
        """races by the place of a kernel in the frame"""
        self._pick = np.random.default_rng(seed)
        self._memory = np.zeros(0, np.uint8)

    def load(self, ptx: str) -> EmulatedKernel:
        """Return a kernel."""
        return kernel_of(ptx, **self.options)

    def allocate(self, size: int) -> int:
        """Return the address of memory, aligned as on a card; there is one piece of it."""
        self._memory = np.zeros(size + 512, np.uint8)
        self._start = 256 * -(-self._memory.ctypes.data // 256)
        self._end = self._start + size
        self._readers, self._writers = np.zeros((2, size // 4 + 2), np.int64)
        self._epoch = 0
        return self._start

    def free(self, address: int) -> None:
        """Forget the memory."""

    def put(self, address: int, array: np.ndarray) -> None:
        """Copy an array to the card."""
        assert self._start <= address and address + array.nbytes <= self._end
        ctypes.memmove(address, array.ctypes.data, array.nbytes)

    def get(self, address: int, array: np.ndarray) -> None:
        """Copy from the card into an array."""
        assert self._start <= address and address + array.nbytes <= self._end
        ctypes.memmove(array.ctypes.data, address, array.nbytes)

    def lock(self, array: np.ndarray) -> bool:
        """Note that the pages of an array are locked."""
        assert array.ctypes.data not in self.locked
        self.locked.add(array.ctypes.data)
        return True

    def unlock(self, array: np.ndarray) -> None:
        """Undo ``lock``."""
        self.locked.remove(array.ctypes.data)

    def sequence(self, launches: Sequence[tuple]) -> Callable[[], None]:
        """Return what runs (kernel, parameters, threads), in order."""
        def run():
            for k, (kernel, parameters, threads) in enumerate(launches):
                before = self.races
                self.launch(kernel, parameters, *(
                    (1, 1) if threads == 1 else (self.grid, self.block)))
                if self.races > before:
                    self.told[k] = self.told.get(k, 0) + self.races - before
        return run

    def launch(self, kernel: EmulatedKernel, parameters: np.ndarray, grid, block) -> None:
        """Run one kernel to its end."""
        special = places(grid, block)
        registers = np.zeros((len(special), kernel.size), np.uint8)
        self._epoch += 1
        race = np.array([self._start, self._end, self._readers.ctypes.data,
                         self._writers.ctypes.data, self._epoch, 0, 0, 0, self._epoch], np.int64)
        threads = [(registers.ctypes.data + k * kernel.size, parameters.ctypes.data,
                    special.ctypes.data + k * special.strides[0], race.ctypes.data)
                   for k in range(len(special))]
        before = mode()(0x1f80)
        mode()(before | FLUSH)
        try:
            self._turns(kernel.run, threads, race, block)
        finally:
            mode()(before)
        self._epoch = int(race[RACE.index('epoch')])
        self.races += int(race[RACE.index('races')])
        self.astray += int(race[RACE.index('astray')])
        self.launches += 1

    def _turns(self, run, threads, race, size) -> None:
        """
        Let threads go on until all are done; ``size`` is that of a block.

        Where all others have come to a barrier, a block whose threads are at its own one goes on.
        """
        ready, met = list(range(len(threads))), []
        here: dict[int, list[int]] = {}    # at the barrier of each block
        full: list[int] = []    # blocks all of whose threads are there
        while ready or met or full:
            if not ready and full:
                ready = here.pop(full.pop(0))
                race[RACE.index('epoch')] += 1
            elif not ready:    # all that still run have come to the barrier
                assert not here, 'threads of a block wait for one that has gone elsewhere'
                ready, met = sorted(met), []
                race[RACE.index('epoch')] += 1
                race[RACE.index('met')] = race[RACE.index('epoch')]
                self.barriers += 1
            todo, ready = self._next(ready)
            for k in todo:
                why = run(*threads[k])
                if why == MET:
                    met.append(k)
                elif why == IN_BLOCK:
                    waiting = here.setdefault(k // size, [])
                    waiting.append(k)
                    if len(waiting) == size and self.options.get('barrier_too'):
                        ready += here.pop(k // size)    # others look again and again
                    elif len(waiting) == size:
                        full.append(k // size)
                elif why != DONE:
                    ready.append(k)
        assert not here, 'threads of a block wait for one that has ended'

    def _next(self, ready: list[int]) -> tuple[list[int], list[int]]:
        """Return the threads that go on now, in order, and those that do not."""
        if self.order == 'random':
            j = int(self._pick.integers(len(ready)))
            return [ready[j]], ready[:j] + ready[j + 1:]
        order = {'in turn': ready, 'backwards': ready[::-1]}.get(self.order)
        return (self._pick.permutation(ready).tolist() if order is None else order), []


def places(grid, block) -> np.ndarray:
    """Return the record ``special`` of each thread, shape (threads, NUMBER + 1)."""
    return np.array([(k % block, 0, 0, block, 1, 1, k // block, 0, 0, grid, 1, 1, k % 32, k)
                     for k in range(grid * block)], np.int32)
