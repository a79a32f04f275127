"""Bending: patches, strips that droop, a strip that swings."""

from functools import cache

import numpy as np
from scipy.integrate import solve_bvp, trapezoid

from xpbd_ros.study.cases.build import build, crossing, G, hold, place, run
from xpbd_ros.study.cases.case import case, order, value

DENSITY = 0.2


@case('V12', 'bending patch')
def patch():
    """Rolled onto a cylinder about any axis, a sheet stores B κ² / 2 per area."""
    B, curvature, h = 2e-3, 0.2, 0.05
    simulation = build((12, 12), (11 * h, 11 * h), {'bend': {'stiffness': B}})
    x, bends = simulation.frame().x, simulation.effects['bend'].constraints
    number = np.full(simulation.state.x.shape[1], -1)
    number[simulation.slot] = np.arange(len(x))
    there = x[number[bends.particles], :2]
    inside = ((there > 0.5 * h) & (there < 10.5 * h)).all((1, 2))    # not half as wide
    curved = bends.weight[:, 0] == 0.0    # three particles
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
    Return a strip of n free edges whose root is clamped in the middle of an edge.

    Between two pinned particles; so the first hinge stands for a whole edge like all others, and
    the length counts from there.
    """
    h = length / (n + 0.5)
    return build((n + 2, 2), ((n + 1) * h, h), {
        'bend': {'stiffness': B}, 'stretch': {'warp': 2e4, 'weft': 2e4}}, density=DENSITY,
        pins=hold(a='edge_x0', b=[1, n + 3]), method='line', integrator='bdf2', **options), h


def hangs(n: int, gamma: float, length: float = 0.3) -> np.ndarray:
    """Return x / L and drop / L of the tip at rest."""
    # bending is swept, not solved by lines: it takes more the finer the strip
    strip, h = clamped(n, length, DENSITY * G * length**3 / gamma, substeps=160,
                       iterations=n // 2,
                       effects_={'damping': {'rate': 15.0}})
    return settled(strip, n, h, length)


def settled(strip, n: int, h: float, length: float) -> np.ndarray:
    """Return x / L and drop / L of a strip's tip when nothing moves any more."""
    for _ in range(40):
        frame = run(strip, 15)
        if np.abs(frame.v).max() < 1e-9:
            break
    tip = frame.x[[n + 1, -1]].mean(0)
    return np.array([tip[0] - 0.5 * h, -tip[2]]) / length


@case('V9', 'cantilever under its own weight', slow=True)
def cantilever():
    """Γ = q L³ / B; the answer is a boundary value problem of the elastica, solved apart."""
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
    """Γ = P L² / B, without weight; the answer is again a boundary value problem."""
    B, length = 0.005, 0.3
    for gamma in (1.0, 5.0):
        across, down = bowed(gamma)
        sizes, got = (8, 16, 32), []
        for n in sizes:
            load = gamma * B / (length * (n + 0.5))    # of a strip as wide as an edge
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
    """At a chord of 41.5° the bending length (B / q)^⅓ is half of what overhangs."""
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
    """ω = 3.516 √(B / ρ L⁴), without gravity: a quarter period of the strip's share in it."""
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
        while share[-3:][0] > 0.0:    # until two frames after it is crossed
            share.append(run(strip, 1).x[:, 2] @ shape / (shape @ shape * 1e-4))
        return 0.5 * np.pi / crossing(np.arange(len(share)) / rate, share)

    sizes = (6, 12, 24)
    yield order('ω', expected, [length / (n + 0.5) for n in sizes], [frequency(n) for n in sizes],
                'rad/s', 2.0, 1e-2, step='edge [m]')
