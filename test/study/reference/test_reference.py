"""The reference solver against closed forms, against itself, and last against the simulation."""

from dataclasses import replace
import subprocess
import sys

import numpy as np
import pytest
from scipy.linalg import eigh
from scipy.special import ellipk

from support.tiers import slow
from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import scene_from_mapping
from xpbd_ros.sim.commands import Pose
from xpbd_ros.sim.effect import Built
from xpbd_ros.study.reference import (
    Edges,
    elastic,
    equilibrium,
    explicit,
    gradient,
    highest_frequency,
    highest_frequency_bound,
    kinetic,
    leapfrog,
    limit,
    LinearSums,
    newton,
    potential,
    Problem,
    problem_of,
    richardson,
    rms,
    StepTooLongError,
    Stiffness,
)

METHODS = ('backward_euler', 'bdf2', 'explicit')
G = 9.81


def advance(method, problem, dt, steps):
    if method == 'explicit':
        return explicit(problem, dt, steps)
    return newton(problem, dt, steps, integrator=method)


def sheet(count, *, stretch=5000.0, shear=5.0, bend=None, damping=None, motion=None, pins=True,
          solver=None, **sections):
    """Return the compiled swing: 1 m x 1 m, 200 g/m², horizontal, two corners pinned."""
    effects = {'stretch': {'warp': stretch, 'weft': stretch}, 'shear': {'stiffness': shear}}
    if bend:
        effects['bend'] = {'stiffness': bend}
    raw = {'cloths': {'sheet': {'grid': {'size': [1.0, 1.0], 'resolution': [count, count]},
                                'density': 0.2, 'effects': effects}},
           'solver': solver or {'method': 'gauss_seidel', 'substeps': 8}, **sections}
    if pins:
        raw['pins'] = {'left': {'cloth': 'sheet', 'at': 'corner_10'},
                       'right': {'cloth': 'sheet', 'at': 'corner_11'}}
        if motion:
            raw['pins']['left']['motion'] = motion
    if damping:
        raw['effects'] = {'damping': {'rate': damping}}
    return compile_scene(scene_from_mapping(raw, where='test', name='test'))


SWAY = [[0.0, 0.0, 1.0, 0.0], [0.1, 0.1, 1.0, 0.1], [0.2, 0.0, 0.9, 0.1]]


def tangle(seed=3):
    """Return a problem with every term in it, far from rest, and positions of its particles."""
    rng = np.random.default_rng(seed)
    problem = problem_of(sheet(5, stretch=300.0, shear=40.0, bend=0.01, damping=0.7))
    x = problem.x + 0.1 * rng.standard_normal(problem.x.shape)
    assert len(problem.all_of(LinearSums)[0])
    ends, rest, _ = problem.all_of(Edges)
    stretched = np.linalg.norm(np.diff(x[ends], axis=1)[:, 0], axis=1)
    assert (stretched < rest).any()
    assert (stretched > rest).any()
    return problem, x


def edges(particles, rest_length, stiffness):
    return (Edges(particles=particles, rest_length=rest_length, stiffness=stiffness),)


def oscillator(**options):
    """Return Macklin's oscillator: compliance 1e-3 m/N, 1 kg, drawn out from 1 m to 1.5 m."""
    return Problem(x=[[0, 0, 0], [1.5, 0, 0]], mass=[1, 1], pinned=[True, False],
                   elements=edges([[0, 1]], [1], [1000]), **options)


OMEGA = np.sqrt(1000.0)


def spinning(stiffness=4000.0, omega=2.0 * np.pi):
    """Return two masses of 1 kg that circle each other 1 m apart, the edge drawn out to that."""
    half = 0.5
    rest = 1.0 - omega**2 * half / stiffness
    speed = omega * half
    return Problem(x=[[half, 0, 0], [-half, 0, 0]], v=[[0, speed, 0], [0, -speed, 0]],
                   mass=[1, 1], elements=edges([[0, 1]], [rest], [stiffness]))


def spin(problem, x, v):
    return np.cross(x, problem.mass[:, None] * v).sum(0)[2]


def chain(x, rest, stiffness, mass, pinned, **options):
    """Return edges from each particle to the next."""
    n = len(x)
    return Problem(x=x, mass=mass, pinned=pinned, gravity=[0, 0, -G], elements=edges(
        np.stack([np.arange(n - 1), np.arange(1, n)], 1), np.full(n - 1, rest),
        np.full(n - 1, stiffness)), **options)


# The energy and its derivatives

def test_the_gradient_is_that_of_the_energy():
    problem, x = tangle()
    found, eps = gradient(problem, x), 1e-5
    for i, k in np.ndindex(x.shape):
        e = np.zeros_like(x)
        e[i, k] = eps
        slope = (potential(problem, x + e) - potential(problem, x - e)) / (2.0 * eps)
        assert slope == pytest.approx(found[i, k], abs=1e-6 * np.abs(found).max())


def test_the_hessian_is_of_the_energy_of_the_free_particles():
    problem, x = tangle()
    stiffness, eps = Stiffness(problem), 1e-6
    found = stiffness.matrix(x, mass=7.0).toarray()
    free = stiffness.particles
    assert sorted(free) == np.flatnonzero(~problem.pinned).tolist()
    expected = np.zeros_like(found)
    for c, (i, k) in enumerate((i, k) for i in free for k in range(3)):
        e = np.zeros_like(x)
        e[i, k] = eps
        change = gradient(problem, x + e) - gradient(problem, x - e)
        expected[:, c] = (change / (2.0 * eps))[free].ravel()
        expected[c, c] += 7.0 * problem.mass[i]
    np.testing.assert_allclose(found, expected, atol=1e-6 * np.abs(found).max())


def test_the_clamped_hessian_is_semi_definite():
    problem, x = tangle()
    stiffness = Stiffness(problem)
    full, clamped = (np.linalg.eigvalsh(stiffness.matrix(x, clamp=c).toarray())
                     for c in (False, True))
    assert full[0] < -1.0
    assert clamped[0] > -1e-10 * clamped[-1]
    assert not stiffness.stable(x)
    drawn = 1.5 * problem.x
    assert stiffness.stable(drawn)
    np.testing.assert_allclose(stiffness.matrix(drawn).toarray(),
                               stiffness.matrix(drawn, clamp=True).toarray(), atol=1e-11)


def test_leapfrog_and_newton_see_the_same_forces():
    """They are computed twice over; a first kick from rest shows leapfrog's."""
    problem, x = tangle()
    dt = 1e-9
    _, v = explicit(replace(problem, x=x, damping=0.0), dt, 1)
    expected = -gradient(problem, x) / problem.mass[:, None]
    expected[problem.pinned] = 0.0
    np.testing.assert_allclose(v / dt, expected, atol=1e-7 * np.abs(expected).max())


def test_it_shares_no_code_with_the_simulation():
    found = subprocess.run(
        [sys.executable, '-c', 'import sys, xpbd_ros.study.reference\n'
         'print(*(m for m in sys.modules if m.startswith("xpbd_ros")))'],
        capture_output=True, text=True, check=True).stdout.split()
    assert 'xpbd_ros.study.reference' in found
    assert not [name for name in found
                if name.startswith(('xpbd_ros.sim', 'xpbd_ros.effects', 'xpbd_ros.scene'))]


# What is read from a simulation

def test_a_simulation_and_its_problem_store_the_same_energy():
    simulation = sheet(5, stretch=300.0, shear=40.0, bend=0.01, damping=0.7)
    problem, x = problem_of(simulation), tangle()[1]
    by_slot = np.zeros_like(simulation.state.x)
    by_slot[:, simulation.slot] = x.T
    expected = sum(simulation.effects[name].constraints.energy(by_slot)
                   for name in ('stretch', 'shear', 'bend'))
    assert elastic(problem, x) == pytest.approx(expected, rel=1e-12)
    np.testing.assert_array_equal(problem.x, simulation.frame().x)
    np.testing.assert_allclose(problem.mass.reshape(5, 5)[:3, :3] / problem.mass[6],
                               [[0.25, 0.5, 0.5], [0.5, 1, 1], [0.5, 1, 1]])
    assert problem.mass.sum() == pytest.approx(0.2, rel=1e-14)
    np.testing.assert_array_equal(np.flatnonzero(problem.pinned), [20, 24])
    np.testing.assert_array_equal(problem.gravity, simulation.state.gravity)
    assert problem.damping == 0.7
    assert problem.motion is None


def test_pins_move_as_they_do_in_the_simulation():
    """Also when it has been under way for a while, and straight between two frames."""
    simulation = sheet(4, motion=SWAY)
    for _ in range(3):
        simulation.step()
    problem = problem_of(simulation)
    frames = [simulation.frame().x[problem.pinned].copy()]
    for _ in range(14):
        frames.append(simulation.step().x[problem.pinned].copy())
    dt = simulation.frame_dt
    for k, expected in reversed(list(enumerate(frames))):
        np.testing.assert_allclose(problem.at(k * dt), expected, atol=1e-14)
    np.testing.assert_allclose(problem.at(2.25 * dt), 0.75 * frames[2] + 0.25 * frames[3],
                               atol=1e-14)
    assert rms(frames[0] - frames[-1]) > 0.02


def test_what_the_reference_does_not_know_is_named():
    with pytest.raises(InputError, match='effects.contact: ') as error:
        problem_of(sheet(3, pins=False, effects={'contact': {'thickness': 0.01}},
                         colliders={'floor': {'plane': {'normal': [0, 0, 1]}}}))
    assert 'has no energy, being an inequality' in str(error.value)


def test_a_pin_that_slips_is_refused():
    simulation = sheet(3)
    simulation.effects['pin'].held['left'].slip = 1.0
    with pytest.raises(InputError, match='pins.left: the reference solver has no slip'):
        problem_of(simulation)


def test_a_pin_that_turns_is_refused():
    simulation = sheet(3)
    turned = Pose((0.0, 1.0, 0.0), (0.0, 0.0, 1.0, 0.0))
    simulation.effects['pin'].held['left'].motion.target = turned
    with pytest.raises(InputError, match='pins.left: the reference solver cannot turn a pin'):
        problem_of(simulation)


def test_a_pin_on_a_spring_gives_way_by_its_compliance_as_a_whole():
    """The displacement is Σ m g α for any number of held particles."""
    simulation = compile_scene(scene_from_mapping({
        'gravity': [0.0, 0.0, -G], 'cloths': {'c': {
            'grid': {'size': [0.3, 0.2], 'resolution': [4, 3]}, 'density': 0.5,
            'effects': {'stretch': {'warp': 300.0, 'weft': 300.0}}}},
        'pins': {'a': {'cloth': 'c', 'at': 'edge_x0', 'compliance': 0.02}}}, where='x', name='x'))
    x = equilibrium(problem_of(simulation))
    held = simulation.frame().x[:, 0] == 0.0
    assert held.sum() == 3
    assert x[:12][held, 2].mean() == pytest.approx(-0.5 * 0.06 * G * 0.02, rel=1e-9)


def test_a_strip_has_no_cells_and_is_solved():
    strip, plain = (problem_of(compile_scene(scene_from_mapping(
        {'cloths': {'rope': {'grid': {'size': [1.0, 0.1], 'resolution': [5, 1]}, 'density': 0.2,
                             'effects': {'stretch': {'warp': 30.0, 'weft': 30.0}, **more}}},
         'pins': {'end': {'cloth': 'rope', 'at': 'corner_00'}}}, where='test', name='test')))
        for more in ({'shear': {'stiffness': 5.0}}, {}))
    for method in ('explicit', 'bdf2'):
        found, same = (limit(one, 0.1, 1e-3, method=method, levels=4) for one in (strip, plain))
        np.testing.assert_array_equal(found.x, same.x)


def test_a_cloth_that_is_all_pinned_is_refused():
    with pytest.raises(InputError, match='pins: no particle is free'):
        problem_of(compile_scene(scene_from_mapping(
            {'cloths': {'c': {'grid': {'size': [1.0, 0.1], 'resolution': [2, 1]}, 'density': 0.2}},
             'pins': {'end': {'cloth': 'c', 'at': [0, 1]}}}, where='test', name='test')))


def test_rigid_edges_are_refused():
    raw = {'cloths': {'rope': {'grid': {'size': [1.0, 0.1], 'resolution': [5, 1]}, 'density': 0.2,
                               'effects': {'stretch': {'compliance': 0.0}}}}}
    with pytest.raises(InputError, match=r'must be > 0 m/N \(got 0\)'):
        problem_of(compile_scene(scene_from_mapping(raw, where='test', name='test')))


@pytest.mark.parametrize('change, message', [
    ({'mass': [1.0, 0.0]}, 'mass: must be > 0'),
    ({'mass': [1.0]}, r'mass: must have shape \(2,\)'),
    ({'elements': edges([[0, 2]], [1], [1])}, 'edges: particles must be from 0 to 1'),
    ({'pinned': [True, True]}, 'no particle is free'),
    ({'damping': -1.0}, 'damping: must be >= 0'),
    ({'motion': lambda t: np.zeros((2, 3))}, r'motion: must give shape \(1, 3\)'),
])
def test_a_problem_without_meaning_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        replace(oscillator(), **change)


# One step: exact recurrences

def test_free_fall_is_what_each_formula_makes_of_it():
    problem = Problem(x=[[0, 0, 2]], v=[[1, 0, 0]], mass=[3], gravity=[0, 0, -G])
    dt, n = 1.0 / 60.0, 60
    fall = {'explicit': 0.5 * G * (n * dt)**2, 'backward_euler': 0.5 * G * dt**2 * n * (n + 1)}
    for method, expected in fall.items():
        x, v = advance(method, problem, dt, n)
        np.testing.assert_allclose(x, [[1, 0, 2 - expected]], atol=1e-12)
        np.testing.assert_allclose(v, [[1, 0, -G]], atol=1e-12)


@pytest.mark.parametrize('rate', [60, 240])
def test_the_oscillator_decays_and_lags_by_the_known_factors(rate):
    """V2: backward Euler multiplies by 1/(1 - i s) each step, leapfrog turns by 2 asin(s/2)."""
    s, n = OMEGA / rate, 30
    x, v = newton(oscillator(), 1.0 / rate, n)
    z = 0.5 / (1.0 - 1j * s)**n
    assert x[1, 0] - 1.0 == pytest.approx(z.real, abs=1e-9)
    assert v[1, 0] == pytest.approx(-OMEGA * z.imag, abs=1e-8)
    assert abs(z / 0.5)**(1 / n) == pytest.approx({60: 0.884652, 240: 0.991431}[rate], abs=1e-6)
    x, _ = explicit(oscillator(), 1.0 / rate, n)
    assert x[1, 0] - 1.0 == pytest.approx(0.5 * np.cos(2.0 * n * np.arcsin(s / 2.0)), abs=1e-12)


@pytest.mark.parametrize('integrator, rate, expected', [
    ('backward_euler', 60, 0.658), ('backward_euler', 240, 0.8676),
    ('backward_euler', 960, 0.9613), ('bdf2', 60, 0.9837), ('bdf2', 240, 0.99909)])
def test_a_spinning_pair_loses_as_much_spin_as_it_must(integrator, rate, expected):
    """V4: by 1/sqrt(1 + 2 ω² dt t) with backward Euler, far less with BDF2."""
    problem = spinning(stiffness=1e7)
    x, v = newton(problem, 1.0 / rate, rate, integrator=integrator)
    left = spin(problem, x, v) / spin(problem, problem.x, problem.v)
    assert left == pytest.approx(expected, abs=1e-3)


def test_momentum_is_kept():
    """All of it, by both; of the angular momentum leapfrog keeps all too."""
    rng = np.random.default_rng(0)
    problem = problem_of(sheet(5, stretch=300.0, shear=40.0, bend=0.01, pins=False))
    problem = replace(problem, v=rng.standard_normal(problem.x.shape), gravity=np.zeros(3))
    start = problem.mass @ problem.v
    turning = (problem.mass[:, None] * np.cross(problem.x, problem.v)).sum(0)
    for method in METHODS:
        x, v = advance(method, problem, 1e-3, 100)
        np.testing.assert_allclose(problem.mass @ v, start, atol=1e-10)
        np.testing.assert_allclose(problem.mass @ (x - problem.x), 0.1 * start, atol=1e-10)
    x, v = explicit(problem, 1e-3, 100)
    np.testing.assert_allclose((problem.mass[:, None] * np.cross(x, v)).sum(0), turning,
                               atol=1e-14)


def test_leapfrog_keeps_the_energy_to_second_order():
    problem = problem_of(sheet(5, stretch=300.0, shear=40.0, bend=0.01))
    lost = []
    for steps in (400, 800):
        x, v = explicit(problem, 0.4 / steps, steps)
        lost.append(abs(kinetic(problem, v) + potential(problem, x)
                        - potential(problem, problem.x)))
    assert kinetic(problem, v) > 0.1
    assert np.log2(lost[0] / lost[1]) == pytest.approx(2.0, abs=0.15)


# To dt -> 0: closed forms

@pytest.mark.parametrize('method, levels, worst', [
    ('explicit', 10, 1e-9), slow('bdf2', 6, 1e-3), slow('backward_euler', 6, 3e-2)])
@pytest.mark.parametrize('c', [0.0, slow(3.0)])
def test_the_limit_of_the_oscillator_is_within_its_uncertainty(method, levels, worst, c,
                                                               tmp_path):
    """And the uncertainty is worth something: it is small, and not below the error."""
    t, omega = 0.37, np.sqrt(OMEGA**2 - c**2 / 4.0)
    decay, phase = 0.5 * np.exp(-c * t / 2.0), omega * t
    x = 1.0 + decay * (np.cos(phase) + c / (2.0 * omega) * np.sin(phase))
    v = -decay * OMEGA**2 / omega * np.sin(phase)
    for count in range(4, levels + 1):
        found = limit(oscillator(damping=c), t, 0.0, method=method, levels=count,
                      dt=None if method == 'explicit' else 1.0 / 120.0, cache=tmp_path)
        assert abs(found.x[1, 0] - x) / np.sqrt(2.0) <= found.uncertainty
        assert abs(found.v[1, 0] - v) / np.sqrt(2.0) <= found.uncertainty_v
    assert found.uncertainty <= worst


def test_the_limit_of_a_spinning_pair_is_a_circle():
    problem = spinning()
    t = 0.4
    angle = 2.0 * np.pi * t
    expected = 0.5 * np.array([[np.cos(angle), np.sin(angle), 0.0],
                               [-np.cos(angle), -np.sin(angle), 0.0]])
    for method, levels, worst in (('explicit', 9, 1e-9), ('bdf2', 5, 1e-5)):
        found = limit(problem, t, 1e-9, method=method, dt=1.0 / 120.0, levels=levels)
        assert found.error(expected) <= found.uncertainty <= worst


@pytest.mark.parametrize('degrees, ratio', [(10, 1.001907), (45, 1.039973), (90, 1.180341),
                                            (120, 1.372881)])
def test_a_pendulum_on_a_stiff_edge_has_the_known_period(degrees, ratio):
    """V5: after a quarter period it hangs straight down; what the edge gives fades as 1 / k."""
    start = np.radians(degrees)
    exact = 2.0 / np.pi * ellipk(np.sin(start / 2.0)**2)
    assert exact == pytest.approx(ratio, abs=1e-6)
    quarter = 0.5 * np.pi / np.sqrt(G) * exact
    angles = []
    for k in (1e5, 1e6):
        l = 1.0 + G * np.cos(start) / k
        problem = chain([[0, 0, 0], [l * np.sin(start), 0, -l * np.cos(start)]], 1.0, k, [1, 1],
                        [True, False])
        x = limit(problem, quarter, 1e-8).x[1]
        angles.append(np.arctan2(x[0], -x[2]))
    assert abs(angles[1]) < 0.2 * abs(angles[0]) < 2e-4
    assert (10.0 * angles[1] - angles[0]) / 9.0 == pytest.approx(0.0, abs=3e-7)


def test_a_moving_pin_drives_the_oscillator():
    """Towed at a constant speed from rest: z = u t - (u / ω) sin ω t behind it."""
    u, t = 0.3, 0.2
    problem = Problem(x=[[0, 0, 0], [1, 0, 0]], mass=[1, 1], pinned=[True, False],
                      elements=edges([[0, 1]], [1], [1000]), motion=lambda t: [[u * t, 0, 0]])
    expected = 1.0 + u * t - u / OMEGA * np.sin(OMEGA * t)
    for method, levels, worst in (('explicit', 9, 1e-9), ('bdf2', 5, 1e-6)):
        found = limit(problem, t, 1e-9, method=method, dt=1.0 / 120.0, levels=levels)
        assert abs(found.x[1, 0] - expected) <= np.sqrt(2.0) * found.uncertainty <= worst
        np.testing.assert_allclose(found.x[0], [u * t, 0, 0], atol=1e-12)
        np.testing.assert_allclose(found.v[0], [u, 0, 0], atol=1e-9)


@pytest.mark.parametrize('method', METHODS)
def test_a_pin_has_the_velocity_of_its_path(method):
    """The velocity is exact for a path of constant acceleration."""
    problem = oscillator(motion=lambda t: [[3.0 * t - 2.0 * t * t, 0.0, t * t]])
    _, v = advance(method, problem, 0.025, 8)
    np.testing.assert_allclose(v[0], [3.0 - 4.0 * 0.2, 0.0, 0.4], rtol=1e-12)


def test_a_limit_is_known_no_better_than_its_numbers_are_rounded():
    """The leapfrog integrates free fall exactly; far from the origin only rounding remains."""
    problem = Problem(x=[[1e6, 0, 2]], v=[[1, 0, 0]], mass=[3], gravity=[0, 0, -G])
    found = limit(problem, 0.7, 1e-15)
    assert found.error(np.array([[1e6 + 0.7, 0.0, 2.0 - 0.245 * G]])) <= found.uncertainty
    assert np.spacing(1e6) < found.uncertainty < 1e-7


# Statics: closed forms

@pytest.mark.parametrize('count', [2, 5, 33])
def test_a_hanging_strip_stretches_as_the_continuum_does(count):
    """V6: by ρ g L² / (2 E), whatever the number of particles."""
    modulus, density, length = 20.0, 0.2, 1.0
    raw = {'cloths': {'strip': {'grid': {'size': [0.1, length], 'resolution': [2, count]},
                                'pose': {'orientation': [-np.sqrt(0.5), 0, 0, np.sqrt(0.5)]},
                                'density': density,
                                'effects': {'stretch': {'warp': modulus, 'weft': modulus}}}},
           'gravity': [0.0, 0.0, -G], 'pins': {'top': {'cloth': 'strip', 'at': 'edge_0x'}}}
    problem = problem_of(compile_scene(scene_from_mapping(raw, where='test', name='test')))
    x = equilibrium(problem)
    drop = np.ptp(x[:, 2]) - length
    assert drop == pytest.approx(density * G * length**2 / (2.0 * modulus), rel=1e-9)


def catenary(n, ratio=1.5):
    """Return the sag / D and H / (q D) of n stiff edges between supports at one height."""
    D, q = 1.0, 1.0
    S, s = ratio * D, np.linspace(-1.0, 1.0, n + 1)
    mass = np.full(n + 1, q * S / n / G)
    problem = chain(np.stack([0.5 * D * s, 0.0 * s, 0.55 * (s**2 - 1.0)], 1), S / n, 1e6 * n,
                    mass, np.abs(s) == 1.0)
    x = equilibrium(problem)
    first = x[1] - x[0]
    l = np.linalg.norm(first)
    return np.array([-x[:, 2].min() / D, 1e6 * n * (l - S / n) * first[0] / l / (q * D)])


def test_a_chain_hangs_in_a_catenary():
    """V8, second order in the length of an edge."""
    errors = np.array([np.abs(catenary(n) - [0.502633, 0.308236]) for n in (16, 32, 64)])
    assert (errors[-1] < 1e-4).all()
    np.testing.assert_allclose(np.log2(errors[:-1] / errors[1:]), 2.0, atol=0.15)


def beam(n, gravity, stiffness=1e6, mass=1.0):
    """Return a clamped strip of unit length, rigidity and weight per g: particles -1, 0, 1 … n."""
    h = 1.0 / n
    i = np.arange(n)
    return Problem(
        x=np.stack([np.arange(-1, n + 1) * h, np.zeros(n + 2), np.zeros(n + 2)], 1),
        mass=mass * h * np.r_[np.ones(n + 1), 0.5], pinned=np.arange(n + 2) < 2,
        gravity=[0, 0, -gravity], elements=(
            *edges(np.stack([i + 1, i + 2], 1), np.full(n, h), np.full(n, stiffness * n)),
            LinearSums(particles=np.stack([i, i + 1, i + 2], 1), stiffness=1.0 + (i == 0),
                 weight=np.tile([1, -2, 1], (n, 1)) / h**1.5)))


@pytest.mark.parametrize('load, reach, drop', [(1, .99125, .12347), (10, .65635, .70020),
                                               (100, .15922, .93752)])
def test_a_strip_bends_under_its_weight_as_the_elastica(load, reach, drop):
    """V9, second order in h with the hinge at the root twice as stiff."""
    errors = []
    for n in (20, 40):
        x = equilibrium(beam(n, load, 1e6 * load))[-1]
        errors.append(np.hypot(x[0] - reach, -x[2] - drop))
    assert errors[1] < 2e-3
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.15)


def test_an_elastica_under_a_load_at_its_tip():
    """V10: P L² / EI = 2."""
    n = 60
    problem = replace(beam(n, 1.0), mass=np.r_[np.full(n + 1, 1e-9), 2.0])
    x = equilibrium(problem)[-1]
    assert 1.0 - x[0] == pytest.approx(0.16064, abs=2e-4)
    assert -x[2] == pytest.approx(0.49346, abs=2e-4)


def test_an_unstable_equilibrium_is_refused():
    standing = chain([[0, 0, 0], [0, 0, 1 - G / 1000]], 1.0, 1000.0, [1, 1], [True, False])
    with pytest.raises(RuntimeError, match='is unstable'):
        equilibrium(standing)
    x = equilibrium(standing, x=[[0, 0, 0], [0.1, 0, 0.9]])
    np.testing.assert_allclose(x[1], [0, 0, -1 - G / 1000], atol=1e-9)


# Small vibrations: the Hessian against closed forms

def frequencies(problem, x):
    """Return all angular frequencies about an equilibrium, rising [rad/s]."""
    stiffness = Stiffness(problem)
    mass = np.repeat(problem.mass[stiffness.particles], 3)
    return np.sqrt(np.abs(eigh(stiffness.matrix(x).toarray(), np.diag(mass), eigvals_only=True)))


def test_a_hanging_chain_sways_as_bessel_says():
    """V21: ω = j01 / 2 √(g / L), second order in h."""
    errors = []
    for n in (10, 20):
        z = -np.linspace(0.0, 1.0, n + 1)
        problem = chain(np.stack([0 * z, 0 * z, z], 1), 1.0 / n, 1e7,
                        np.r_[np.ones(n), 0.5] / n, np.arange(n + 1) == 0)
        found = frequencies(problem, equilibrium(problem))
        assert found[0] == pytest.approx(found[1], rel=1e-6)
        errors.append(found[0] / np.sqrt(G) - 2.404825557695773 / 2.0)
    assert abs(errors[1]) < 1e-3
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.1)


def test_a_cantilever_vibrates_as_a_beam():
    """V22: ω = 3.516 √(B / (ρ L⁴)), second order in h."""
    errors = []
    for n in (10, 20):
        problem = beam(n, 0.0)
        errors.append(frequencies(problem, problem.x)[0] - 3.5160152685)
    assert abs(errors[1]) < 1e-2
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.1)


# How long a step may be

def test_the_highest_frequency_is_the_largest_eigenvalue():
    for seed in range(3):
        problem, x = tangle(seed)
        exact = frequencies(problem, x).max()
        assert highest_frequency(problem, x) == pytest.approx(exact, rel=1e-5)
        assert exact <= highest_frequency_bound(problem, x) < 2.5 * exact


def test_leapfrog_refuses_a_step_that_is_too_long_and_no_other(monkeypatch):
    """Just below 2 / ω the energy stays bounded; just above, it would not."""
    problem = problem_of(sheet(7, stretch=100.0))
    rng = np.random.default_rng(1)
    problem = replace(problem, gravity=np.zeros(3), x=problem.x * 1.01 + [0, -0.01, 0],
                      v=1e-6 * rng.standard_normal(problem.x.shape))
    longest = 2.0 / highest_frequency(problem)
    with pytest.raises(StepTooLongError, match='leapfrog needs less than'):
        explicit(problem, 1.001 * longest, 10)
    x, v = explicit(problem, 0.97 * longest, 3000)
    assert rms(v) < 1.0
    monkeypatch.setattr(leapfrog, '_check_stable', lambda *_: None)
    with pytest.raises(StepTooLongError, match='was unstable'):
        explicit(problem, 1.03 * longest, 3000)


def test_leapfrog_notices_that_its_step_became_too_long():
    """An edge that is squeezed stiffens across: here two, between pins that close in."""
    problem = Problem(x=[[-1, 0, 0], [0, 0, 0], [1, 0, 0]], mass=[1, 1, 1],
                      pinned=[True, False, True],
                      elements=edges([[0, 1], [1, 2]], [1, 1], [100, 100]),
                      motion=lambda t: [[-1 + 0.1 * t, 0, 0], [1 - 0.1 * t, 0, 0]])
    explicit(problem, 0.1, 66)    # up to there 200 (L / l - 1) dt² < 4
    with pytest.raises(StepTooLongError, match=r'after (6[7-9]|7\d) steps'):
        explicit(problem, 0.1, 90)


# Orders, and one method against the other

def slopes(method, problem, time, counts, exact):
    errors = [rms(advance(method, problem, time / n, n)[0] - exact) for n in counts]
    return np.log2(np.array(errors[:-1]) / errors[1:]) / np.log2(np.array(counts[1:])
                                                                 / counts[:-1])


@pytest.mark.parametrize('method, order, counts', [
    ('explicit', 2, (192, 384, 768)), ('bdf2', 2, (192, 384)),
    slow('backward_euler', 1, (192, 384))])
def test_orders_of_convergence(method, order, counts):
    """On a small cloth with all effects, whose one pin is carried about."""
    problem = problem_of(sheet(5, stretch=100.0, shear=10.0, bend=0.01, damping=1.0,
                               motion=SWAY))
    exact = limit(problem, 0.2, 1e-10)
    assert exact.uncertainty < 1e-9
    assert exact.error(problem.x) > 0.05
    found = slopes(method, problem, 0.2, counts, exact.x)
    np.testing.assert_allclose(found, order, atol=0.15)


def test_one_backward_step_keeps_bdf2_second_order():
    """The oscillator, begun in full swing."""
    problem = replace(oscillator(), v=[[0, 0, 0], [10.0, 0, 0]])
    t = 0.1
    z = (0.5 - 10j / OMEGA) * np.exp(1j * OMEGA * t)
    exact = np.array([[0, 0, 0], [1.0 + z.real, 0, 0]])
    np.testing.assert_allclose(slopes('bdf2', problem, t, (64, 128, 256), exact), 2.0, atol=0.15)


def test_the_uncertainty_of_a_slow_series_bounds_its_rest():
    """With changes that shrink by r each time, r / (1 - r) times the last is still to come."""
    for r in (0.01, 0.1, 0.3, 0.6, 0.85):
        assert richardson._uncertainty(1.0, r, 4) >= (1.0 - 1e-12) * r * r / (1.0 - r)
    assert richardson._uncertainty(1.0, 0.0, 4) == 1.0 / 16.0    # a change that is 0 by accident


@pytest.mark.slow
def test_both_methods_agree_within_their_uncertainties():
    problem = problem_of(sheet(7, stretch=200.0))
    a = limit(problem, 0.3, 1e-9)
    b = limit(problem, 0.3, 1e-5, method='bdf2', dt=1.0 / 240.0)
    assert a.uncertainty < 1e-9
    assert a.error(b.x) <= a.uncertainty + b.uncertainty < 1.1e-5
    assert rms(a.v - b.v) <= a.uncertainty_v + b.uncertainty_v
    rougher = limit(problem, 0.3, 1.0)
    assert len(rougher.ladder) == 4
    assert a.error(rougher.x) <= rougher.uncertainty


@pytest.mark.slow
@pytest.mark.parametrize('shear, levels, worst', [(5.0, 5, 1e-4), (2500.0, 6, 3e-3)])
def test_both_methods_agree_on_the_swing(shear, levels, worst):
    """21 x 21 particles, 0.5 s: the scene that accuracy is measured on."""
    problem = problem_of(sheet(21, shear=shear))
    a = limit(problem, 0.5, 2e-8)
    b = limit(problem, 0.5, 1e-5, method='bdf2', dt=1.0 / 480.0, levels=levels)
    assert a.uncertainty <= 2e-8
    assert a.error(b.x) <= a.uncertainty + b.uncertainty <= worst


@pytest.mark.slow
def test_the_leapfrog_limit_is_within_its_uncertainty():
    """Few rungs against many."""
    problem = problem_of(sheet(21))
    best = limit(problem, 0.5, 1e-11)
    assert best.uncertainty < 1e-11
    for tolerance in (1e-6, 1e-9):
        found = limit(problem, 0.5, tolerance)
        assert best.error(found.x) <= found.uncertainty <= tolerance


@pytest.mark.parametrize('method, integrator, order, worst', [
    pytest.param('gauss_seidel', 'backward_euler', 1, 2e-4, marks=pytest.mark.slow),
    slow('line', 'bdf2', 2, 1e-6), ('line', 'ndf2', 2, 1e-6)])
def test_the_simulation_converges_to_the_reference(method, integrator, order, worst):
    """At the order of its integrator, and with no floor in sight."""
    errors, exact = [], None
    for substeps in (64, 128, 256):
        simulation = sheet(5, stretch=50.0, shear=10.0, bend=0.003, damping=1.0, motion=SWAY,
                           solver={'method': method, 'integrator': integrator,
                                   'substeps': substeps})
        exact = exact or limit(problem_of(simulation), 12 * simulation.frame_dt, 1e-8)
        for _ in range(12):
            frame = simulation.step()
        errors.append(exact.error(frame.x))
    assert errors[-1] < worst
    found = np.log2(np.array(errors[:-1]) / errors[1:])
    np.testing.assert_allclose(found, order, atol=0.1)


# The folder of what was computed before

def test_what_is_in_the_cache_is_not_computed_again(tmp_path, monkeypatch):
    problem = problem_of(sheet(3, stretch=50.0, motion=SWAY))
    first = limit(problem, 0.1, 1e-6, cache=tmp_path / 'cache')
    monkeypatch.setattr(richardson, '_run', None)
    again = limit(problem, 0.1, 1e-6, cache=tmp_path / 'cache')
    np.testing.assert_array_equal(again.x, first.x)
    np.testing.assert_array_equal(again.v, first.v)
    assert (again.uncertainty, again.ladder) == (first.uncertainty, first.ladder)
    for changed in (replace(problem, damping=0.1), replace(problem, x=problem.x + 1e-15),
                    replace(problem, motion=lambda t: problem.motion(t) + [0, 0, 1e-12])):
        with pytest.raises(TypeError):    # it would have to be computed
            limit(changed, 0.1, 1e-6, cache=tmp_path / 'cache')


def test_more_accuracy_goes_on_from_what_is_in_the_cache(tmp_path, monkeypatch):
    problem = problem_of(sheet(3, stretch=50.0))
    few = limit(problem, 0.1, 1.0, cache=tmp_path)
    run, taken = richardson._run, []
    monkeypatch.setattr(richardson, '_run',
                        lambda p, m, dt, n: taken.append(n) or run(p, m, dt, n))
    more = limit(problem, 0.1, few.uncertainty / 30.0, cache=tmp_path)
    assert more.uncertainty < few.uncertainty / 30.0
    assert more.ladder[0][0] == few.ladder[0][0]
    assert len(taken) == len(more.ladder) - 4 > 0


def test_a_broken_file_in_the_cache_is_written_anew(tmp_path):
    problem = oscillator()
    first = limit(problem, 0.1, 1e-3, cache=tmp_path)
    (file,) = tmp_path.iterdir()
    content = file.read_bytes()
    for broken in (b'', content[:100], b'not a zip'):
        file.write_bytes(broken)
        again = limit(problem, 0.1, 1e-3, cache=tmp_path)
        np.testing.assert_array_equal(again.x, first.x)
        assert len(file.read_bytes()) == len(content)


def test_a_time_between_kinks_of_the_motion_is_refused():
    problem = problem_of(sheet(3, motion=SWAY))
    with pytest.raises(ValueError, match='must be a multiple of 0.0166667 s'):
        limit(problem, 0.11, 1e-3)


def test_an_effect_without_an_energy_is_refused():
    """Also one that the reference solver does not know and that has no constraints."""
    simulation = sheet(3)
    simulation.effects['zone'] = Built()
    with pytest.raises(InputError, match='effects.zone: the reference solver does not have it'):
        problem_of(simulation)
