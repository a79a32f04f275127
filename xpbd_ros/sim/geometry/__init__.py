"""
Geometry in NumPy and small kernels: triangle meshes and their repair, geodesic distances,
quaternions, closest points.

It imports ``backend``, and ``Pose`` from the module of commands.
"""
