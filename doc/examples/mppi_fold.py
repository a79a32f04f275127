"""
MPPI folds a towel: rollouts of random gripper motions, weighted by how well they fold.

Model predictive path integral control (Williams et al., 2017): each round perturbs the present
motion, rolls all candidates out from the same state, and takes their mean with the weights
exp(-(cost - least cost) / temperature). Two grippers hold the corners of an edge and move
alike, in the plane across the fold; they begin with a lift that does not fold.
"""

from pathlib import Path
import sys

import numpy as np

import xpbd_ros
from xpbd_ros import Grasp, MovePin, Pose, Release

SIZE, COUNT, THICKNESS = 0.3, 13, 0.004
TOWEL = {
    'cloths': {'towel': {
        'grid': {'size': [SIZE, SIZE], 'resolution': [COUNT, COUNT]}, 'density': 0.3,
        'pose': {'position': [0.0, 0.0, THICKNESS]}, 'friction': 0.6,
        'effects': {'stretch': {'warp': 300.0, 'weft': 300.0}, 'shear': {'stiffness': 20.0},
                    'bend': {'stiffness': 2e-4}}}},
    'colliders': {'table': {'plane': {'normal': [0, 0, 1]}, 'friction': 0.6}},
    'effects': {'pin': {'max_pins': 2}, 'contact': {'thickness': THICKNESS}, 'friction': {},
                'self_collision': {'thickness': THICKNESS}, 'damping': {'rate': 1.0}},
    'solver': {'method': 'gauss_seidel', 'integrator': 'bdf2', 'substeps': 8}}
KNOTS, MOVING, RESTING = 6, 60, 20
"""points of a motion, frames that it takes, and frames after the release"""
NOISE, DECAY, TEMPERATURE = 0.02, 0.8, 0.1
"""standard deviation of the knots' steps [m], its factor from round to round; temperature over the
spread of the costs"""
CORNERS = {'left': (0.0, SIZE), 'right': (SIZE, SIZE)}


def start() -> xpbd_ros.Simulation:
    """Return the towel on the table, its far corners grasped."""
    simulation = xpbd_ros.load(TOWEL)
    simulation.step([Grasp(name, Pose((x, y, THICKNESS)), 0.01)
                     for name, (x, y) in CORNERS.items()])
    return simulation


def path(steps: np.ndarray) -> np.ndarray:
    """Return y and z of the grippers by frame [m], shape (MOVING, 2), from the knots' steps."""
    knots = np.cumsum([[SIZE, THICKNESS], *steps], axis=0)
    times = np.linspace(0.0, KNOTS, MOVING + 1)[1:]
    found = np.stack([np.interp(times, range(KNOTS + 1), knots[:, k]) for k in (0, 1)], axis=1)
    found[:, 1] = np.maximum(found[:, 1], THICKNESS)
    return found


def commands(steps: np.ndarray) -> list[list]:
    """Return the commands of all frames: move, let go, rest."""
    moves = [[MovePin(name, Pose((x, y, z))) for name, (x, _) in CORNERS.items()]
             for y, z in path(steps)]
    return [*moves, [Release(name) for name in CORNERS], *([] for _ in range(RESTING - 1))]


def goal() -> np.ndarray:
    """Return the particles of the folded towel [m]: the far half lies on the near one."""
    x, y = np.meshgrid(*2 * [np.linspace(0.0, SIZE, COUNT)])
    far = y > 0.5 * SIZE
    return np.stack([x, np.where(far, SIZE - y, y),
                     np.where(far, 2.0, 1.0) * THICKNESS], axis=-1).reshape(-1, 3)


def last(frames) -> np.ndarray:
    """Return the positions at the end of a rollout [m]."""
    *_, end = frames
    return end.x


def cost(x: np.ndarray) -> float:
    """Return the RMS distance of the particles from the goal [m]."""
    return float(np.sqrt(((x - goal())**2).sum(1).mean()))


def plan(rounds: int = 8, candidates: int = 24, seed: int = 0
         ) -> tuple[list[float], list[np.ndarray]]:
    """Return the cost of the motion before each round and after the last, and the motions."""
    state, noise = start().save(), np.random.default_rng(seed)
    steps = np.zeros((KNOTS, 2))
    steps[:, 1] = 0.5 * SIZE / KNOTS    # straight up
    costs, found = [], []
    for k in range(rounds + 1):
        tried = steps + NOISE * DECAY**k * noise.standard_normal((candidates, KNOTS, 2))
        tried[0] = steps
        ends = xpbd_ros.rollouts(state, [commands(each) for each in tried], last)
        values = np.array([cost(x) for x in ends])
        costs.append(values[0])
        found.append(steps)
        weights = np.exp(-(values - values.min()) / (TEMPERATURE * values.std()))
        steps = np.tensordot(weights / weights.sum(), tried, 1)
    return costs, found


def draw(costs: list[float], found: list[np.ndarray], file: Path) -> None:
    """Draw the costs, and the grippers' motions with the towel at their end, from the side."""
    from matplotlib.figure import Figure
    figure = Figure(figsize=(8.0, 3.0), dpi=100, layout='constrained')
    left, right = figure.subplots(1, 2, width_ratios=(2, 3))
    left.plot(1e3 * np.array(costs), 'o-', color='#2f6db5', markersize=4)
    left.set(xlabel='round', ylabel='distance from the goal [mm, RMS]', ylim=(0.0, None))
    state, best = start().save(), int(np.argmin(costs))
    for k, colour in ((0, '#8a7a3c'), (best, '#2f6db5')):
        (x,) = xpbd_ros.rollouts(state, [commands(found[k])], last)
        side = x.reshape(COUNT, COUNT, 3)[:, COUNT // 2]
        right.plot(*(1e3 * side[:, 1:].T), 'o-', color=colour, markersize=3,
                   label=f'towel after round {k}')
        right.plot(*(1e3 * path(found[k]).T), ':', color=colour, label=f'grippers in round {k}')
    right.set(xlabel='y [mm]', ylabel='z [mm]')
    right.legend(fontsize=8, frameon=False)
    for axis in (left, right):
        axis.spines[['top', 'right']].set_visible(False)
    figure.savefig(file)


if __name__ == '__main__':
    numbers, motions = plan()
    print('\n'.join(f'round {k:2}: {1e3 * value:5.1f} mm' for k, value in enumerate(numbers)))
    draw(numbers, motions, Path(sys.argv[1] if len(sys.argv) > 1 else 'mppi_fold.png'))
