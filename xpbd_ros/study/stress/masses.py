"""Edges and masses: rigid, without stiffness, unequal masses, coincident, pinned at both ends."""

from dataclasses import replace
from functools import partial

import numpy as np

from xpbd_ros.study.stress.case import hard, Setting
from xpbd_ros.study.stress.refusals import Refusal
from xpbd_ros.study.stress.scenes import (
    DOWN,
    FIRM,
    FLAT,
    N,
    RIGID,
    sheet,
    SIZE,
    SOFT,
    SPACING,
    USUAL,
)
from xpbd_ros.study.stress.trial import Trial

GENTLE = 0.05
"""largest rise of the total energy over the energy scale"""


@hard('H1', 'rigid everywhere')
def rigid():
    """A level rigid sheet falls, held by two corners: energy does not rise."""
    scene = sheet(RIGID, pose=FLAT, damping=0.5)
    for setting in USUAL:
        yield Trial(setting, scene, 2.0, energy=GENTLE)


@hard('H2', 'stiffness close to zero')
def absent():
    """All particles fall alike, to 1e-12."""
    def free(track):
        way = track.x[-1] - track.x[0]
        spread = np.abs(way - way.mean(0)).max() / np.abs(way).max()
        return '' if spread <= most else f'falls unevenly, by {spread:.1e}'

    for compliance in (1e12, 1e300):
        scene = sheet({'stretch': {'compliance': compliance}, 'shear': {'stiffness': 1e-300},
                       'bend': {'stiffness': 1e-300}}, pins={})
        for setting in USUAL:
            # a velocity is known to the rounding of x over h
            most = (1e-4 if setting.precision == 'float32'
                    else 1e-12 * max(1.0, 0.25 * setting.substeps))
            yield Trial(setting, scene, 0.5, check=free, label=f'{compliance:g} m/N')


@hard('H3', 'invalid parameters')
def senseless():
    """Negative, zero and non-finite parameters are refused with key and value."""
    for key, value, says in (
            ('compliance', -1.0, 'at least 0 m/N (got -1.0)'),
            ('compliance', float('nan'), 'finite m/N (got nan)'),
            ('compliance', float('inf'), 'finite m/N (got inf)'),
            ('warp', -5.0, '> 0 N/m (got -5.0)'), ('warp', 0.0, '> 0 N/m (got 0.0)'),
            ('warp', 'stiff', "must be a number in N/m (got 'stiff')")):
        stretch = {key: value} if key == 'compliance' else {key: value, 'weft': 1.0}
        yield Refusal(f'stretch.{key}: {value}', sheet({'stretch': stretch}),
                      ('cloths.c.effects.stretch', says))
    yield Refusal('density: 0', sheet(density=0.0), ('cloths.c.density', '> 0 kg/m²'))
    yield Refusal('density: 1e-320', sheet(density=1e-320), ('0 or at least 1e-300 kg/m²',))


def heavy(count: int, ratio: float, mass):
    """Return masses with every ``count``-th column heavier by ``ratio``, from the last on."""
    found = mass.reshape(-1, N).copy()
    found[:, ::-1][:, ::count] *= ratio
    return found.ravel()


TIP, BETWEEN = partial(heavy, N, 1e6), partial(heavy, 5, 1e6)


@hard('H4', 'mass ratio of a million')
def unequal():
    """
    A heavy tip on a light strip, and light particles between heavy ones, cause no instability.

    A light particle must move by less than an edge within a substep: T h² w < L. With 512 substeps
    the strip is as stiff as asked; with fewer it is only softer.
    """
    strip = sheet({**SOFT, 'stretch': {'warp': 1e6, 'weft': 1e6}}, grid=(N, 3),
                  size=(SIZE, 2.0 * SPACING), pose={'orientation': DOWN}, pins={'a': 'edge_x0'},
                  damping=10.0)
    for setting in (*USUAL, Setting(substeps=512)):
        if setting.method == 'explicit':
            setting = replace(setting, substeps=1200)
        for masses, label in ((TIP, 'heavy tip'), (BETWEEN, 'light between heavy')):
            mass = masses(np.full((3, N), 0.2 * SPACING**2).ravel()).reshape(3, N)
            exact = mass[1, 1:].sum() * 9.80665 / 1e6 / SPACING
            yield Trial(setting, strip, 1.5, masses=masses, label=label, energy=GENTLE,
                        strain=2.2 * exact if setting.substeps > 100 else None)


def rows(x):
    """Return a start with two rows of particles at the positions of a third."""
    found = x.reshape(N, N, 3).copy()
    found[4] = found[6] = found[5]
    return found.reshape(-1, 3), np.zeros_like(x)


def patch(x):
    """Return a start with a patch of particles in one point."""
    found = x.reshape(N, N, 3).copy()
    found[3:7, 3:7] = found[5, 5]
    return found.reshape(-1, 3), np.zeros_like(x)


def one(x):
    """Return a start with all particles in one point."""
    return np.zeros_like(x), np.zeros_like(x)


@hard('H5', 'coincident particles')
def coincident():
    """
    Coincident particles part, in the same way in every run, and the sheet recovers.

    From one point it opens to a crumpled equilibrium, in most runs, whose folds compress edges by
    6 to 12 %: started from the end of a run of ``line``, ``explicit`` stays there. Settings that
    are far softer than asked keep more.
    """
    for setting in USUAL:
        resolved = setting.method == 'line' and setting.substeps >= 32
        yield Trial(setting, sheet(FIRM, pins={}, gravity=0.0), 3.0, start=one,
                    recovery_strain=0.2 if resolved else 0.6, label='all of them')
        for place, label in ((patch, 'a patch'), (rows, 'three rows')):
            yield Trial(setting, sheet(FIRM), 3.0, start=place, recovery_strain=0.01,
                        label=label)


@hard('H10', 'both ends of an edge pinned, three lengths apart')
def held_edge():
    """The edge moves no particle, and its force is in the wrenches of the pins."""
    def felt(track):
        if not track.force:
            return ''
        pull = abs(track.force['b'][0] - track.force['a'][0]) / 2.0
        expected = 1000.0 * 2.0 * SPACING / 2.0    # an edge of the border is half as stiff
        return '' if pull >= expected else f'{pull:.3g} N on the pins, not {expected:.3g}'

    scene = sheet(pins={'a': [N * (N - 1)], 'b': [N * (N - 1) + 1]})
    for setting in USUAL:
        yield Trial(setting, scene, 3.0, strain=20.0, speed=20.0, check=felt,
                    pins=lambda t: {'b': (2.0 * SPACING * min(1.0, t), 0.0, 0.0)},
                    note='forces on ~/pin_states')


@hard('H11', 'rigid strip between pins that are too far apart')
def too_far():
    """
    The constraints cannot be met: the strip is at rest, and all its edges have a strain of 1.

    In a sheet held by two corners only one row is too short, by 2 %. The others hang from it, and
    no particle gets faster than by a fall through the spacing of particles.
    """
    def even(track):
        along = np.abs(np.diff(track.edges.particles, axis=1)[:, 0]) == 1
        strain = track.edges.strain(track.x[-1])[along]
        return '' if strain.max() <= 1.001 else f'an edge is strained by {strain.max():.3g}'

    strip = sheet(RIGID, grid=(N, 3), size=(SIZE, 2.0 * SPACING), pose=FLAT,
                  pins={'a': 'edge_x0', 'b': 'edge_x1'}, damping=1.0)
    wide = sheet(RIGID, pins={'a': 'edge_x0', 'b': 'edge_x1'}, damping=1.0)

    def apart(t, part=1.0):
        return {'b': (part * SIZE * min(1.0, t), 0.0, 0.0)}

    for setting in USUAL:
        for scene, label in ((strip, 'a strip'), (wide, 'a sheet')):
            yield Trial(setting, scene, 4.0, pins=apart, end_speed=1e-3, label=label, check=even)
        yield Trial(setting, sheet(RIGID), 4.0, pins=partial(apart, part=0.02), end_speed=1e-2,
                    speed=(2.0 * 9.80665 * SPACING)**0.5, label='a sheet by its corners')


@hard('H33', 'masses of 1e-12 kg and less')
def light():
    """No denormal numbers are left in the state."""
    def normal(track):
        tiny = np.finfo(np.float64).tiny
        left = [name for name, a in (('x', track.x[-1]), ('v', track.v[-1]))
                if ((a != 0.0) & (np.abs(a) < tiny)).any()]
        return f'denormal numbers in {", ".join(left)}' if left else ''

    for density, label in ((1e-9, 'masses of 1e-12 kg'), (1e-30, 'masses of 1e-33 kg')):
        scene = sheet({'stretch': {'warp': 5e3 * density, 'weft': 5e3 * density},
                       'shear': {'stiffness': 1e2 * density},
                       'bend': {'stiffness': 5e-4 * density}}, density=density, damping=20.0)
        for setting in USUAL:
            yield Trial(setting, scene, 3.0, check=normal, label=label,
                        recovery_strain=0.01, start=patch)

    def sways(x):
        v = np.zeros_like(x)
        v[:, 2] = 1e-307
        return x, v

    for setting in USUAL:
        yield Trial(setting, sheet(pose=FLAT, gravity=0.0, damping=20.0), 1.5, check=normal,
                    start=sways, textbook=False, label='a sway that dies away')
