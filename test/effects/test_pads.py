"""Pads: a squeeze has a force, and friction the limit μ F, whatever solves it."""

from itertools import product
from typing import NamedTuple

import numpy as np
import pytest
from scipy.optimize import minimize

from support.meshes import box
from support.scenes import GRAVITY, run, SETTINGS, simulate
from support.tiers import quick_only, slow
from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.grip import carried_tension
from xpbd_ros.scene.load import scene_from_mapping
from xpbd_ros.sim.commands import MoveCollider, PlaceCollider, Pose, RemoveAllColliders, SetKey
from xpbd_ros.sim.contact.clamp_friction import _pushes, shared_friction
from xpbd_ros.sim.contact.contacts import DEPENETRATION
from xpbd_ros.sim.contact.pads import press_pads, solve, surface_area
from xpbd_ros.sim.geometry.mesh import grid_mesh
from xpbd_ros.sim.geometry.mesh_repair import solid_mesh

R, MU, OVERLAP = 0.002, 0.8, 0.001
"""thickness, friction, indentation of each finger into the cloth [m]"""
CLAMPED = 0.0625 * 0.02
"""area of the particles between the fingers [m²]"""
STRIP = (7, 2), (0.15, 0.02)
USUAL = 'line', 'ndf2'


def fingers(stiffness=2e8, *, indentation=(OVERLAP, OVERLAP), order=(1, -1), **keys):
    """Return two boxes about the first three columns of a strip, from above and below."""
    return {'above' if side > 0 else 'below': {
        'box': {'size': [0.125, 0.1, 0.02]}, 'friction': MU,
        'position': [0.0, 0.0, side * (0.01 + R - indentation[0 if side > 0 else 1])],
        **({} if stiffness is None else {'pad': {'stiffness': stiffness}}), **keys}
        for side in order}


def tilted(degrees, stiffness=2e8) -> dict:
    """Return two fingers turned about y, so that they open towards +x by twice this angle."""
    colliders = fingers(stiffness)
    for name, side in (('above', -1), ('below', 1)):
        half = np.radians(0.5 * degrees) * side
        colliders[name]['orientation'] = [0.0, float(np.sin(half)), 0.0, float(np.cos(half))]
    return colliders


def clamped(setting=USUAL, *, substeps=8, density=0.2, colliders=None,
            gravity=(0, 0, 0), **options):
    """Return a strip along x of two rows, between two fingers at its start."""
    method, integrator = setting
    return simulate(*STRIP, **effects(damping=20.0), density=density, friction=MU,
                    gravity=gravity, method=method, integrator=integrator, substeps=substeps,
                    pose={'position': [0.0, -0.01, 0.0]},
                    colliders=fingers() if colliders is None else colliders, **options)


def effects(*, damping=0.0) -> dict:
    """Return the effects of scenes without layers, also of single particles: one step."""
    return {'effects': {'stretch': {'warp': 500.0, 'weft': 500.0}, 'shear': {'stiffness': 50.0}},
            'scene_effects': {'pin': {}, 'contact': {'thickness': R}, 'friction': {},
                              'damping': {'rate': damping}}}


def forces(simulation) -> np.ndarray:
    """Return the force of each finger [N], above and below."""
    stats = simulation.stats()
    return np.array([stats['pad_force_above_n'], stats['pad_force_below_n']])


def warp_edges(frame) -> np.ndarray:
    """Return the lengths of a strip's edges along x [m], shape (2, 6)."""
    return np.linalg.norm(np.diff(frame.x.reshape(2, 7, 3), axis=1), axis=2)


def forces_after(simulation, frames: int) -> float:
    """Return the force of one finger after some frames [N]."""
    run(simulation, frames)
    return float(forces(simulation)[0])


EVERY = quick_only(SETTINGS, USUAL)


@pytest.mark.parametrize('method, integrator', EVERY)
def test_a_squeeze_has_the_force_of_its_indentation(method, integrator):
    """F = K A times the indentation, from the first substep on."""
    for substeps, density, stiffness in product((1, 8, 128), (0.05, 1.0), (1e4, 2e8)):
        for iterations in (1,) if method == 'explicit' else (1, 4):
            simulation = clamped((method, integrator), substeps=substeps, density=density,
                                 iterations=iterations, colliders=fingers(stiffness))
            frame = run(simulation, 3)
            np.testing.assert_allclose(forces(simulation), stiffness * OVERLAP * CLAMPED,
                                       rtol=1e-9)
            np.testing.assert_allclose(frame.x[:, 2], 0.0, atol=1e-12)


def pulled(load, frames, setting=USUAL, *, substeps=8, density=0.2, stiffness=1e3,
           **options):
    """
    Return x of the clamped particles of a pulled strip, shape (rows, columns), before and after.

    ``load`` is its weight over 2 μ F, which grows for two seconds, and then stays.
    """
    simulation = clamped(setting, substeps=substeps, density=density,
                         colliders=fingers(stiffness), **options)
    force = 2.0 * MU * stiffness * OVERLAP * CLAMPED
    weight = load * force / float(simulation.state.mass.sum())
    for k in range(121):
        frame = simulation.step([SetKey('gravity', [weight * k / 120.0, 0.0, 0.0])])
        assert not frame.refused
    held = frame.x[:, 0].reshape(2, 7)[:, :3].copy()
    return held, run(simulation, frames).x[:, 0].reshape(2, 7)[:, :3]


TILTS = quick_only(product(SETTINGS, (1.0, 4.0), (1e4, 2e8)), (USUAL, 4.0, 2e8))


@pytest.mark.parametrize('setting, degrees, stiffness', TILTS)
def test_fingers_at_an_angle_hold(setting, degrees, stiffness):
    """The wedge does not press the strip out, since its angle is below that of friction."""
    for substeps in (8, 128):
        simulation = clamped(setting, substeps=substeps, colliders=tilted(degrees, stiffness))
        start = simulation.frame().x.copy()
        frame = run(simulation, 60)
        np.testing.assert_allclose(frame.x[:, 0], start[:, 0], atol=1e-6)
        above, below = forces(simulation)
        assert above == pytest.approx(below, rel=1e-6)
        assert above > 0.0


@pytest.mark.parametrize('method, integrator', EVERY)
def test_fingers_at_an_angle_slip_at_mu_less_its_sine(method, integrator):
    """Within 3 %: 2 F (μ - sin θ) towards the side where they open, 2 F (μ + sin θ) otherwise."""
    degrees, stiffness, sine = 3.0, 1e3, np.sin(np.radians(3.0))
    for way, limit in ((1.0, MU - sine), (-1.0, MU + sine)):
        for load, holds in ((0.97, True), (1.03, False)):
            simulation = clamped((method, integrator), colliders=tilted(degrees, stiffness))
            force = 2.0 * limit * forces_after(simulation, 3)
            weight = load * way * force / float(simulation.state.mass.sum())
            for k in range(121):
                frame = simulation.step([SetKey('gravity', [weight * k / 120.0, 0.0, 0.0])])
            before = frame.x[:, 0].reshape(2, 7)[:, :3].copy()
            moved = run(simulation, 120).x[:, 0].reshape(2, 7)[:, :3] - before
            assert (np.abs(moved).max() < 1e-4) == holds, (way, load, moved)


MATRIX = quick_only(product(SETTINGS, (8, 32, 128), (0.05, 0.2, 1.0)),
                    (USUAL, 8, 0.2))


@pytest.mark.parametrize('setting, substeps, density', MATRIX)
def test_a_clamped_strip_slips_at_twice_mu_times_the_force(setting, substeps, density):
    """V31: within 3 %."""
    held, now = pulled(0.97, 300, setting, substeps=substeps, density=density)
    assert np.abs(now - held).max() < 1e-4
    held, now = pulled(1.03, 300, setting, substeps=substeps, density=density)
    assert (now - held).min() > 1e-3


@pytest.mark.parametrize('options', [{'iterations': 5}, slow({'precision': 'float32'}),
                                     slow({'scale': 0.1})])
def test_the_limit_holds_with_iterations_and_in_float32(options):
    """A ``compliance_scale`` changes pads, too."""
    scale = options.get('scale', 1.0)
    held, now = pulled(0.97 / scale, 300, **options)
    assert np.abs(now - held).max() < 1e-4
    held, now = pulled(1.03 / scale, 300, **options)
    assert (now - held).min() > 1e-3


@pytest.mark.parametrize('setting, substeps, density', MATRIX)
def test_it_does_not_creep_below_that(setting, substeps, density):
    """A minute at 0.9 of the limit; with ``jacobi`` the strip takes a second to settle."""
    held, now = pulled(0.9, 3600, setting, substeps=substeps, density=density)
    assert np.abs(now - held).max() < 1e-4


def sheets(heights, colliders, setting=USUAL, substeps=8):
    """Return sheets at these heights."""
    method, integrator = setting
    return compile_scene(scene_from_mapping({
        'gravity': [0.0, 0.0, 0.0],
        'solver': {'method': method, 'integrator': integrator, 'substeps': substeps},
        'cloths': {f'c{k}': {
            'grid': {'size': [0.08, 0.08], 'resolution': [9, 9]}, 'density': 0.25,
            'friction': 0.5, 'pose': {'position': [-0.04, -0.04, height]},
            'effects': {'stretch': {'warp': 300.0, 'weft': 300.0}, 'shear': {'stiffness': 10.0},
                        'bend': {'stiffness': 5e-5}}} for k, height in enumerate(heights)},
        'colliders': colliders,
        'effects': {'contact': {'thickness': R}, 'self_collision': {'thickness': R},
                    'friction': {}, 'damping': {'rate': 0.5}},
    }, where='small.yaml', name='small'))


def layers(count, setting=USUAL, *, stiffness=1e7, substeps=8, indentation=OVERLAP):
    """Return sheets on one another, between fingers about their middle, and F by K A δ [N]."""
    high = 0.5 * (count + 1) * R - indentation + 0.01
    heights = [(k - 0.5 * (count - 1)) * R for k in range(count)]
    return sheets(heights, {name: {
        'box': {'size': [0.05, 0.05, 0.02]}, 'friction': 0.5, 'pad': {'stiffness': stiffness},
        'motion': [[0.0, 0.0, 0.0, side * (high + 0.003)], [0.1, 0.0, 0.0, side * high]]}
        for name, side in (('above', 1), ('below', -1))}, setting, substeps
    ), 25 * 0.01**2 * stiffness * indentation


@pytest.mark.slow
@pytest.mark.parametrize('method, integrator', SETTINGS)
@pytest.mark.parametrize('substeps', [4, 16, 64])
def test_two_layers_are_squeezed_by_the_indentation(method, integrator, substeps):
    """The layers transmit what the pads press with, and stay a thickness apart."""
    for stiffness in (1e5, 1e6, 1e7):
        simulation, force = layers(2, (method, integrator), stiffness=stiffness,
                                   substeps=substeps)
        frame = run(simulation, 60)
        np.testing.assert_allclose(forces(simulation), force, rtol=0.01)
        apart = (frame.x[81:] - frame.x[:81])[:, 2].reshape(9, 9)[2:7, 2:7]
        np.testing.assert_allclose(apart, R, rtol=0.02)
        assert np.abs(frame.v).max() < 0.05


@pytest.mark.parametrize('deep', [False, slow(True)])
def test_layers_that_both_touch_both_fingers_transmit_the_force(deep):
    """Colliders that push a layer apart from the other one, and towards it, count alike."""
    simulation, force = layers(2, stiffness=1e6, indentation=(0.9 if deep else 0.7) * R)
    frame = run(simulation, 60)
    np.testing.assert_allclose(forces(simulation), force, rtol=0.01)
    assert np.abs(frame.v).max() < 0.05


def test_a_table_does_not_pull_overlapping_layers_that_touch_it():
    """They part, and leave the table, at DEPENETRATION each; a finger presses on their end."""
    simulation = sheets((0.9 * R, 0.95 * R), {
        'table': {'box': {'size': [0.2, 0.2, 0.02]}, 'friction': 0.5,
                  'position': [0.0, 0.0, -0.01]},
        'finger': {'box': {'size': [0.03, 0.1, 0.02]}, 'friction': 0.5,
                   'position': [-0.04, 0.0, 1.5 * R + 0.01], 'pad': {'stiffness': 1e6}}})
    fastest = max(np.abs(simulation.step().v).max() for _ in range(30))
    assert simulation.stats()['pad_force_finger_n'] > 1.0
    assert fastest < 2.0 * DEPENETRATION


@pytest.mark.parametrize('method, integrator', EVERY)
def test_fingers_off_the_middle_press_with_equal_force(method, integrator):
    """The sheet goes to where both indentations give the same force."""
    for below, above, stiffness in ((0.0005, 0.0015, (2e8, 2e8)), (0.001, 0.001, (1e8, 3e8))):
        colliders = fingers(indentation=(above, below))
        for name, value in zip(('above', 'below'), stiffness):
            colliders[name]['pad'] = {'stiffness': value}
        simulation = clamped((method, integrator), colliders=colliders)
        run(simulation, 20)
        series = 1.0 / (1.0 / stiffness[0] + 1.0 / stiffness[1])
        np.testing.assert_allclose(forces(simulation), series * (above + below) * CLAMPED,
                                   rtol=1e-6)


def test_a_pad_against_a_rigid_table_takes_all_of_the_indentation():
    colliders = fingers()
    del colliders['below']['pad']
    simulation = clamped(colliders=colliders)
    frame = run(simulation, 20)
    assert simulation.stats()['pad_force_above_n'] == pytest.approx(
        2e8 * 2.0 * OVERLAP * CLAMPED, rel=1e-4)
    assert 'pad_force_below_n' not in simulation.stats()
    np.testing.assert_allclose(frame.x[0, 2], OVERLAP, atol=1e-7)


@pytest.mark.parametrize('method, integrator', EVERY)
@pytest.mark.parametrize('substeps', [1, 64])
def test_cloth_on_a_pad_sinks_in_by_its_weight(method, integrator, substeps):
    """By density g / K, whatever the size of the particles."""
    stiffness = 1e5
    simulation = simulate((1, 1), (0.03, 0.02), density=2.0, friction=0.0, method=method,
                          integrator=integrator, substeps=substeps,
                          pose={'position': [0.0, 0.0, R]},
                          colliders={'pad': {'plane': {}, 'pad': {'stiffness': stiffness}}},
                          **effects())
    frame = run(simulation, 120)
    assert R - frame.x[0, 2] == pytest.approx(2.0 * GRAVITY / stiffness, rel=1e-6)
    assert simulation.stats()['pad_force_pad_n'] == pytest.approx(2.0 * 6e-4 * GRAVITY, rel=1e-6)
    assert np.abs(frame.v).max() < 1e-9


def test_the_order_of_the_colliders_is_irrelevant():
    """Fingers that squeeze, slide against one another, turn away and come back."""
    ends = []
    for order in ((1, -1), (-1, 1)):
        simulation = clamped(colliders=fingers(order=order), substeps=4,
                             gravity=(3.0, 0.0, -1.0))
        for k in range(60):
            s, c = np.sin(0.05 * k), np.cos(0.05 * k)
            high = 0.01 + R - OVERLAP * (1.0 + 0.5 * s)
            frame = simulation.step([MoveCollider(name, Pose(
                (0.004 * side * s, 0.003 * c, side * high),
                (0.0, 0.0, float(np.sin(0.02 * side * s)), float(np.cos(0.02 * side * s)))))
                for name, side in (('above', 1), ('below', -1))])
            assert not frame.refused
        ends.append(frame.x.copy())
    assert np.abs(ends[0] - simulation.natural(simulation._start)).max() > 0.005
    np.testing.assert_allclose(*ends, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize('rough, follows', [(MU, 0.0), (1.2, 1.0), (0.4, -1.0)])
def test_between_fingers_that_slide_apart_cloth_follows_the_rougher_one(rough, follows):
    """It stays where both hold it alike."""
    colliders = fingers()
    colliders['above']['friction'] = rough
    simulation = clamped(colliders=colliders)
    for k in range(30):
        frame = simulation.step([MoveCollider(name, Pose(
            (0.0002 * side * k, 0.0, side * (0.01 + R - OVERLAP))))
            for name, side in (('above', 1), ('below', -1))])
    np.testing.assert_allclose(frame.x[0, 0], follows * 0.0058, atol=2e-4)


@pytest.mark.parametrize('count', [10, slow(200)])
def test_shared_friction_is_the_minimum_of_both(count):
    """Against a minimiser that knows nothing of the cases, along a line and in the plane."""
    rng = np.random.default_rng(3)
    for flat, _ in product((False, True), range(count)):
        p, r = (np.append(rng.normal(size=2), 0.0) * rng.choice([1e-3, 1.0]) for _ in range(2))
        if flat:
            p[1] = r[1] = 0.0
        slides = rng.uniform(0.0, 2.0, 2)
        first, second = shared_friction(tuple(p), tuple(r), tuple(slides), tuple(slides))

        def energy(q, p=p, r=r, slides=slides):
            return 0.5 * q @ q + slides @ [np.linalg.norm(p + q), np.linalg.norm(r + q)]

        q = np.add(first, second)
        best = min(minimize(energy, start, method='Nelder-Mead', options={
            'xatol': 1e-10, 'fatol': 1e-14}).fun for start in (-p, -r, q))
        assert energy(q) <= best + (1e-12 if flat else 0.02 * slides.sum())
        assert np.linalg.norm(first) <= slides[0] * (1.0 + 1e-12)
        assert np.linalg.norm(second) <= slides[1] * (1.0 + 1e-12)


@pytest.mark.parametrize('turned', [False, True])
@pytest.mark.parametrize('pull, slip', [(1.4, 0.0), (1.6, 0.6)])
def test_between_fingers_static_friction_of_one_holds_against_the_other(pull, slip, turned):
    """μ_s d = 1.5 m and μ_k d = 1 m of the finger at rest; the other slides far with ``pull``."""
    at_rest, far = (0.0, 0.0, 0.0), (-10.0, 0.0, 0.0)
    way, sticks, slides = (at_rest, far), (1.5, pull), (1.0, pull)
    if turned:
        way, sticks, slides = way[::-1], sticks[::-1], slides[::-1]
    found = shared_friction(*way, sticks, slides)
    np.testing.assert_allclose(np.sum(found, 0), [slip, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(found[0 if turned else 1], [pull, 0.0, 0.0], atol=1e-12)


@pytest.mark.parametrize('way, left', [(2.9, (0.0, 0.0)), (3.1, (1.1, 3.1))])
def test_fingers_at_rest_hold_with_both_static_frictions(way, left):
    """Both hold up to μ_s d = 1 m + 2 m; beyond that, μ_k d is 0.5 m and 1.5 m, or zero."""
    p = (0.0, way, 0.0)
    for slides, rest in zip(((0.5, 1.5), (0.0, 0.0)), left):
        found = shared_friction(p, p, (1.0, 2.0), slides)
        np.testing.assert_allclose(np.add(p, np.sum(found, 0)), [0.0, rest, 0.0], atol=1e-12)
        assert (np.linalg.norm(found, axis=1) <= ((1.0, 2.0) if rest == 0.0 else slides)).all()


class Solved(NamedTuple):
    """Fields of pads and contacts that ``solve`` reads."""

    normal: np.ndarray
    earlier: np.ndarray
    ratio: np.ndarray
    deficit: np.ndarray
    touches: np.ndarray


@pytest.mark.parametrize('count', [1, 2, 3, 4])
def test_the_pushes_of_several_pads_are_the_minimum_of_their_energy(count):
    """|u|² / 2 + Σ κ max(0, b - n·u)² / 2 of any colliders: u = Σ d n."""
    rng = np.random.default_rng(count)
    for _ in range(20):
        normal = rng.normal(size=(count, 3))
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        deficit, ratio = rng.normal(0.5, 1.0, count), 10.0**rng.uniform(-2.0, 2.0, count)
        pads = Solved(normal, np.arange(-1, count - 1), ratio, deficit,
                      (deficit > 0.0).astype(np.int32))
        u = np.array(solve(pads, pads, count - 1))
        np.testing.assert_allclose(
            u, (ratio * np.maximum(0.0, deficit - normal @ u)) @ normal, atol=1e-9)


def test_the_pushes_of_a_clamp_balance_along_its_axis():
    """The fingers are oblique, one is stiffer, and the particle is displaced across the axis."""
    rng = np.random.default_rng(5)
    for _ in range(20):
        normals = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]) + rng.normal(0.0, 0.2, (2, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        axis = (normals[0] - normals[1]) / np.linalg.norm(normals[0] - normals[1])
        z = np.cross(axis, rng.normal(size=3))
        ratio, deficit, along = 10.0**rng.uniform(-2.0, 2.0, 2), rng.normal(size=2), rng.normal()
        pads = Solved(normals, np.arange(2), ratio, deficit, np.zeros(2, np.int32))
        y, d = _pushes(pads, 0, 1, tuple(axis), tuple(map(tuple, normals)), tuple(deficit), along,
                       tuple(z))
        np.testing.assert_allclose(d, ratio * (deficit - normals @ (y * axis + z)), rtol=1e-12)
        assert y == pytest.approx(along + np.dot(d, normals @ axis), rel=1e-9)


def test_compliance_scale_divides_the_stiffness_of_pads():
    soft = clamped(colliders=fingers(1e6), scale=4.0).effects['contact'].colliders
    assert list(soft.stiffness[:2]) == [0.25e6, 0.25e6]


def test_it_is_rigid_without_a_pad_and_has_no_arrays():
    contact = clamped(colliders=fingers(None)).effects['contact']
    assert contact.data.contacts.pads is None
    assert contact.colliders.stiffness is None
    assert 'pad_force_above_n' not in contact.stats()


def test_the_stiffness_changes_live_and_placed_colliders_are_rigid():
    simulation = clamped(colliders=fingers(1e6))
    run(simulation, 3)
    frame = simulation.step([SetKey('colliders.above.pad.stiffness', 3e6)])
    assert not frame.refused
    run(simulation, 20)
    np.testing.assert_allclose(forces(simulation), 0.75e6 * 2.0 * OVERLAP * CLAMPED, rtol=1e-6)
    low = Pose((0.0, 0.0, -0.01 - R + OVERLAP))
    frame = simulation.step([PlaceCollider('below', 'box', (0.1, 0.1, 0.02), low),
                             PlaceCollider('new', 'sphere', (0.1,), Pose((5.0, 0.0, 0.0)))])
    assert not frame.refused
    assert list(simulation.effects['contact'].colliders.stiffness[:3]) == [3e6, 1e6, 0.0]
    frame = simulation.step([SetKey('colliders.above.pad.stiffness', 0.0)])
    assert frame.refused[0][1].endswith(
        'colliders.above.pad.stiffness: must be > 0 Pa/m (got 0.0)')


@pytest.mark.parametrize('pad, text', [
    (None, '.pad: has no value; give it {stiffness: Pa/m}, or leave it out'),
    (2e8, '.pad: must be a mapping {stiffness: Pa/m} (got 200000000.0)'),
    ('rubber', ".pad: must be a mapping {stiffness: Pa/m} (got 'rubber')"),
    ({}, '.pad.stiffness: missing (Pa/m)'),
    ({'stiffness': 0}, '.pad.stiffness: must be > 0 Pa/m (got 0)'),
    ({'stiffness': -2e8}, '.pad.stiffness: must be > 0 Pa/m (got -200000000.0)'),
    ({'stiffness': float('nan')}, '.pad.stiffness: must be finite Pa/m (got nan)'),
    ({'stiffness': 'soft'}, ".pad.stiffness: must be a number in Pa/m (got 'soft')"),
    ({'stifness': 2e8}, ".pad.stifness: unknown key; did you mean 'stiffness'? "
     '(known: stiffness)'),
    ({'stiffness': 2e8, 'thickness': 0.01},
     ".pad.thickness: unknown key; did you mean 'stiffness'? (known: stiffness)")])
def test_a_pad_without_sense_is_refused(pad, text):
    with pytest.raises(InputError) as error:
        clamped(colliders={'s': {'sphere': {'radius': 0.1}, 'pad': pad}})
    assert str(error.value) == f'small.yaml: colliders.s{text}'


def test_cloth_too_heavy_for_its_substeps_is_reported():
    """At once, with the number of substeps that carries it; not without pads."""
    def notes(substeps, stiffness=2e8):
        return clamped(('jacobi', 'bdf2'), substeps=substeps, gravity=(0.0, 0.0, -5000.0),
                       colliders=fingers(stiffness)).notes

    (text,) = notes(8)
    assert text == ('cloths.c: 8 substeps of jacobi carry 1.73 N/m into a grip of pads, and it '
                    'weighs 150 N/m, so it may be pulled out; take 75 substeps, or method line')
    assert len(notes(74)) == 1
    assert notes(75) == () == notes(8, None)


@pytest.mark.parametrize('method, substeps', [('line', 8), slow('gauss_seidel', 8),
                                              slow('gauss_seidel_symmetric', 8),
                                              slow('jacobi', 32)])
def test_a_grip_holds_the_tension_that_is_said(method, substeps):
    """At 0.97 of 2 μ F, for a tension of 0.9 of ``carried_tension``."""
    (cloth,) = clamped().cloths
    tension = 0.9 * carried_tension(method, cloth, 0.2, 1.0 / (60.0 * substeps))
    stiffness = tension * 0.02 / (0.97 * 2.0 * MU * OVERLAP * CLAMPED)
    setting = (method, 'ndf2' if method == 'line' else 'bdf2')
    held, now = pulled(0.97, 120, setting, substeps=substeps, stiffness=stiffness)
    assert np.abs(now - held).max() < 1e-3


def test_a_pad_that_bounces_is_refused():
    with pytest.raises(InputError) as error:
        clamped(colliders=fingers(restitution=0.5))
    assert str(error.value) == (
        'small.yaml: colliders.above: restitution: must be 0 beside a pad (got 0.5); leave out '
        'one of the two')


@pytest.mark.parametrize('stiffness', [1e-3, 1e3, 1e7, 1e11, 1e15])
@pytest.mark.parametrize('method, integrator', EVERY)
def test_any_stiffness_stays_finite_and_slow(method, integrator, stiffness):
    """Fingers that appear in the cloth and go through one another; without them it recovers."""
    simulation = clamped((method, integrator), colliders=fingers(
        stiffness, indentation=(0.008, 0.006)))
    for k in range(60):
        far = MoveCollider('above', Pose((0.0, 0.0, (-1.0, 1.0)[k // 10 % 2])))
        frame = simulation.step([far])
        assert np.isfinite(frame.x).all() and np.isfinite(frame.v).all()
        assert np.abs(frame.v).max() < 12.0
        assert warp_edges(frame).max() < 1.5 * 0.025    # no part is caught and torn along
    frame = run(simulation, 120, [RemoveAllColliders()])
    assert simulation.stats()['frames_taken_back'] == 0
    assert np.abs(frame.v).max() < 0.01
    np.testing.assert_allclose(warp_edges(frame), 0.025, rtol=1e-3)


@pytest.mark.parametrize('stiffness', [1e6, 1e9, 1e13])
def test_an_overlap_comes_apart_slowly(stiffness):
    """A collider that appears half a centimetre deep in the cloth is not a catapult."""
    simulation = clamped(colliders={'s': {
        'box': {'size': [1.0, 1.0, 0.2]}, 'position': [0.0, 0.0, -0.095],
        'pad': {'stiffness': stiffness}}})
    place, fastest = simulation.frame().x, 0.0
    for _ in range(60):
        frame = simulation.step()
        fastest = max(fastest, np.abs(frame.x - place).max() / simulation.frame_dt)
        place = frame.x.copy()
    assert 0.2 < fastest <= 1.001 * DEPENETRATION
    np.testing.assert_allclose(frame.x[:, 2], 0.005 + R, atol=1e-3 if stiffness < 1e9 else 2e-4)
    assert np.abs(frame.v).max() < 0.05


def one_particle(depth, *, stiffness, substeps=1, density=2.0, **keys):
    """Return a weightless particle at a given depth in a pad that faces upwards."""
    return simulate((1, 1), (0.03, 0.02), density=density, friction=0.0, gravity=(0, 0, 0),
                    method='line', integrator='ndf2', substeps=substeps,
                    pose={'position': [0.0, 0.0, R - depth]},
                    colliders={'pad': {'plane': {}, 'pad': {'stiffness': stiffness}, **keys}},
                    **effects())


def test_what_meets_a_pad_that_is_resolved_bounces():
    """The rebound takes half a period, 168 substeps, and loses a few per cent of the speed."""
    simulation = one_particle(-1e-3, stiffness=1e6, substeps=2000, density=0.2)
    simulation.state.v[2, 0] = -0.3
    assert 0.27 < run(simulation, 2).v[0, 2] < 0.3


@pytest.mark.parametrize('speed', [0.5, -0.5])
def test_what_sinks_into_a_moving_pad_goes_on_with_it(speed):
    """Under a force equal to its weight it has the depth that it has in a pad at rest."""
    simulation = one_particle(0.0, stiffness=1e5, substeps=4, motion=[
        [0.0, 0.0, 0.0, 0.0], [2.0, 0.0, 0.0, 2.0 * speed]])
    simulation.state.v[2, 0] = speed
    simulation.state.gravity[2] = -GRAVITY
    frame = run(simulation, 60)
    assert speed + R - frame.x[0, 2] == pytest.approx(2.0 * GRAVITY / 1e5, rel=1e-6)
    assert frame.v[0, 2] == pytest.approx(speed, abs=1e-6)


def test_a_particle_that_moves_is_solved_again():
    """It keeps 1 / (1 + κ) of its way; also one that was out of reach of the pad before."""
    simulation = one_particle(0.0, stiffness=1e5, substeps=4)
    simulation.state.gravity[2] = -GRAVITY
    run(simulation, 60)
    state, contacts = simulation.state, simulation.effects['contact'].contacts
    pads, [k] = contacts.pads, range(contacts.count[0])
    i, x = contacts.particle[k], state.x
    at_rest = x[2, i]
    press_pads(pads, contacts, state)
    assert x[2, i] == at_rest
    x[2, i] -= 1e-5
    press_pads(pads, contacts, state)
    assert at_rest - x[2, i] == pytest.approx(1e-5 / (1.0 + pads.ratio[k]), rel=1e-6)
    x[2, i] += 1.0
    for _ in range(2):
        press_pads(pads, contacts, state)
    free = x[2, i]
    assert contacts.push[k] == 0.0
    x[2, i] += R - 1e-5 - free
    press_pads(pads, contacts, state)
    assert R - x[2, i] == pytest.approx(1e-5 / (1.0 + pads.ratio[k]), rel=1e-6)


@pytest.mark.parametrize('depth', [0.009, 0.02])
def test_what_leaves_a_pad_by_itself_keeps_its_speed(depth):
    """It leaves at 0.5 m/s; only the velocity that the pad's recovery adds is removed."""
    simulation = one_particle(depth, stiffness=1e8)
    simulation.state.v[2, 0] = 0.5
    frame = simulation.step()
    assert frame.x[0, 2] > R - depth + 0.5 / 60.0 + 1e-4, 'pushed'
    assert frame.v[0, 2] == pytest.approx(0.5, abs=1e-3)


@pytest.mark.parametrize('substeps', [1, 20, 2000])
def test_what_falls_on_a_pad_gains_no_energy(substeps):
    """Unresolved it stays, resolved it comes back with the speed of recovery at most."""
    simulation = simulate((1, 1), (0.04, 0.01), density=0.2, substeps=substeps, friction=0.0,
                          method='line', integrator='ndf2',
                          pose={'position': [0.0, 0.0, 0.3]},
                          colliders={'pad': {'plane': {}, 'pad': {'stiffness': 1e6}}},
                          **effects())
    up = 0.0
    for _ in range(90):
        up = max(up, simulation.step().v[0, 2])
    assert up <= DEPENETRATION
    assert simulation.frame().x[0, 2] < 0.06
    if substeps == 1:
        assert up < 1e-3


def test_a_body_is_pressed_on_its_surface_only(tmp_path):
    """Its particles have a share of the skin's area; those inside have none."""
    mesh = solid_mesh(*box((2, 2, 2), 0.1))
    area = surface_area(mesh)
    assert area.sum() == pytest.approx(6.0 * 0.2**2)
    inside = (np.abs(mesh.positions - mesh.positions.mean(0)) < 0.09).all(1)
    assert inside.sum() == 1
    np.testing.assert_array_equal(area[inside], 0.0)
    sheet = grid_mesh((0.3, 0.2), (4, 3))
    assert surface_area(sheet).sum() == pytest.approx(0.06)


def test_a_pad_of_a_curved_surface_presses_along_its_normal():
    """Two balls, one above the other, and a particle between them off their axis."""
    simulation = simulate((1, 1), (0.02, 0.005), gravity=(0, 0, 0), friction=0.0, substeps=4,
                          method='line', integrator='ndf2',
                          pose={'position': [0.001, 0.0, 0.0]}, colliders={
                              name: {'sphere': {'radius': 0.02}, 'pad': {'stiffness': 1e7},
                                     'position': [0.0, 0.0, side * (0.02 + R - OVERLAP)]}
                              for name, side in (('above', 1), ('below', -1))}, **effects())
    x = simulation.step().x[0].copy()
    contact = simulation.effects['contact'].contacts
    gaps = [np.linalg.norm(x - [0.0, 0.0, side * (0.02 + R - OVERLAP)]) - 0.02 for side in (1, -1)]
    np.testing.assert_allclose(contact.pads.force[:2],
                               1e7 * 1e-4 * np.maximum(0.0, R - np.array(gaps)), rtol=1e-3,
                               atol=1e-9)
    assert x[0] > 0.001
