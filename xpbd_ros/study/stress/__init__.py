"""
Cases that break solvers, run by the simulation and by a textbook solver for comparison.

A family is a module of this package. A case is a function in it, registered with
``@hard(id, title)``, that yields attempts: runs (``trial``) and refused scenes (``refusals``). All
registered cases are listed, tested, tabulated and drawn. Cases that need a node are in
``xpbd_ros.node_stress``.
"""

import importlib

from xpbd_ros.study.stress.case import CASES, HardCase, Outcome

FAMILIES = ('masses', 'geometry', 'contact', 'commands', 'parameters', 'precision')


def all_hard() -> list[HardCase]:
    """Import all families and return their cases, ordered by number."""
    for family in FAMILIES:
        importlib.import_module(f'xpbd_ros.study.stress.{family}')
    return sorted(CASES, key=lambda one: int(one.id[1:]))


__all__ = ['all_hard', 'FAMILIES', 'HardCase', 'Outcome']
