"""Resolve ``solver.threads: 0``. No bit of a run depends on the number of threads."""

from dataclasses import replace
import os

from xpbd_ros.scene.auto import table_of
from xpbd_ros.scene.model import MOST_THREADS, Scene, with_key
from xpbd_ros.sim.geometry.mesh import Mesh


def with_threads(scene: Scene, meshes: list[Mesh]) -> Scene:
    """Return the scene with the number of threads that ``threads: 0`` stands for."""
    keys = scene.top.solver
    if keys.threads > 0:
        return scene
    largest = max((len(mesh.positions) for mesh in meshes if mesh.grid is not None), default=0)
    count = paying(largest, table_of(keys).particles_per_thread, free_cores())
    return replace(scene, raw=with_key(scene.raw, 'solver.threads', count),
                   top=replace(scene.top, solver=replace(keys, threads=count)))


def paying(particles: int, per_thread: float, cores: int) -> int:
    """
    Return the number of threads that make a substep of a scene faster.

    Parameters
    ----------
    particles : of the largest grid, whose strips the threads share
    per_thread : fewest particles with which a thread gains more than barriers cost
    cores : that this process may use

    """
    return max(1, min(int(particles / per_thread), cores, MOST_THREADS))


def free_cores() -> int:
    """Return the number of cores that this process may run on."""
    if hasattr(os, 'sched_getaffinity'):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
