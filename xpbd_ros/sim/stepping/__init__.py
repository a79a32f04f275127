"""
The step: the substep loop, the stages that effects take part in, solver methods, roll-back of
implausible frames, the guard of the explicit method, the error estimate, and frames on a GPU.

It names no effect. It imports ``backend``, ``particles`` and ``constraints``.
"""
