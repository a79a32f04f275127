"""
``solver.device: cuda``: the CPU's bits, races, speed, registers, and a model of all of them.

    python benchmark/gpu.py                            all of it: needs an NVIDIA card
    python benchmark/gpu.py --what registers model     without a card

A sheet of n × n particles hangs by a corner: stretch, shear, bend, float32, SUBSTEPS a frame. With
contact it lies on a plane and a ball, with friction.

bits         frames on the card against the same frames on the CPU, REPEATS times, without and with
             contact: a race between threads that the emulator of the tests cannot show would give
             other bits at times
speed        time of a frame by the card's clock, and of a whole step by the host's; the bytes that
             its kernels must move at least over that time, against a measured copy within the card
contact      the times of a sheet with contact, on the card and on one thread of this CPU
registers    of each kernel, by NVIDIA's assembler ptxas (of the wheel nvidia-cuda-nvcc, or PATH)
model        what a substep should take: those bytes at half of a card's bandwidth, and barriers
"""

import argparse
from importlib.util import find_spec
from pathlib import Path
import re
import shutil
import subprocess
import sys
import tempfile
from time import perf_counter

import numpy as np

from xpbd_ros.cli.output import add_json_argument, refuse_existing, STDOUT, write_json
from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import scene_from_mapping
from xpbd_ros.sim.backend import cuda
from xpbd_ros.sim.backend.device_kernel import compile_kernels
from xpbd_ros.sim.constraints.grid_batches import listed
from xpbd_ros.sim.stepping.launches import flattened, launches_of, Shared

EFFECTS = {'stretch': {'warp': 500.0, 'weft': 500.0}, 'shear': {'stiffness': 20.0},
           'bend': {'stiffness': 1e-4}}
WHAT = ('bits', 'speed', 'contact', 'registers', 'model')
SIZES = {'bits': (16, 33, 100), 'speed': (100, 316, 1000, 2000),
         'contact': (100, 316, 1000), 'registers': (16,),
         'model': (100, 316, 1000, 2000)}
"""particles along an edge"""
SUBSTEPS, FRAMES, REPEATS = 4, 3, 50
COPY = 2**31
"""bytes of the copy within the card"""
MODELLED = {'H100': (3016.0, 5.0), 'RTX 5090': (1700.0, 5.0), 'Orin AGX': (180.0, 10.0)}
"""bandwidth of a copy [GB/s], time of a barrier with its share of the launches [µs]: measured for
the H100, assumed for the others"""
SHARE = 0.5
"""of that bandwidth"""
ARCHES = ('sm_90', 'sm_87')
THREADS, REGISTERS = 256, 65536
"""of a block, of a processor"""
PER_PARTICLE = 17
"""numbers that ``update_velocity_and_begin`` reads and writes of a particle"""


def sheet(n: int, device: str = 'cpu', *, contact: bool = False):
    """Return a sheet of n × n particles; its particles are displaced at random."""
    colliders = {
        'effects': {'contact': {'thickness': 0.5 / n}, 'friction': {}},
        'colliders': {'table': {'plane': {}, 'position': [0.0, 0.0, -0.4 / n]},
                      'ball': {'sphere': {'radius': 0.2}, 'position': [0.5, 0.5, -0.15]}}}
    simulation = compile_scene(scene_from_mapping({
        'solver': {'precision': 'float32', 'substeps': SUBSTEPS, 'method': 'gauss_seidel',
                   'integrator': 'backward_euler', 'order': 'coloured', 'device': device},
        'cloths': {'c': {'grid': {'size': [1.0, 1.0], 'resolution': [n, n]}, 'density': 0.2,
                         'effects': EFFECTS}},
        'pins': {'a': {'cloth': 'c', 'at': 'corner_00'}},
        **(colliders if contact else {})}, where='benchmark', name='sheet'))
    state, slot = simulation.state, simulation.slot
    noise = np.random.default_rng(n).normal(0.0, 0.1 / n, (3, len(slot)))
    state.x[:, slot] += (noise * (state.inv_mass[slot] > 0.0)).astype(state.x.dtype)
    return simulation


def batches(simulation):
    """Yield the batches of constraints of a sheet."""
    for built in simulation.effects.values():
        for part in built.parts:
            batch = getattr(part, 'edges', part)
            if hasattr(batch, 'runs'):
                yield batch


def traffic(simulation) -> tuple[float, int]:
    """Return the bytes that a substep must move, if no cache keeps them, and its barriers."""
    width, numbers, barriers = simulation.state.x.itemsize, 0, 1
    for batch in batches(simulation):
        count, particles = len(listed(batch.runs)[1]), batch.runs.offset.shape[1]
        force = 0 if batch.force is None else 2 * (batch.force.size // batch.force.shape[-1])
        numbers += count * (7 * particles + force)    # x and m read, x written
        barriers += len(batch.runs.colour) - 1
    return float(width * (numbers + PER_PARTICLE * len(simulation.slot))), barriers


def bits(n: int, card) -> list[dict]:
    """Compare frames on the card with those on the CPU, again and again."""
    found = []
    for contact in (False, True):
        ours, theirs = (sheet(n, device, contact=contact) for device in ('cpu', 'cuda'))
        right, wrong, start = run(ours), 0, theirs.save()
        for _ in range(REPEATS):
            theirs.restore(start)
            wrong += run(theirs) != right
        found.append({'particles': n * n, 'contact': contact, 'repeats': REPEATS,
                      'repeats_with_other_bits': wrong})
    return found


def run(simulation) -> tuple:
    """Return the hash of a few frames, and the forces on the colliders."""
    for _ in range(FRAMES):
        frame = simulation.step()
    return simulation.hash(), *(tuple(each.force) for each in frame.colliders.values())


def copied(card) -> float:
    """Return the bandwidth of a copy within the card [GB/s], read and written."""
    a, b = card.allocate(COPY), card.allocate(COPY)
    taken = card.seconds(lambda: card.copy(b, a, COPY))
    card.free(a)
    card.free(b)
    return 2e-9 * COPY / taken


def speed(n: int, card) -> dict:
    """Time frames by the card's clock, and steps of the simulation by that of the host."""
    simulation = sheet(n, 'cuda')
    step, frame = step_time(simulation), simulation._crew.frame
    taken, (bytes_, _) = card.seconds(frame), traffic(simulation)
    ceiling, found = copied(card), 1e-9 * bytes_ * SUBSTEPS / taken
    return {'particles': n * n, 'frame_ms': 1e3 * taken, 'step_ms': 1e3 * step,
            'substep_us': 1e6 * taken / SUBSTEPS,
            'gb_per_s': found, 'copy_gb_per_s': ceiling, 'share_of_copy': found / ceiling,
            'substeps_at_60_hz': SUBSTEPS / (60.0 * taken)}


def step_time(simulation) -> float:
    """Return the median time of a step of the simulation by the host's clock [s]."""
    steps = []
    for _ in range(9):
        begin = perf_counter()
        simulation.step()
        steps.append(perf_counter() - begin)
    return float(np.median(steps[1:]))


def contact(n: int, card) -> dict:
    """Time frames of a sheet that lies on a plane and a ball."""
    simulation = sheet(n, 'cuda', contact=True)
    step = step_time(simulation)
    taken = card.seconds(simulation._crew.frame)
    return {'particles': n * n, 'contacts': simulation.stats()['contacts'],
            'frame_ms': 1e3 * taken, 'step_ms': 1e3 * step, 'substep_us': 1e6 * taken / SUBSTEPS,
            'substeps_at_60_hz': SUBSTEPS / (60.0 * taken),
            'cpu_step_ms': 1e3 * step_time(sheet(n, contact=True))}


def registers(n: int, card) -> list[dict]:
    """Return the registers of each kernel, by ptxas."""
    assembler, simulation, found = ptxas(), sheet(n), []
    launches = launches_of(
        simulation._tuple, simulation.state, simulation._method(), simulation.frame_dt, SUBSTEPS,
        Shared(np.zeros(1, np.int64), np.zeros(2, np.int64)))
    for arch in ARCHES:
        unique = {launch.request(arch).key: launch for launch in flattened(launches)}
        kernels = compile_kernels([launch.request(arch) for launch in unique.values()])
        for launch, ptx in zip(unique.values(), kernels):
            said = assembled(assembler, ptx, arch)
            used = int(re.search(r'Used (\d+) registers', said)[1])
            spilled = int((re.search(r'(\d+) bytes spill stores', said) or [0, 0])[1])
            found.append({'arch': arch, 'kernel': launch.name, 'registers': used,
                          'spilled_bytes': spilled, 'ptx_bytes': len(ptx), 'blocks':
                          REGISTERS // (THREADS * 8 * -(-used // 8))})
    return found


def ptxas() -> str:
    """Return NVIDIA's assembler."""
    spec = find_spec('nvidia')
    for folder in (spec.submodule_search_locations or []) if spec else []:
        for file in Path(folder).glob('*/bin/ptxas'):
            return str(file)
    found = shutil.which('ptxas')
    if found is None:
        raise InputError('registers: there is no ptxas; pip install nvidia-cuda-nvcc')
    return found


def assembled(assembler: str, ptx: str, arch: str) -> str:
    """Return what the assembler says of a kernel."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / 'kernel.ptx'
        file.write_text(ptx)
        done = subprocess.run([assembler, '-v', f'-arch={arch}', file, '-o', file.with_suffix(
            '.cubin')], capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f'ptxas: {done.stderr}')
    return done.stderr


def model(n: int, card) -> list[dict]:
    """Return what a substep should take on some cards."""
    few = min(n, 316)    # a larger sheet has the same bytes per particle
    bytes_, barriers = traffic(sheet(few))
    bytes_ *= (n / few)**2
    found = []
    for name, (copy, barrier) in MODELLED.items():
        taken = bytes_ / (SHARE * copy * 1e3) + barriers * barrier
        found.append({'card': name, 'particles': n * n, 'bytes_per_particle': bytes_ / n**2,
                      'barriers': barriers, 'substep_us': taken,
                      'share_of_barriers': barriers * barrier / taken,
                      'substeps_at_60_hz': 1e6 / 60.0 / taken})
    return found


def tell(what: str, row: dict) -> None:
    """Print one row."""
    print(f'{what}: ' + ', '.join(
        f'{key} {value:.4g}' if isinstance(value, float) else f'{key} {value}'
        for key, value in row.items()), flush=True)


def parser() -> argparse.ArgumentParser:
    found = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    found.add_argument('--what', nargs='+', choices=WHAT, default=list(WHAT))
    found.add_argument('--sizes', nargs='+', type=int, metavar='N',
                       help='particles along an edge, instead of those of each part')
    add_json_argument(found)
    return found


def main(argv: list[str] | None = None) -> int:
    """Measure, and tell the figures."""
    arguments = parser().parse_args(argv)
    try:
        refuse_existing(arguments.json)
        needs_card = {'bits', 'speed', 'contact'} & set(arguments.what)
        card = cuda.Card() if needs_card else None
        found: dict = {'card': None if card is None else card.name}
        for what in arguments.what:
            found[what] = []
            for n in arguments.sizes or SIZES[what]:
                rows = globals()[what](n, card)
                for row in rows if isinstance(rows, list) else [rows]:
                    if arguments.json != STDOUT:
                        tell(what, row)
                    found[what].append(row)
        write_json(arguments.json, found)
    except InputError as error:
        print(f'gpu.py: {error}', file=sys.stderr)
        return 2
    return 0


if __name__ == '__main__':
    sys.exit(main())
