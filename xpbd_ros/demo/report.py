"""Evaluate the demo from the observer's data: checks, a table, a picture."""

import json
from pathlib import Path
import struct

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.log.reader import LogReader
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import load_scene

STANDARD_GRAVITY = 9.80665
FORCE_SCALE = 0.6
"""length of a drawn force [m/N]"""


def make(folder: Path, scene_name: str) -> dict:
    """Check and draw the demo whose files are in a folder; return the JSON keys."""
    seen = np.load(folder / 'observed.npz')
    diary = json.loads((folder / 'robot.json').read_text())
    stamps, clouds = seen['stamps'], seen['clouds'].astype(float)
    pins = json.loads(str(seen['pins']))
    said = json.loads(str(seen['diagnostics']))
    begins = {note['phase']: note['time'] for note in diary['phases']}
    scene = load_scene(scene_name)
    simulation = compile_scene(scene)
    hold = (stamps > 0.5 * (begins['hold'] + begins['sweep'])) & (stamps < begins['sweep'])
    forces = mean_forces(pins, set(stamps[hold]))
    frames = frames_by_stamp(folder / 'run')
    times = np.array([frames[stamp] for stamp in stamps]) * simulation.frame_dt
    load = expected_load(simulation, scene.effects['damping'].rate, times, clouds, hold)
    sent = sum(stamps[0] <= stamp <= stamps[-1] for stamp in frames)
    numbers = {
        'frames': len(stamps),
        'real_time_factor': float((times[-1] - times[0])
                                  / (seen['heard'][-1] - seen['heard'][0])),
        'step_ms': {key: float(said[f'step_ms_{key}']) for key in ('p50', 'p95', 'max')},
        'pins': {name: {'force_n': force, 'expected_n': load / len(forces)}
                 for name, force in forces.items()},
        'checks': checks(stamps, clouds, pins, begins, diary, hold, forces, load, said, sent),
        'run': (folder / 'run').absolute(),
    }
    pictures, notes = [], []
    try:
        pictures.append(
            draw(folder / 'demo.png', simulation, stamps, clouds, begins, diary, forces))
    except InputError as error:    # there is no PyVista, or no OpenGL
        notes.append(str(error))
    return {**numbers, 'pictures': pictures, 'notes': notes}


def frames_by_stamp(run: Path) -> dict[float, int]:
    """Return the frame of each point cloud in a log, by its stamp [s]."""
    found = {}
    for message in LogReader(run).messages({'/cloth/particles'}):
        sec, nanosec = struct.unpack_from('<iI', message.data, 4)
        found[(sec * 10**9 + nanosec) * 1e-9] = message.frame
    return found


def mean_forces(pins, stamps: set[float]) -> dict[str, float]:
    """Return the mean downward force on each gripper at the given stamps [N]."""
    found: dict[str, list[float]] = {}
    for stamp, name, _, force in pins:
        if stamp in stamps:
            found.setdefault(name, []).append(-force[2])
    return {name: float(np.mean(values)) for name, values in found.items()}


def expected_load(simulation, rate: float, times, clouds, frames) -> float:
    """
    Return the mean force on the grippers that Newton's second law demands [N].

    It is m (g + a + r v), with the mean acceleration a and velocity v of the towel's centre of
    mass, which still moves a little while it is held, and the damping rate r.

    Parameters
    ----------
    simulation : gives the masses
    rate : damping rate [1/s]
    times : of the clouds [s], shape (clouds,)
    clouds : positions [m], shape (clouds, rows, columns, 3)
    frames : whether a cloud counts, shape (clouds,)

    """
    mass = simulation.state.mass[simulation.slot]
    height = clouds[..., 2].reshape(len(clouds), -1) @ mass / mass.sum()
    speed = np.gradient(height, times)
    first, last = np.flatnonzero(frames)[[0, -1]] - [1, 0]    # from the end of the frame before
    time = times[last] - times[first]
    acceleration = (speed[last] - speed[first]) / time
    drag = rate * (height[last] - height[first]) / time
    return float(mass.sum() * (STANDARD_GRAVITY + acceleration + drag))


def checks(stamps, clouds, pins, begins, diary, hold, forces, load, said, sent) -> list[dict]:
    """Return the checks of the demo: name, pass, value, expected."""
    corners = {'left': clouds[:, -1, 0], 'right': clouds[:, -1, -1]}
    held = (stamps > begins['lift']) & (stamps < begins['rest'])
    gaps = []
    for name, track in corners.items():
        where = {stamp: place for stamp, pin, place, _ in pins if pin == name}
        gaps += [np.linalg.norm(track[k] - where[stamp]) for k, stamp in enumerate(stamps)
                 if held[k] and stamp in where]
    asked = {name: diary['path'][-1][1 + k] for k, name in enumerate(corners)}
    reached = max(np.linalg.norm(corners[name][held][-1] - asked[name]) for name in asked)
    rise = clouds[hold][..., 2].mean() - clouds[stamps < begins['grasp']][..., 2].mean()
    swept = (stamps >= begins['sweep']) & (stamps < begins['carry'])
    pushed = np.abs(clouds[swept][..., 1].mean((1, 2)) - clouds[hold][..., 1].mean()).max()
    gap, total = max(gaps, default=np.inf), sum(forces.values())
    end = clouds[-1]
    table = [
        ('corners stay in the grippers, within', gap <= 1e-4, gap, '≤ 0.0001 m'),
        ('grippers reach what was asked, within', reached <= 5e-3, reached, '≤ 0.005 m'),
        ('towel rises with the grippers by', 0.3 < rise < 1.0, rise, '0.3 … 1 m'),
        ('force on the grippers while they hold the towel', abs(total / load - 1.0) <= 0.02,
         total, f'{load:.4f} N ± 2 %'),
        ('ball moves the towel by', pushed > 0.02, pushed, '> 0.02 m'),
        ('nothing goes below the table, lowest', clouds[..., 2].min() >= -1e-6,
         clouds[..., 2].min(), '≥ 0 m'),
        ('towel ends draped over the stool, highest', end[..., 2].max() > 0.2,
         end[..., 2].max(), '> 0.2 m'),
        ('inputs refused', said['rejected_inputs'] == '0', float(said['rejected_inputs']), '0'),
        ('clouds lost on the way', len(stamps) >= 0.98 * sent, sent - len(stamps),
         'at most 2 %'),
    ]
    return [{'name': name, 'pass': bool(good), 'value': float(value), 'expected': expected}
            for name, good, value, expected in table]


def table(numbers: dict) -> str:
    """Return the printed table."""
    step = numbers['step_ms']
    lines = [f"\n{numbers['frames']} frames, {numbers['real_time_factor']:.2f} × real time; one "
             f"frame takes {step['p50']:.2f} ms (p95 {step['p95']:.2f} ms)"]
    for check in numbers['checks']:
        lines.append(f"  {'ok  ' if check['pass'] else 'FAIL'}  {check['name']:<50} "
                     f"{check['value']:>10.4g}   ({check['expected']})")
    for name, pin in numbers['pins'].items():
        lines.append(f"  force on gripper {name:<6} {pin['force_n']:.4f} N, half the towel takes "
                     f"{pin['expected_n']:.4f} N")
    lines += [f"log      {numbers['run']}", *(f'picture  {p}' for p in numbers['pictures']),
              *(f'note     {text}' for text in numbers['notes'])]
    return '\n'.join(lines)


def draw(file: Path, simulation, stamps, clouds, begins, diary, forces) -> Path:
    """Draw the towel, the colliders, the grippers' paths and their load at six instants."""
    from xpbd_ros.study.picture import (
        Arrow,
        Body,
        draw as draw_picture,
        Instant,
        Path as Track,
        Surface,
    )
    from xpbd_ros.study.snapshots import size_of
    cloth = simulation.cloths[0]
    path_t = np.array([row[0] for row in diary['path']])
    tracks = np.array([row[1:] for row in diary['path']])
    moments = [
        ('on the table', begins['grasp']),
        ('lifted by two corners', 0.4 * begins['lift'] + 0.6 * begins['hold']),
        ('held still', begins['sweep'] - 0.05),
        ('a ball sweeps through', 0.5 * (begins['sweep'] + begins['carry'])),
        ('laid over the stool', 0.3 * begins['lower'] + 0.7 * begins['rest']),
        ('let go', stamps[-1]),
    ]
    instants = []
    for title, moment in moments:
        k = int(np.abs(stamps - moment).argmin())
        surface = Surface(clouds[k].reshape(-1, 3), cloth.mesh.triangles)
        bodies = [Body(entry.shape, size_of(entry), where, entry.pose.orientation)
                  for entry, where in colliders_at(simulation, begins, stamps[k])]
        so_far = path_t <= stamps[k]
        paths, arrows = [], []
        for g, (name, colour) in enumerate((('left', '#d1495b'), ('right', '#e0a030'))):
            if so_far.any() and moment < begins['rest']:
                paths.append(Track(tracks[so_far, g], colour, f'gripper {name}'))
            if title == 'held still' and name in forces:
                beside = tracks[so_far, g][-1] + [0.12 * (2 * g - 1), 0, 0]
                arrows.append(Arrow(beside, (0, 0, -FORCE_SCALE * forces[name]),
                                    f'{forces[name]:.2f} N'))
        instants.append(Instant(f't = {stamps[k] - stamps[0]:.1f} s   {title}', [surface], bodies,
                                paths, arrows))
    draw_picture(instants, file, title='A towel on /cloth/particles, moved by a robot over DDS',
                 columns=3)
    return file.absolute()


def colliders_at(simulation, begins, stamp: float):
    """Yield each collider with its position at a stamp [m]; the ball moves as the robot does."""
    for name, entry in simulation.effects['contact'].entries.items():
        place = np.array(entry.pose.position)
        if name == 'sphere' and begins['sweep'] <= stamp < begins['carry']:
            s = (stamp - begins['sweep']) / (begins['carry'] - begins['sweep'])
            place[1] += 1.2 * (0.5 - 0.5 * np.cos(2.0 * np.pi * s))
        yield entry, tuple(place)
