"""
Simulate for hours, as fast as it goes, under random commands; nothing may grow.

    python test/support/soak.py [HOURS] [--default]

With ``--default`` the solver is ``auto`` as it ships, else plain Gauss-Seidel whose number of
substeps changes. Memory, file handles and the time stamps are checked, and of Gauss-Seidel, which
damps, the energy. At the end the released cloth must come to rest within ten seconds, whatever the
pins have stretched it by; then the scene is reset and must do, bit for bit, what it does when it
is new: nothing has added up. The exit code is 1 where something got worse.
``test/test_soak.py`` does the same for less long.
"""

import os
from pathlib import Path
import random
import resource
import sys
import time

import numpy as np

from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import load_scene
from xpbd_ros.sim import measure
from xpbd_ros.sim.commands import (
    Grasp,
    MoveCollider,
    MovePin,
    Pose,
    Release,
    ReleaseAll,
    Reset,
    SetKey,
)

MEGABYTE = 2**20


def command(noise: random.Random, frame, keys: dict):
    """Return something that a robot might ask for; of a solver with ``keys`` also its substeps."""
    x, y, z = (noise.uniform(-0.4, 0.4) for _ in range(3))
    point = Pose(tuple(frame.x[noise.randrange(len(frame.x))].tolist()))
    number = [SetKey('solver.substeps', noise.randint(6, 12))] if keys else []
    return noise.choice([
        Grasp(noise.choice('abc'), point, 0.05), Release(noise.choice('abc')), ReleaseAll(),
        MovePin(noise.choice('abc'), Pose((x, y, 0.4 + z))),
        MoveCollider('sphere', Pose((x, y, 0.2 + abs(z)))),
        SetKey('gravity', [0.0, 0.0, -9.80665 * noise.uniform(0.5, 1.5)]), *number])


def handles() -> int:
    """Return how many files are open."""
    return len(os.listdir('/proc/self/fd'))


def memory() -> int:
    """Return the memory in use [bytes]."""
    return int(Path('/proc/self/statm').read_text().split()[1]) * resource.getpagesize()


PLAIN = {'solver.method': 'gauss_seidel', 'solver.integrator': 'backward_euler',
         'solver.substeps': 8}
"""keys of a solver that keeps its method"""


def small_demo(keys: dict):
    """Return the demo with a coarse towel, and with these keys of its solver."""
    return compile_scene(load_scene('demo', {**keys, 'cloths.towel.grid.resolution': [13, 17]}))


def later(simulation, commands) -> list[np.ndarray]:
    """Return positions and velocities a second after some commands."""
    for _ in range(60):
        frame = simulation.step(commands)
        commands = []
    return [frame.x, frame.v]


def soak(seconds: float, keys: dict = PLAIN, *, say=lambda text: None) -> dict:
    """Run for so long and return the figures at the end and what got worse."""
    simulation = small_demo(keys)
    simulation.compile()
    new = later(small_demo(keys), [])
    noise, frame = random.Random(1), simulation.step()
    energies = []
    minute, worst = round(60 * simulation.frame_rate), []
    begin, first = time.perf_counter(), None
    frames = round(seconds * simulation.frame_rate)
    for k in range(2, frames + 1):
        asked = [command(noise, frame, keys)] if noise.random() < 0.05 else []
        frame = simulation.step(asked)
        assert frame.time_ns == round(k * 10**9 / simulation.frame_rate), 'times are exact'
        if k % 60 == 0 and not (np.isfinite(frame.x).all() and np.isfinite(frame.v).all()):
            worst.append(f'not finite at {k}')
            break
        if k % 60 == 0:
            energies.append(measure.kinetic_energy(simulation.state))
        if k % minute == 0 or k == frames:
            now = {'memory': memory(), 'handles': handles()}
            first = first or now
            say(f'{k / minute:.0f} min: {now["memory"] / MEGABYTE:.1f} MB, '
                f'{now["handles"]} files, strain {measure.largest_strain(simulation):.3g}')
    simulation.step([ReleaseAll()])
    for _ in range(600):
        frame = simulation.step()
    found = {'frames': simulation.index, 'times real time':
             seconds / (time.perf_counter() - begin), 'grown_mb':
             (memory() - first['memory']) / MEGABYTE, 'handles': handles() - first['handles'],
             'speed_at_rest': float(np.abs(frame.v).max()),
             'strain': measure.largest_strain(simulation),
             'energy_grown': float(np.median(energies[len(energies) // 2:])
                                   / np.median(energies[:len(energies) // 2])),
             'frames_taken_back': simulation.stats()['frames_taken_back'],
             'method_switches': simulation.stats().get('method_switches', 0)}
    if found['grown_mb'] > 4.0:
        worst.append('memory grows')
    if found['handles'] > 0:
        worst.append('files are left open')
    if found['frames_taken_back']:
        worst.append('frames were taken back')
    number = [SetKey('solver.substeps', keys['solver.substeps'])] if keys else []
    again = later(simulation, [SetKey('gravity', [0.0, 0.0, -9.80665]), *number, Reset()])
    if not all(np.array_equal(a, b) for a, b in zip(again, new)):
        worst.append('after a reset it is not as when it was new')
    if keys and not found['energy_grown'] < 2.0:    # without damping, pins decide on it
        worst.append('energy grows')
    if not (found['strain'] < 0.1 and found['speed_at_rest'] < 0.05):
        worst.append('the released cloth does not come to rest')
    return {**found, 'worse': worst}


if __name__ == '__main__':
    hours = [word for word in sys.argv[1:] if word != '--default']
    result = soak(3600.0 * float(hours[0] if hours else 1.0),
                  {} if '--default' in sys.argv else PLAIN,
                  say=lambda text: print(text, flush=True))
    print(result)
    sys.exit(1 if result['worse'] else 0)
