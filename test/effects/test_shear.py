"""Shear: what a sheared sheet pulls with."""

import pytest

from support.scenes import run, simulate
from xpbd_ros.sim.commands import MovePin, Pose


def test_a_sheared_sheet_pulls_with_its_modulus():
    """F = G γ w, for a row of oblong cells that two pins hold by their whole length."""
    modulus, angle = 30.0, 1e-4
    simulation = simulate((6, 2), (0.5, 0.2), effects={'shear': {'stiffness': modulus}},
                          gravity=(0, 0, 0), pins={
                              'low': {'cloth': 'c', 'at': 'edge_0x'},
                              'high': {'cloth': 'c', 'at': 'edge_1x'}})
    assert simulation.step().pins['high'].force == pytest.approx([0.0, 0.0, 0.0], abs=1e-9)
    frame = run(simulation, 5, [MovePin('high', Pose((0.25 + 0.2 * angle, 0.2, 0.0)))])
    force = modulus * angle * 0.5
    assert frame.pins['high'].force[0] == pytest.approx(-force, rel=1e-3)
    assert frame.pins['low'].force[0] == pytest.approx(force, rel=1e-3)
