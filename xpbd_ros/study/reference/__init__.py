"""
A reference solver: the exact motion of a scene's particles, with an uncertainty.

It has two methods, which share no code with the simulation and compute forces independently of
each other:

``newton``    backward Euler or BDF2; each step minimises its energy by Newton's method with a
              sparse factorisation (doc/numerics.md 11), without multipliers or sweeps.
``explicit``  leapfrog with exact damping in the kicks. Its error has even powers of dt only.

``limit`` extrapolates either to dt → 0. ``problem_of`` converts a compiled simulation.

Limits: only effects with an energy (``conversion``), so no contact and no friction; no rigid edges
(compliance 0). Very stiff scenes need ``newton`` or ``equilibrium``, as leapfrog would take too
many steps. Hinges must fold by less than half a turn from rest.
"""

from xpbd_ros.study.reference.conversion import problem_of
from xpbd_ros.study.reference.elements import (
    Areas,
    Edges,
    Elements,
    Gas,
    Hinges,
    LinearSums,
    Membranes,
    Slants,
    Tetrahedra,
)
from xpbd_ros.study.reference.leapfrog import explicit, highest_frequency, StepTooLongError
from xpbd_ros.study.reference.newton import equilibrium, newton
from xpbd_ros.study.reference.problem import (
    elastic,
    gradient,
    highest_frequency_bound,
    kinetic,
    potential,
    Problem,
    rms,
)
from xpbd_ros.study.reference.richardson import limit, Reference
from xpbd_ros.study.reference.stiffness import Stiffness

__all__ = ['Areas', 'Edges', 'elastic', 'Elements', 'equilibrium', 'explicit', 'Gas', 'gradient',
           'highest_frequency', 'highest_frequency_bound', 'Hinges', 'kinetic', 'limit',
           'Membranes', 'newton', 'potential', 'Problem', 'problem_of', 'Reference', 'rms',
           'Slants', 'StepTooLongError', 'Stiffness', 'LinearSums', 'Tetrahedra']
