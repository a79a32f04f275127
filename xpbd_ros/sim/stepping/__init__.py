"""
The step: the substep loop, the stages that effects take part in, solver methods, roll-back of
implausible frames, the guard of the explicit method, and the error estimate.

It names no effect. It imports ``backend``, ``particles`` and ``constraints``.
"""
