"""
Hard cases: what breaks solvers, as data; each is run as it is and by a textbook solver beside it.

A family is a file of this package; a case is a function in it, marked with ``@hard(id, title)``,
that yields attempts: runs (``trial``) and refusals (``door``). It is listed, tested, tabulated and
drawn because it is there. Cases that need a node are in ``xpbd_ros.node_stress``.
"""

import importlib

from xpbd_ros.study.stress.case import HARD, Hard, Outcome

FAMILIES = ('masses', 'geometry', 'contact', 'commands', 'parameters', 'precision')


def all_hard() -> list[Hard]:
    """Import every family and return its cases, in the order of their numbers."""
    for family in FAMILIES:
        importlib.import_module(f'xpbd_ros.study.stress.{family}')
    return sorted(HARD, key=lambda one: int(one.id[1:]))


__all__ = ['all_hard', 'FAMILIES', 'Hard', 'Outcome']
