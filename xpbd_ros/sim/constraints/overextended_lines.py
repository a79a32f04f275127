"""
Overextended lines: rigid lines between two pins that are further apart than the line is long.

Their constraints have no solution. Gauss-Seidel passes do not converge, and a line solve with tiny
compliance is unstable perpendicular to the line once |f| > l / (m_k + m_{k+1}). In the limit α → 0
the excess is distributed evenly over equal edges, and the infinite tension keeps the particles on
the straight line between the pins,

    x_k = x_a + k / n (x_b - x_a).

They are placed there before a substep's constraints are projected, with zero mobility during the
projections. The pins, at the distance l, receive the tension of a line of compliance TINY
(``constraints.line_solver``), f = -(l - n L) / (2 TINY Σ m_k).
"""

from typing import NamedTuple

import numpy as np

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.particles.memory_layout import Block


class Taut(NamedTuple):
    """List of the lines with two or more pinned particles."""

    count: np.ndarray
    """length of the list, shape (1,)"""
    line: np.ndarray
    """grid; 0 for warp or 1 for weft; row or column; shape (capacity, 3)"""


def room_for(blocks: list[Block]) -> Taut:
    """Return an empty list for all lines of some grids."""
    return Taut(np.zeros(1, np.int64),
                np.zeros((sum(b.rows + b.columns for b in blocks), 3), np.int64))


def hold(taut: Taut, blocks: list[Block], inv_mass: np.ndarray) -> None:
    """Update the list: lines with two pinned particles that are not neighbours."""
    found = []
    for g, block in enumerate(blocks):
        pinned = inv_mass[block.slots] == 0.0
        for along, lines in enumerate((pinned, pinned.T)):
            for number in np.flatnonzero(lines.sum(1) > 1):
                if (np.diff(np.flatnonzero(lines[number])) > 1).any():
                    found.append((g, along, number))
    taut.count[0] = len(found)
    taut.line[:len(found)] = np.array(found, np.int64).reshape(-1, 3)


@jit
def straighten(taut, lines, force, state):
    """Place the particles of overextended lines on the straight line between their pins."""
    if taut is not None:
        for k in range(taut.count[0]):
            _straighten(lines, force, state, taut.line[k, 0], taut.line[k, 1], taut.line[k, 2])


@jit
def _straighten(lines, force, state, g, along, number):
    x, last = state.x, -1
    for k in range(lines.rows[g] if along else lines.columns[g]):
        b = _slot(lines, g, along, number, k)
        if state.inv_mass[b] > 0.0:
            continue
        n, long = k - last, (k - last) * lines.rest_length[g, along]
        if last >= 0 and n > 1:
            a = _slot(lines, g, along, number, last)
            dx, dy, dz = x[0, b] - x[0, a], x[1, b] - x[1, a], x[2, b] - x[2, a]
            far, total = np.sqrt(dx * dx + dy * dy + dz * dz), 0.0
            for i in range(last + 1, k):
                total += 2.0 * state.mobility[_slot(lines, g, along, number, i)]
            if (far > (1.0 + lines.tiny) * long
                    and n * _compliance(lines, g, along, number) < lines.tiny * total):
                force[lines.force[g, along] + a] = (long - far) / (lines.tiny * total)
                for i in range(1, n):
                    c, part = _slot(lines, g, along, number, last + i), i / n
                    x[0, c] = x[0, a] + part * dx
                    x[1, c] = x[1, a] + part * dy
                    x[2, c] = x[2, a] + part * dz
                    state.mobility[c] = 0.0
                    force[lines.force[g, along] + c] = (long - far) / (lines.tiny * total)
        last = k


@jit
def _slot(lines, g, along, number, k):
    row, column = (k, number) if along else (number, k)
    return (lines.first[g] + row * lines.stride[g] + column % lines.parts[g] * lines.part[g]
            + column // lines.parts[g])


@jit
def _compliance(lines, g, along, number):
    if along:
        return lines.weft[g, _slot(lines, g, along, number, 0) - lines.first[g]]
    return lines.warp[g, number]
