"""
Cases with known solutions: expected and computed values, and orders of convergence.

A family is a module of this package. A case is a function in it, registered with
``@case(id, title)``, that yields rows. All registered cases are listed, tested, tabulated and
drawn.
"""

import importlib

from xpbd_ros.study.verify.case import Case, CASES, Row

FAMILIES = ('motion', 'elastic', 'bending', 'friction', 'waves', 'bodies', 'energies', 'laws')


def all_cases() -> dict[str, list[Case]]:
    """Import all families and return their cases, by family."""
    for family in FAMILIES:
        importlib.import_module(f'xpbd_ros.study.verify.{family}')
    return {family: [one for one in CASES if one.family == family] for family in FAMILIES}


__all__ = ['all_cases', 'Case', 'CASES', 'FAMILIES', 'Row']
