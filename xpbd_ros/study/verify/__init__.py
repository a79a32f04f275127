"""
Cases with known answers: what is expected, what we get, and at which order it converges.

A family is a file of this package; a case is a function in it, marked with ``@case(id, title)``,
that yields rows. It is listed, tested, tabulated and drawn because it is there.
"""

import importlib

from xpbd_ros.study.verify.case import Case, CASES, Row

FAMILIES = ('motion', 'elastic', 'bending', 'friction', 'waves', 'bodies', 'energies', 'laws')


def all_cases() -> dict[str, list[Case]]:
    """Import every family and return its cases."""
    for family in FAMILIES:
        importlib.import_module(f'xpbd_ros.study.verify.{family}')
    return {family: [one for one in CASES if one.family == family] for family in FAMILIES}


__all__ = ['all_cases', 'Case', 'CASES', 'FAMILIES', 'Row']
