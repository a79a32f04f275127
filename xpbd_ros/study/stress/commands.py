"""Commands: pins pulled apart, teleported, grasped and released; gusts; live parameters."""

from dataclasses import replace
from functools import partial
from typing import Any

from xpbd_ros.sim.commands import Command, Grasp, MovePin, Pose, Release, SetKey, SetWind
from xpbd_ros.study.stress.case import hard
from xpbd_ros.study.stress.refusals import Refusal
from xpbd_ros.study.stress.scenes import FEW, FIRM, LINE, sheet, SIZE, USUAL
from xpbd_ros.study.stress.trial import Trial

MAX_SPEED = 5.0
"""default ``max_speed`` of a pin [m/s]"""


@hard('H12', 'pins pulled apart, then released')
def pulled():
    """Stretch to 1.5 times the length, slowly and fast; the cloth recovers after release."""
    for speed, label in ((0.2, 'slowly'), (MAX_SPEED, 'fast')):
        end = 0.5 * SIZE / speed

        def pull(t, speed=speed, end=end):
            if t > end + 0.2:
                return {'a': None, 'b': None}
            return {'b': (min(speed * t, 0.5 * SIZE), 0.0, 0.0)}

        for setting in USUAL:
            if setting.method == 'explicit':
                setting = replace(setting, substeps=120)
            yield Trial(setting, sheet(), end + 2.6, pins=pull, cause_end=end + 0.2, strain=3.0,
                        speed=60.0, recovery_strain=0.01, label=label)


@hard('H13', 'a pin is sent 10 m away in one message')
def pin_teleports():
    """
    The pin follows at its largest speed, which is reported, and the cloth with it.

    The free edge is faster, also in the limit of small steps, but by less than a factor of 4.
    """
    def jump(t):
        return {'b': (0.0, 10.0, 0.0), 'a': (0.0, 10.0, 0.0)} if t > 0.1 else {}

    def one(t):
        return {'b': (0.5 * SIZE, 0.0, 0.0)} if 0.1 < t < 0.5 else {'b': (0.0, 0.0, 0.0)}

    for setting in USUAL:
        yield Trial(setting, sheet(), 4.6, pins=jump, cause_end=2.2, speed=4.0 * MAX_SPEED,
                    recovery_strain=0.01, reports=('pins_at_max_speed',), label='both')
        yield Trial(setting, sheet(FIRM), 3.0, pins=one, cause_end=0.6, recovery_strain=0.01,
                    strain=3.0, reports=('pins_at_max_speed',), label='one, and back')


@hard('H14', 'a pin grasped or released in every frame')
def on_and_off():
    """All stays finite, and the cloth recovers afterwards; invalid commands are refused."""
    def blink(t):
        k = round(t * 60.0)
        return {'b': None if k % 2 and t < 1.5 else (0.0, 0.0, 0.0)}

    for setting in USUAL:
        yield Trial(setting, sheet(FIRM), 4.0, pins=blink, cause_end=1.5, speed=3.0 * MAX_SPEED,
                    recovery_strain=0.01)
    far: list[Command] = [Grasp('c', Pose((9.0, 9.0, 9.0)), 0.01), Release('nobody'),
                          MovePin('nobody', Pose())]
    yield Trial(LINE, sheet(), 0.5, commands=lambda k: far if k == 3 else [], textbook=False,
                reports=('no free particle within', "pin 'nobody' holds nothing"),
                label='nothing to grasp, unknown pins')
    yield Refusal('an index out of range', sheet(pins={'a': [0, 999]}), (
        'pins.a.at: indices must be from 0 to 120 (got [0, 999])',))


@hard('H28', 'a gust of 30 m/s on light cloth')
def gust():
    """
    A free sheet gets no faster than the wind.

    A sheet held at two corners snaps taut, and its free edge reaches 50 m/s in the limit of short
    steps (48.4 with 512 substeps of ``line``, 49.9 with 2048 of ``gauss_seidel``).
    """
    def blow(k):
        return [SetWind((0.0, 30.0, 0.0))] if k == 30 else []

    scene = sheet(density=0.05, scene_effects={'pin': {}, 'wind': {'velocity': [0.0, 0.0, 0.0]},
                                               'drag': {}}, colliders={})
    free = sheet(density=0.05, pins={}, gravity=0.0, colliders={},
                 scene_effects=scene['effects'], pose={'orientation': [0.0, 0.0, 0.0, 1.0]})
    for setting in (*FEW, replace(LINE, substeps=1), replace(LINE, substeps=32)):
        wind: dict[str, Any] = {
            'commands': blow, 'air': lambda t: (0.0, 30.0 if t > 0.51 else 0.0, 0.0), 'drag': 1.2}
        yield Trial(setting, scene, 2.0, speed=1.1 * 50.0, label='held', **wind)
        yield Trial(setting, free, 2.0, speed=30.0 * (1.0 + 1e-9), label='free', **wind)


def storm(k: int):
    """Return the changed parameters of frame ``k``, some by six orders of magnitude."""
    if k >= 120:
        return [] if k > 120 else [
            SetKey('cloths.c.effects.stretch.warp', 1000.0), SetKey('gravity', [0, 0, -9.80665]),
            SetKey('cloths.c.effects.shear.stiffness', 20.0),
            SetKey('cloths.c.effects.bend.stiffness', FIRM['bend']['stiffness']),
            SetKey('solver.compliance_scale', 1.0), SetKey('effects.contact.thickness', 0.004),
            SetKey('cloths.c.friction', 0.4)]
    return [(SetKey('cloths.c.effects.stretch.warp', (1e6, 1.0, 1e3)[k // 9 % 3]),),
            (SetKey('gravity', [0.0, (30.0, -30.0)[k // 9 % 2], -9.80665]),),
            (SetKey('cloths.c.effects.shear.stiffness', (1e-3, 1e3)[k // 9 % 2]),),
            (SetKey('cloths.c.effects.bend.stiffness', (1e-9, 1e-2)[k // 9 % 2]),),
            (SetKey('solver.compliance_scale', (1e3, 1e-3, 1.0)[k // 9 % 3]),),
            (SetKey('effects.contact.thickness', (1e-4, 0.05)[k // 9 % 2]),),
            (SetKey('cloths.c.friction', (0.0, 10.0)[k // 9 % 2]),), (), ()][k % 9]


@hard('H30', 'parameters changed in every frame')
def live():
    """Change parameters by six orders of magnitude; strain stays bounded and recovers."""
    for setting in USUAL:
        if setting.method != 'explicit':
            yield Trial(setting, sheet(FIRM), 4.5, commands=storm, cause_end=2.1,
                        recovery_strain=0.02, textbook=False)

    def steps(last, k):
        count = (4, 64, 8, 200, 16)[k // 2 % 5]
        return [SetKey('solver.substeps', count)] if k < 120 else [
            SetKey('solver.substeps', last)] * (k == 120)

    for setting in USUAL:
        if setting.method != 'explicit':
            yield Trial(setting, sheet(), 4.5, commands=partial(steps, setting.substeps),
                        cause_end=2.1, recovery_strain=0.02, speed=30.0, textbook=False,
                        label='substeps')
    bad = [SetKey('gravity', [0.0, float('nan'), 0.0]), SetKey('solver.substeps', -1),
           SetKey('cloths.c.effects.stretch.warp', float('inf')), SetKey('nothing', 1)]
    yield Trial(LINE, sheet(), 0.5, commands=lambda k: bad if k == 3 else [], textbook=False,
                reports=('gravity[1]: must be finite', 'solver.substeps: must be at least 1',
                         'stretch.warp: must be finite', 'nothing: cannot change'),
                recovery_strain=0.01, label='invalid values')
