"""
XPBD constraints of cloth: projection, distance constraints on grids and meshes, line solves,
bending, and the impulses on pinned particles.

Effects build their constraints from these. It imports ``backend``, ``particles`` and ``geometry``.
"""
