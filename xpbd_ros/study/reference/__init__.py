"""
An independent reference: where the particles really are at a time, and how well that is known.

Two methods that share no code with the simulation, nor the right-hand side with each other:

``newton``    backward Euler or BDF2; each step minimises its energy by Newton's method with an
              exact sparse factorisation (doc/numerics.md 11). No multipliers, no sweeps.
``explicit``  leapfrog, damping exact in the kicks. Its error has even powers of dt only.

``limit`` takes either to dt → 0. ``problem_of`` says what a compiled simulation should compute.

Limits: effects with an energy only (``reading``): no contact, no friction, no rigid edges (a
compliance of 0). Only ``equilibrium`` and ``newton`` can take what is so stiff that leapfrog would
need more steps than anyone waits for. Hinges fold by less than half a turn from rest.
"""

from xpbd_ros.study.reference.elements import (
    Areas,
    Edges,
    Elements,
    Gas,
    Hinges,
    Membranes,
    Slants,
    Sums,
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
from xpbd_ros.study.reference.reading import problem_of
from xpbd_ros.study.reference.richardson import limit, Reference
from xpbd_ros.study.reference.stiffness import Stiffness

__all__ = ['Areas', 'Edges', 'elastic', 'Elements', 'equilibrium', 'explicit', 'Gas', 'gradient',
           'highest_frequency', 'highest_frequency_bound', 'Hinges', 'kinetic', 'limit',
           'Membranes', 'newton', 'potential', 'Problem', 'problem_of', 'Reference', 'rms',
           'Slants', 'StepTooLongError', 'Stiffness', 'Sums', 'Tetrahedra']
