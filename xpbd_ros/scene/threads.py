"""Resolve ``solver.threads: 0``. No bit of a run depends on the number of threads."""

from dataclasses import replace
from math import inf
import os
from typing import Any

from xpbd_ros.effects import load
from xpbd_ros.scene.auto import table_of
from xpbd_ros.scene.cost_table import GRID
from xpbd_ros.scene.model import MOST_THREADS, Scene, with_key
from xpbd_ros.sim.geometry.mesh import Mesh


def with_threads(scene: Scene, meshes: list[Mesh]) -> Scene:
    """Return the scene with the number of threads that ``threads: 0`` stands for."""
    keys = scene.top.solver
    if keys.threads > 0:
        return scene
    table, cores = table_of(keys), free_cores()
    grid = max((len(mesh.positions) for mesh in meshes if mesh.grid is not None), default=0)
    every = sum(len(mesh.positions) for mesh in meshes)
    least, shared = max(((table.for_thread(name), every if on_meshes(name) else grid)
                         for name in scene.effect_names if table.for_thread(name) < inf),
                        default=(inf, 0))
    count = max(paying(grid, table.for_thread(GRID), cores),
                paying(shared, least, cores))
    return replace(scene, raw=with_key(scene.raw, 'solver.threads', count),
                   top=replace(scene.top, solver=replace(keys, threads=count)))


def on_meshes(effect: str) -> bool:
    """Return True if the work of an effect that threads share is large on meshes too."""
    built: Any = load(effect).build
    return built.threads_pay_on_meshes


def paying(particles: int, per_thread: float, cores: int) -> int:
    """
    Return the number of threads that make a substep of a scene faster.

    Parameters
    ----------
    particles : of the largest grid, whose strips the threads share, or of all cloths
    per_thread : fewest particles with which a thread gains more than barriers cost
    cores : that this process may use

    """
    return max(1, min(int(particles / per_thread), cores, MOST_THREADS))


def free_cores() -> int:
    """Return the number of cores that this process may run on."""
    if hasattr(os, 'sched_getaffinity'):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
