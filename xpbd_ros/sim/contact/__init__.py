"""
Contact of particles with colliders: shapes and signed distances, broad phase, continuous
detection, projection, restitution.

It imports ``backend``, ``particles``, ``geometry``, and the modules of commands and target motion.
"""
