"""
The simulation: NumPy and Numba alone, without ROS, files or the wall clock.

Subpackages, each importing only from those before it: ``backend``, ``particles``, ``geometry``,
``constraints``, ``contact``, ``self_collision``, ``stepping``, ``pins``. Any of them may import
``commands`` and ``parameters``. Beside them: ``effect`` (the interface of effects),
``target_stream`` and ``target_motion`` (motion of pins and colliders), ``measure`` (momentum,
energy, strain) and ``simulation``.
"""
