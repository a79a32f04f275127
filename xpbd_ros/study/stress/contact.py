"""Contact: teleports, squeezing, undefined normals, bullets, slopes, self-collision."""

from dataclasses import replace
from functools import partial

import numpy as np

from xpbd_ros.sim.commands import PlaceCollider, Pose, RemoveCollider
from xpbd_ros.study.stress.case import hard, Setting
from xpbd_ros.study.stress.crossings import crossings
from xpbd_ros.study.stress.refusals import Refusal
from xpbd_ros.study.stress.scenes import FEW, FLAT, N, sheet, SIZE, SPACING, USUAL
from xpbd_ros.study.stress.trial import Trial

GAP = 0.004
DEPENETRATION = 1.0
"""largest speed at which a penetration is resolved [m/s]"""


@hard('H15', 'a collider jumps into the cloth')
def collider_teleports():
    """The collider follows at its largest speed; cloth inside it comes out slowly and recovers."""
    ball = {'ball': {'sphere': {'radius': 0.1}, 'position': [0.2, 3.0, 0.2], 'friction': 0.4}}

    def jump(t):
        return {'ball': (0.0, -3.0 if 0.5 <= t < 1.5 else 0.0, 0.0)}

    for setting in USUAL:
        yield Trial(setting, sheet(colliders=ball), 4.5, colliders=jump, cause_end=2.1, speed=15.0,
                    recovery_strain=0.01, reports=('colliders_at_max_speed',), label='jumps')

    def deep(k):
        if k == 20:
            return [PlaceCollider('deep', 'sphere', (0.1,), Pose((0.2, 0.05, 0.2)))]
        return [RemoveCollider('deep')] if k == 120 else []

    def gently(most, track):
        way = np.abs(np.diff(np.array(track.x), axis=0)).max() / track.dt
        return '' if way <= most else f'comes out at {way:.3g} m/s'

    for setting in USUAL:
        most = (3.0 if setting.method == 'explicit' else 2.0) * DEPENETRATION
        yield Trial(setting, sheet(), 4.0, commands=deep, cause_end=2.0, recovery_strain=0.01,
                    check=partial(gently, most), speed=most, textbook=False,
                    label='appears half a radius deep')


@hard('H16', 'squeezed between two colliders')
def squeezed():
    """With less room than twice the thickness, there is no jitter, and each side gives half."""
    blocks = {name: {'box': {'size': [1.0, 1.0, 0.2]}, 'position': [0.2, 0.2, z]}
              for name, z in (('below', -0.1 - GAP), ('above', 0.3))}
    scene = sheet(pose=FLAT, pins={}, colliders=blocks)

    def close(t):
        return {'above': (0.0, 0.0, -0.2 * min(1.0, t) + 0.001)}

    def deep(track):
        z = track.x[-1][:, 2]
        room = 0.101 - 0.1 - (-GAP)    # between the faces, for twice the thickness
        worst = max(float((-GAP + GAP - z).max()), float((z + GAP - 0.001).max()))
        return '' if worst <= 0.5 * (2.0 * GAP - room) + 1e-4 else f'{worst:.2g} m too deep'

    for setting in USUAL:
        yield Trial(setting, scene, 3.0, colliders=close, end_speed=1e-3, strain=0.5, check=deep)


def exactly(middle, x):
    """Return a start at rest with the middle particle at ``middle`` [m]."""
    found = x.copy()
    found[N * N // 2] = middle
    return found, np.zeros_like(x)


@hard('H17', 'undefined normals')
def no_normal():
    """Put particles at centres and on edges of colliders; shapes without extent are refused."""
    def outside(track):
        way = float(np.linalg.norm(track.x[-1]))
        return '' if way >= 0.06 else f'{way:.2g} m from the centre'

    mid = [SIZE / 2.0, 0.0, SIZE / 2.0]
    for name, shape in (('centre of a sphere', {'sphere': {'radius': 0.06}}),
                        ('centre of a box', {'box': {'size': [0.1, 0.1, 0.1]}}),
                        ('axis of a capsule of no length',
                         {'capsule': {'radius': 0.06, 'length': 0.0}}),
                        ('edge of a box', {'box': {'size': [0.1, 0.1, 0.1]}})):
        place = [mid[0] - 0.05, 0.05, mid[2]] if 'edge' in name else mid
        scene = sheet(colliders={'thing': {**shape, 'position': place}})
        for setting in USUAL:
            yield Trial(setting, scene, 3.0, speed=4.0 * DEPENETRATION, strain=3.0,
                        label=name)
            if 'sphere' in name:
                yield Trial(setting, {**scene, 'gravity': [0.0, 0.0, 0.0]}, 1.0,
                            start=partial(exactly, mid), strain=3.0, label=f'{name}, at rest')
    for setting in FEW:
        ball = {'thing': {'sphere': {'radius': 0.06}, 'position': [0.0, 0.0, 0.0]}}
        yield Trial(setting, sheet(grid=(1, 1), pins={}, gravity=0.0, colliders=ball), 1.0,
                    check=outside, label='one particle at the centre of a sphere')
    for shape, says in (({'sphere': {'radius': 0.0}}, 'radius: must be > 0 m (got 0.0)'),
                        ({'box': {'size': [0.1, 0.0, 0.1]}}, 'must be > 0 m (got 0.0)'),
                        ({'plane': {'normal': [0.0, 0.0, 0.0]}}, 'normal: must not be zero')):
        yield Refusal(str(shape), sheet(colliders={'thing': shape}), (says,))


@hard('H18', 'a bullet against a sheet of 1 mm')
def bullet():
    """A cloth at 100 m/s does not pass a plate of 1 mm, nor such a plate at 100 m/s the cloth."""
    plate = {'plate': {'box': {'size': [4.0, 4.0, 0.001]}, 'position': [0.2, 0.2, 0.0],
                       'friction': 0.4, 'max_speed': 100.0}}
    scene = sheet(pose={'position': [0.0, 0.0, 1.0]}, pins={}, colliders=plate, gravity=-1.0)

    def thrown(x):
        return x, np.tile([3.0, 1.0, -100.0], (len(x), 1))

    def above(track):
        z = track.x[-1][:, 2]
        return '' if z.min() >= 0.0 else f'{(z < 0.0).sum()} particles got through'

    for setting in USUAL:
        yield Trial(setting, scene, 1.0, start=thrown, check=above, label='the cloth moves')
    still = sheet(pose=FLAT, pins={}, gravity=0.0, damping=0.0,
                  colliders={'plate': {**plate['plate'], 'position': [0.2, 0.2, -5.0]}})

    def sweep(t):
        return {'plate': (0.0, 0.0, 10.0 if t > 0.1 else 0.0)}

    def carried(track):
        z = track.x[round(0.2 / track.dt) + 1][:, 2]
        return '' if z.min() >= 5.0 else f'{(z < 5.0).sum()} particles got through'

    for setting in USUAL:
        yield Trial(setting, still, 0.5, colliders=sweep, check=carried, label='the plate moves')


@hard('H26', 'thousands of contacts')
def many():
    """A sheet on a slope of 5 degrees sticks without jitter."""
    a = np.radians(5.0)

    def moved(track):
        way = np.abs(track.x[-1] - track.x[30]).max()
        return '' if way <= 1e-3 else f'slid by {way:.2g} m'

    for setting in USUAL:
        n = 45 if setting == Setting() else N
        scene = sheet(grid=(n, n), pose={'position': [0.0, 0.0, GAP]}, pins={}, colliders={
            'slope': {'plane': {}, 'friction': 0.4}})
        scene['gravity'] = [9.80665 * float(np.sin(a)), 0.0, -9.80665 * float(np.cos(a))]
        yield Trial(setting, scene, 2.0, end_speed=1e-3, check=moved, label=f'{n * n} particles')


@hard('H35', 'pads from soft to rigid')
def pads():
    """Of two pads that squeeze a sheet one jumps away and back; nothing flies off or jitters."""
    def jump(t):
        return {'above': (0.0, 0.0, 3.0 if 1.0 <= t < 1.5 else 0.0)}

    def held(track):
        z = np.abs(track.x[-1][:, 2]).max()
        return '' if z <= 1e-4 else f'{z:.2g} m off the middle'

    for stiffness in (1e-3, 1e4, 2e8, 1e15):
        blocks = {name: {'box': {'size': [1.0, 1.0, 0.2]}, 'friction': 0.4,
                         'position': [0.2, 0.2, side * (0.1 + GAP - 0.001)],
                         'pad': {'stiffness': stiffness}}
                  for name, side in (('below', -1.0), ('above', 1.0))}
        firm = stiffness > 1e6
        scene = sheet(pose=FLAT, pins={}, colliders=blocks, gravity=-9.80665 if firm else 0.0)
        for setting in USUAL:
            yield Trial(setting, scene, 4.0, colliders=jump, cause_end=2.2, speed=15.0,
                        end_speed=1e-3, strain=0.5, check=held if firm else None, textbook=False,
                        reports=('colliders_at_max_speed',) if firm else (),
                        label=f'{stiffness:g} Pa/m')


def on_table(mu: float, angle: float, **keys) -> dict:
    """Return a sheet on a plane, with gravity tilted towards +x by an angle [degrees]."""
    a = np.radians(angle)
    scene = sheet(pose={'position': [0.0, 0.0, GAP]}, pins={}, friction=mu, damping=0.0,
                  colliders={'slope': {'plane': {}, 'friction': mu, **keys}}, scene_effects={
                      'pin': {}, 'contact': {'thickness': GAP}, 'friction': {},
                      'damping': {'rate': 1e-300}})
    scene['gravity'] = [9.80665 * float(np.sin(a)), 0.0, -9.80665 * float(np.cos(a))]
    return scene


@hard('H29', 'extreme friction and restitution')
def extremes():
    """
    Without friction the sheet slides freely; with μ = 100 it sticks on a slope of 80 degrees.

    With restitution 1 it gains no energy; with restitution 0 it does not bounce.
    """
    def way(expected, most, track):
        got = track.x[-1][:, 0].mean() - track.x[0][:, 0].mean()
        return '' if abs(got - expected) <= most else f'slid {got:.4g} m, not {expected:.4g}'

    def comes_up(track):
        height = np.array(track.x)[:, :, 2]
        way = (height - np.minimum.accumulate(height)).max()
        return '' if way <= 1e-9 else f'comes up by {way:.2g} m'

    dropped = on_table(0.0, 0.0)
    dropped['cloths']['c']['pose']['position'] = [0.0, 0.0, 0.3]
    for setting in USUAL:
        if setting.precision == 'float32':
            continue
        slide = 0.5 * 9.80665 * float(np.sin(np.radians(30.0)))
        yield Trial(setting, on_table(0.0, 30.0), 1.0, check=partial(way, slide, 0.05 * slide),
                    label='μ = 0')
        yield Trial(setting, on_table(100.0, 80.0), 1.0, check=partial(way, 0.0, 1e-6),
                    label='μ = 100')
        yield Trial(setting, dropped, 1.0, check=comes_up, label='restitution 0')
    for setting in FEW:
        scene = on_table(0.0, 0.0, restitution=1.0)
        scene['cloths']['c']['pose']['position'] = [0.0, 0.0, 0.5]
        yield Trial(setting, scene, 2.0, energy=0.01, label='restitution 1', textbook=False)


def folded(x):
    """Return a sheet folded in two, with 3 cm between the halves."""
    found = x.copy()
    over = found[:, 0] > SIZE / 2.0
    found[over, 2] += 0.03
    found[over, 0] = SIZE - found[over, 0]
    return found, np.zeros_like(x)


def slammed(x):
    """Return a folded sheet whose upper half moves towards the lower one at 30 m/s."""
    found, v = folded(x)
    v[x[:, 0] > SIZE / 2.0, 2] = -30.0
    return found, v


def tangled(x):
    """Return a sheet with random displacements, which crosses itself."""
    noise = np.random.default_rng(1).normal(0.0, 0.02, x.shape)
    return x + noise, np.zeros_like(x)


@hard('H27', 'self-collision', slow=True)
def itself():
    """
    In a fold, a slammed fold and a heap the cloth never passes through itself or the floor.

    A tangle gains no energy and slows down. Its edges start with strains of 1/2, which alone make
    it as fast as 120 m/s in the limit of short steps.
    """
    thickness = 0.01
    effects = {'pin': {}, 'contact': {'thickness': GAP}, 'friction': {}, 'damping': {'rate': 3.0},
               'self_collision': {'thickness': thickness, 'room': 200}}
    floor = {'floor': {'plane': {}, 'friction': 0.4}}

    def through(track):
        low = min(float(x[:, 2].min()) for x in track.x)
        if low < 0.0:
            return f'{-low:.2g} m below the floor'
        count = max(crossings(x, track.triangles) for x in (*track.x[::12], track.x[-1]))
        return f'{count} crossings' if count else ''

    heap = {'orientation': [0.5**0.5, 0.0, 0.0, 0.5**0.5], 'position': [0.0, 0.0, 0.02]}
    for setting in (replace(one, substeps=count) for one in FEW for count in (4, 16)):
        above = {'position': [0.0, 0.0, 0.05]}
        for label, place, pose in (('folded', folded, above), ('slammed shut', slammed, above),
                                   ('a heap', None, heap), ('tangled', tangled, {
                                       'position': [0.0, 0.0, 0.3]})):
            scene = sheet(pose=pose, pins={}, colliders=floor, scene_effects=effects)
            tangle = {'energy': 0.0, 'end_speed': 10.0} if label == 'tangled' else {
                'speed': 30.0 if label == 'slammed shut' else 10.0, 'check': through}
            yield Trial(setting, scene, 2.0, start=place, label=label,
                        cloth_distance=min(thickness, 0.5 * SPACING), **tangle)
