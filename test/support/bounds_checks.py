"""
Every effect with every method, hard cases and random scenes, with bounds checks; as a program.

    export NUMBA_BOUNDSCHECK=1 PYTHONPATH=.:test
    python -m support.bounds_checks effects|stress|random|fold [COUNT]

An access outside an array is an IndexError, so it ends the program. What was run is printed.
"""

from itertools import product
import random
import sys
import time

from numba import config
import numpy as np

from support.meshes import box_surface, disc, file_of
from support.scenes import EXAMPLES, run, SETTINGS, SHAPES, simulate, with_effects
from xpbd_ros.effects import EFFECTS
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import load_scene, scene_from_mapping
from xpbd_ros.sim.backend.simd_records import PACK
from xpbd_ros.study.stress import all_hard

METHODS = [('line', 'bdf2', 'surface', 'grid'),
           ('gauss_seidel', 'backward_euler', 'particles', 'grid'),
           ('jacobi', 'bdf2', 'surface', 'mesh')]
"""of random scenes: each compiles for minutes"""
HOSTILE = [0.0, 1.0, 30.0, 1e4, 1e12, 1e19, 1e300, np.inf, np.nan]
"""speeds and displacements [m/s, m] of some particles"""


def planted() -> None:
    """Fail unless an access is seen where it is linked into a step: by vector, by number."""
    assert config.BOUNDSCHECK
    effects = {'stretch': EXAMPLES['stretch']}
    for spoil in ('gather', 'number'):
        simulation = simulate(mesh=True, effects=effects, scene_effects={
            'self_collision': {'thickness': 0.01}})
        run(simulation, 1)
        if spoil == 'gather':
            simulation.effects['stretch'].data.edges.particles[0, PACK - 1] = 10**6
        else:
            simulation.effects['self_collision'].data.near.slot[3] = 10**6
        try:
            simulation.step()
        except IndexError:
            continue
        raise AssertionError(f'{spoil}: not seen')


def effects() -> str:
    """Run every effect with every method and integrator, on grids and on meshes."""
    scenes = frames = 0
    for (method, integrator), mesh, precision in product(SETTINGS, (False, True),
                                                         ('float64', 'float32')):
        never = {*(('strain_limit', 'tether') if integrator == 'ndf2' else ()),
                 *(('shear',) if mesh else ())}
        names = [name for name in EFFECTS if name not in never]
        solver = {'method': method, 'integrator': integrator, 'precision': precision,
                  'substeps': 60 if method == 'explicit' else 3,
                  'iterations': 1 if method == 'explicit' else 2}
        pins = {'a': {'cloth': 'c', 'at': [0, 1]}}
        bodies = [simulate(mesh=file_of(*make()), effects={name: EXAMPLES[name]}, pins=pins,
                           scene_effects={'pin': {}}, **solver)
                  for name, make in SHAPES.items()] if mesh else []
        for simulation in (with_effects((7, 6), names=names, mesh=mesh, pins=pins, **solver),
                           *bodies):
            run(simulation, 12)
            scenes, frames = scenes + 1, frames + 12
        print(method, integrator, precision, 'mesh' if mesh else 'grid', flush=True)
    return f'{len(EFFECTS)} effects, {len(SETTINGS)} settings: {scenes} scenes, {frames} frames'


def stress() -> str:
    """Run the hard cases at all their settings."""
    attempts = [attempt for case in all_hard() for attempt in case.attempts()]
    for k, attempt in enumerate(attempts):
        if k % 20 == 0:
            print(k, 'of', len(attempts), attempt.name, flush=True)
        attempt.outcome()
    return f'{len(attempts)} hard cases'


def random_scene(noise: random.Random, how: tuple[str, ...]):
    """Return a scene of one to three cloths of any size among colliders of every kind."""
    method, integrator, mode, kind = how
    size, cloths = 10.0**noise.uniform(-1.0, 0.5), {}
    for name in 'abc'[:noise.randint(1, 3)]:
        if kind == 'mesh':
            shape = {'mesh': {'file': file_of(*disc(noise.randint(1, 3), size))}}
        else:
            shape = {'grid': {'size': [size, size * noise.uniform(0.3, 3.0)],
                              'resolution': [noise.randint(2, 8), noise.randint(2, 8)]}}
        cloths[name] = {**shape, 'density': 0.2, 'pose': {'position': [
            noise.uniform(-size, size) for _ in range(3)]}, 'effects': {
                'stretch': {'warp': 10.0**noise.uniform(0.0, 4.0), 'weft': 100.0},
                'bend': {'stiffness': 1e-4}, 'strain_limit': {'max': 0.1}, 'tether': {}}}
    vertices, faces = box_surface(0.3 * size, 0.1 * size, 0.2 * size)
    colliders = {'plane': {'plane': {}, 'position': [0.0, 0.0, -size]},
                 'ball': {'sphere': {'radius': 0.3 * size}},
                 'mesh': {'mesh': {'file': file_of(vertices, faces), 'spacing': 0.05 * size}},
                 'heights': {'heights': {'size': [size, size], 'values': [
                     [noise.uniform(0.0, size) for _ in range(5)] for _ in range(4)]}}}
    return compile_scene(scene_from_mapping({
        'solver': {'method': method, 'integrator': integrator,
                   'substeps': noise.randint(1, 4), 'iterations': noise.randint(1, 2)},
        'cloths': cloths, 'pins': {'p': {'cloth': 'a', 'at': [noise.randint(0, 3)]}},
        'colliders': colliders, 'effects': {
            'contact': {'thickness': 0.01 * size}, 'friction': {}, 'self_collision': {
                'thickness': size * 10.0**noise.uniform(-3.0, -1.0), 'mode': mode,
                'room': noise.choice([1, 2, 24])}}}, where='random', name='random'))


def random_scenes(count: int = 500, seed: int = 1) -> str:
    """Run random scenes, each with particles that are where none should be, or far too fast."""
    frames, taken_back, without_room, slowest = 0, 0, 0, 0.0
    for k in range(count):
        noise = random.Random(f'{seed} {k}')
        simulation = random_scene(noise, METHODS[k * len(METHODS) // count])
        state, slot = simulation.state, simulation.slot
        for _ in range(noise.randint(2, 8)):
            for array in (state.x, state.v):
                some = slot[[noise.randrange(len(slot)) for _ in range(noise.randint(0, 6))]]
                array[:, some] += noise.choice(HOSTILE) * np.array(
                    [[noise.gauss(0.0, 1.0)] for _ in range(3)])
            start = time.perf_counter()
            with np.errstate(all='ignore'):
                simulation.step()
                stats = simulation.stats()
            slowest = max(slowest, time.perf_counter() - start) if k else 0.0
            frames += 1
            without_room += stats['self_without_room'] > 0
        taken_back += stats['frames_taken_back']
        if k % 20 == 0:
            print(k, 'of', count, f'{slowest:.1f} s', flush=True)
    return (f'{count} random scenes, {frames} frames, {taken_back} taken back, {without_room} '
            f'without room for all pairs, slowest {slowest:.1f} s')


def fold(seconds: float = 2.5, **solver) -> str:
    """Fold the shipped scene's cloth, of 64 x 64 particles."""
    simulation = compile_scene(load_scene('fold', {
        'cloths.napkin.grid.resolution': [64, 64],
        **{f'solver.{key}': value for key, value in solver.items()}}))
    frames = round(seconds / simulation.frame_dt)
    for _ in range(frames):
        simulation.step()
    return f'fold at 64 x 64, {frames} frames, {simulation.solver}'


if __name__ == '__main__':
    planted()
    what, *more = sys.argv[1:]
    print({'effects': effects, 'stress': stress, 'random': random_scenes, 'fold': fold}[what](
        *map(int, more)), flush=True)
