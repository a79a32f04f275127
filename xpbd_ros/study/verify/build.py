"""Scenes of the cases: one cloth ``c``, level unless it has a pose."""

import numpy as np

from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import scene_from_mapping
from xpbd_ros.sim.simulation import Frame, Simulation

G = 9.80665
DOWN = (0.0, 0.5**0.5, 0.0, 0.5**0.5)
"""quaternion of a cloth whose warp points down"""
BE, BDF2, NDF2 = 'backward_euler', 'bdf2', 'ndf2'


def build(grid=(2, 1), size=(1.0, 1.0), effects=None, *, density=1.0, gravity=(0.0, 0.0, -G),
          pose=None, rate=60.0, substeps=1, iterations=1, method='gauss_seidel', integrator=BE,
          friction=0.5, effects_=None, mesh=None, **sections) -> Simulation:
    """
    Return the simulation of one cloth.

    The scene always has the effect ``pin``, so that cases with the same effects share kernels.

    Parameters
    ----------
    grid, size : resolution, and extent [m]
    effects, effects_ : effects of the cloth, and of the scene
    density, gravity, pose, friction : keys of the scene
    rate : frame rate [Hz]
    substeps, iterations, method, integrator : solver; None leaves a key to ``auto``
    mesh : file, instead of the grid
    sections : further sections of the scene, such as ``pins``

    """
    scene = {'gravity': list(gravity), 'frame_rate': rate,
             'solver': {key: value for key, value in (
                 ('method', method), ('integrator', integrator), ('substeps', substeps),
                 ('iterations', iterations)) if value is not None},
             'cloths': {'c': {**({'mesh': {'file': str(mesh)}} if mesh else {
                 'grid': {'size': list(size), 'resolution': list(grid)}}), 'density': density,
                              'friction': friction, 'pose': pose or {},
                              'effects': effects or {}}}, **sections}
    scene['effects'] = {'pin': {}, **(effects_ or {})}
    return compile_scene(scene_from_mapping(scene, where='a case', name='case'))


def hold(**pins) -> dict:
    """Return a ``pins`` section; each pin is a value of ``at``, or a whole entry."""
    return {name: {'cloth': 'c', **(pin if isinstance(pin, dict) else {'at': pin})}
            for name, pin in pins.items()}


def place(simulation: Simulation, x, v=None) -> None:
    """Set positions [m] and velocities [m/s] in natural order, shapes (particles, 3)."""
    simulation.state.x[:, simulation.slot] = np.asarray(x, float).T
    simulation.state.x_prev[:] = simulation.state.x
    if v is not None:
        simulation.state.v[:, simulation.slot] = np.asarray(v, float).T


def run(simulation: Simulation, frames: int) -> Frame:
    """Advance by some frames, and return the last one."""
    for _ in range(frames):
        frame = simulation.step()
    return frame


def crossing(times, values, level: float = 0.0) -> float:
    """Return the first time at which values cross a level, by cubic interpolation."""
    y = np.asarray(values, float) - level
    k = int(np.flatnonzero(np.sign(y[:-1]) * np.sign(y[1:]) <= 0.0)[0])
    a = min(max(k - 1, 0), len(y) - 4)
    t = np.asarray(times, float)[a:a + 4]
    middle = t[0]
    roots = np.roots(np.polyfit(t - middle, y[a:a + 4], 3))
    real = roots[np.abs(roots.imag) < 1e-9].real + middle
    low, high = times[k] - 1e-12, times[k + 1] + 1e-12
    return float(real[(real >= low) & (real <= high)][0])
