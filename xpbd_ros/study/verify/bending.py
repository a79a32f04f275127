"""Bending: curved patches, cantilevers, and the first mode of a strip."""

from functools import cache
from tempfile import NamedTemporaryFile

import numpy as np
from scipy import sparse
from scipy.integrate import solve_bvp, trapezoid
from scipy.sparse.linalg import spsolve
from scipy.spatial import Delaunay

from xpbd_ros.study.numbering import natural_indices
from xpbd_ros.study.verify.build import build, crossing, G, hold, place, run
from xpbd_ros.study.verify.case import case, order, value

DENSITY = 0.2


@case('V12', 'bending patch')
def patch():
    """A sheet bent onto a cylinder about any axis has an energy of B κ² / 2 per area."""
    B, curvature, h = 2e-3, 0.2, 0.05
    simulation = build((12, 12), (11 * h, 11 * h), {'bend': {'stiffness': B}}, method='auto')
    x, bends = simulation.frame().x, simulation.effects['bend'].constraints
    there = x[natural_indices(simulation)[bends.particles], :2]
    inside = ((there > 0.5 * h) & (there < 10.5 * h)).all((1, 2))    # full width
    curved = bends.weight[:, 0] == 0.0    # constraints of three particles
    for degrees in (0.0, 22.5, 45.0, 90.0, 135.0):
        a = np.radians(degrees)
        along = x[:, 0] * np.cos(a) + x[:, 1] * np.sin(a)
        across = x[:, 1] * np.cos(a) - x[:, 0] * np.sin(a)
        arc = np.stack([np.sin(curvature * along), curvature * across,
                        1.0 - np.cos(curvature * along)], 1) / curvature
        place(simulation, arc)
        energy = 0.5 * (bends.residual(simulation.state.x)**2).sum(1) / bends.compliance
        each = 2.0 * energy[inside & curved].mean() + energy[~curved].mean()
        yield value(f'energy per area, rolled at {degrees:g}°', 0.5 * B * curvature**2,
                    each / (h * h), 'J/m²', 1e-3)


def irregular(n: int, h: float, degrees: float) -> tuple[np.ndarray, np.ndarray]:
    """
    Return an irregular triangulation: vertices [m] and triangles.

    The n × n vertices are those of a triangular lattice of edge h [m], displaced at random by up
    to h / 4 and rotated by an angle [degrees].
    """
    row, column = (k.ravel() for k in np.mgrid[:n, :n])
    points = h * np.stack([column + 0.5 * (row % 2), row * 0.75**0.5], 1)
    inner = (np.minimum(row, column) > 0) & (np.maximum(row, column) < n - 1)
    points[inner] += np.random.default_rng(3).uniform(-0.25 * h, 0.25 * h, (inner.sum(), 2))
    triangles = Delaunay(points).simplices
    sides = points[triangles] - points[triangles][:, [1, 2, 0]]
    area = 0.5 * np.abs(sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0])
    a = np.radians(degrees)
    turned = points @ np.array([[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]])
    return (np.pad(turned, ((0, 0), (0, 1))),
            triangles[area > 0.1 * np.square(sides).sum(2).max(1)])


@case('V12', 'bending patch')
def patch_of_a_mesh():
    """
    A mesh bent onto a cylinder has an energy of (√B1 c² + √B2 s²)² κ² / 2 per area.

    Particles at the border and next to it are held on the cylinder; the others are in equilibrium.
    """
    h, n = 0.05, 13
    for degrees, (warp, weft) in ((0.0, (2e-3, 2e-3)), (25.0, (2e-3, 2e-3)),
                                  (25.0, (1e-3, 8e-3))):
        vertices, triangles = irregular(n, h, degrees)
        with NamedTemporaryFile('w', suffix='.obj') as file:
            file.writelines([*('v {} {} {}\n'.format(*x) for x in vertices),
                             *('f {} {} {}\n'.format(*t) for t in triangles + 1)])
            file.flush()
            simulation = build(mesh=file.name, effects={'bend': {'warp': warp, 'weft': weft}},
                               method='auto')
        bends, x = simulation.effects['bend'].constraints, simulation.frame().x
        particles = natural_indices(simulation)[bends.particles]
        fold = sparse.csr_matrix((bends.weight.ravel(), (
            np.repeat(np.arange(len(particles)), 4), particles.ravel())))
        stiffness = (fold.T @ sparse.diags(1.0 / bends.compliance) @ fold).tocsc()
        free = np.ones(len(x), bool)
        sides, often = np.unique(np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2),
                                         1), axis=0, return_counts=True)
        free[sides[often == 1]] = False
        free[sides[~free[sides].all(1)]] = False
        inside, corners = free[particles].any(1), x[particles]
        area = sum(np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0],
                                           corners[:, k] - corners[:, 0]), axis=1)
                   for k in (2, 3))[inside].sum() / 6.0    # each triangle has three hinges
        for roll in (0.0, 22.5, 45.0, 90.0, 135.0):
            c, s = np.cos(np.radians(roll)), np.sin(np.radians(roll))
            z = 0.5 * (c * x[:, 0] + s * x[:, 1])**2
            z[free] = spsolve(stiffness[free][:, free], -stiffness[free][:, ~free] @ z[~free])
            got = (0.5 * (fold @ z)**2 / bends.compliance)[inside].sum() / area
            yield value(f'energy per area of a mesh turned by {degrees:g}°, B {1e3 * warp:g} and '
                        f'{1e3 * weft:g} mN m, rolled at {roll:g}°',
                        0.5 * (np.sqrt(warp) * c * c + np.sqrt(weft) * s * s)**2, got, 'J/m²',
                        2e-3)


@cache
def droop(gamma: float) -> tuple[float, float]:
    """Return x / L and drop / L of a heavy elastica clamped level: θ'' = -Γ (1 - s) cos θ."""
    s = np.linspace(0.0, 1.0, 101)
    guess = np.zeros((2, 101))
    for g in np.linspace(0.0, gamma, 12)[1:]:
        found = solve_bvp(lambda s, y, g=g: np.stack([y[1], -g * (1 - s) * np.cos(y[0])]),
                          lambda a, b: np.array([a[0], b[1]]), s, guess, tol=1e-9,
                          max_nodes=20000)
        guess = found.sol(s)
    fine = np.linspace(0.0, 1.0, 20001)
    theta = found.sol(fine)[0]
    return float(trapezoid(np.cos(theta), fine)), float(trapezoid(np.sin(theta), fine))


def clamped(n: int, length: float, B: float, **options):
    """
    Return a strip of n free edges that is clamped in the middle of an edge, and its edge [m].

    The clamp is between two pinned particles, so the first hinge stands for a whole edge as all
    others do. The length counts from there.
    """
    h = length / (n + 0.5)
    return build((n + 2, 2), ((n + 1) * h, h), {
        'bend': {'stiffness': B}, 'stretch': {'warp': 2e4, 'weft': 2e4}}, density=DENSITY,
        pins=hold(a='edge_x0', b=[1, n + 3]), method='line', integrator='bdf2', **options), h


def hangs(n: int, gamma: float, length: float = 0.3) -> np.ndarray:
    """Return x / L and drop / L of the tip at rest."""
    # bending converges by sweeps, not by line solves: finer strips need more iterations
    strip, h = clamped(n, length, DENSITY * G * length**3 / gamma, substeps=160,
                       iterations=n // 2,
                       effects_={'damping': {'rate': 15.0}})
    return settled(strip, n, h, length)


def settled(strip, n: int, h: float, length: float) -> np.ndarray:
    """Return x / L and drop / L of the tip of a strip at rest."""
    for _ in range(40):
        frame = run(strip, 15)
        if np.abs(frame.v).max() < 1e-9:
            break
    tip = frame.x[[n + 1, -1]].mean(0)
    return np.array([tip[0] - 0.5 * h, -tip[2]]) / length


@case('V9', 'cantilever under its own weight', slow=True)
def cantilever():
    """The tip is that of the elastica with Γ = q L³ / B, a boundary value problem."""
    for gamma in (1.0, 5.0, 20.0):
        across, down = droop(gamma)
        sizes = (12, 24, 48)
        got = np.array([hangs(n, gamma) for n in sizes])
        steps = [1.0 / (n + 0.5) for n in sizes]
        yield order(f'drop / L, Γ = {gamma:g}', down, steps, got[:, 1], '', 2.0, 5e-3,
                    step='edge / L')
        yield value(f'x / L, Γ = {gamma:g}', across, got[-1, 0], '', 1e-2)


@cache
def bowed(gamma: float) -> tuple[float, float]:
    """Return x / L and drop / L of an elastica with a load at its tip: θ'' = -Γ cos θ."""
    s = np.linspace(0.0, 1.0, 101)
    found = solve_bvp(lambda s, y: np.stack([y[1], -gamma * np.cos(y[0])]),
                      lambda a, b: np.array([a[0], b[1]]), s,
                      np.stack([0.5 * s, 0.5 + 0.0 * s]), tol=1e-9, max_nodes=20000)
    fine = np.linspace(0.0, 1.0, 20001)
    theta = found.sol(fine)[0]
    return float(trapezoid(np.cos(theta), fine)), float(trapezoid(np.sin(theta), fine))


@case('V10', 'elastica with a load at its tip', slow=True)
def tip_load():
    """The tip is that of the weightless elastica with Γ = P L² / B, a boundary value problem."""
    B, length = 0.005, 0.3
    for gamma in (1.0, 5.0):
        across, down = bowed(gamma)
        sizes, got = (8, 16, 32), []
        for n in sizes:
            load = gamma * B / (length * (n + 0.5))    # for a width of one edge
            strip, h = clamped(n, length, B, gravity=(0, 0, 0), substeps=160, iterations=n // 2,
                               effects_={'damping': {'rate': 15.0}, 'force': {
                                   'cloth': 'c', 'at': [n + 1, 2 * n + 3],
                                   'total': [0.0, 0.0, -load]}})
            got.append(settled(strip, n, h, length))
        steps, got = [1.0 / (n + 0.5) for n in sizes], np.array(got)
        yield order(f'drop / L, Γ = {gamma:g}', down, steps, got[:, 1], '', 2.0, 5e-3,
                    step='edge / L')
        yield value(f'x / L, Γ = {gamma:g}', across, got[-1, 0], '', 1e-2)


@case('V11', 'textile cantilever (ASTM D1388, Peirce)')
def textile():
    """At a chord of 41.5° the bending length (B / q)^⅓ is half of the overhang."""
    low, high = 2.0, 20.0
    for _ in range(50):
        middle = 0.5 * (low + high)
        across, down = droop(middle)
        low, high = (middle, high) if np.degrees(np.arctan2(down, across)) < 41.5 else (low,
                                                                                        middle)
    yield value('(B / q)^⅓ / l at 41.5°', 0.49991, middle**(-1 / 3), '', 1e-4)
    across, down = hangs(24, middle)
    yield value('chord', 41.5, np.degrees(np.arctan2(down, across)), '°', 1e-2)


@case('V22', 'first mode of a cantilever strip')
def mode():
    """Without gravity ω = 3.516 √(B / ρ L⁴), from a quarter period of the projection on it."""
    B, length, rate = 1e-3, 0.3, 120.0
    k = 1.875104068711961
    expected = k * k * np.sqrt(B / DENSITY) / length**2
    sigma = (np.sinh(k) - np.sin(k)) / (np.cosh(k) + np.cos(k))

    def frequency(n):
        strip, h = clamped(n, length, B, substeps=64, gravity=(0, 0, 0), rate=rate)
        x = strip.frame().x
        s = np.clip((x[:, 0] - 0.5 * h) / length, 0.0, 1.0) * k
        shape = np.cosh(s) - np.cos(s) - sigma * (np.sinh(s) - np.sin(s))
        shape[x[:, 0] < 1.5 * h] = 0.0    # the clamp
        place(strip, x + np.outer(shape, [0, 0, 1e-4]))
        share = [1.0]
        while share[-3:][0] > 0.0:    # until two frames after the crossing
            share.append(run(strip, 1).x[:, 2] @ shape / (shape @ shape * 1e-4))
        return 0.5 * np.pi / crossing(np.arange(len(share)) / rate, share)

    sizes = (6, 12, 24)
    yield order('ω', expected, [length / (n + 0.5) for n in sizes], [frequency(n) for n in sizes],
                'rad/s', 2.0, 1e-2, step='edge [m]')
