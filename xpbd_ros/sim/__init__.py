"""
The simulation: NumPy and Numba alone, without ROS, files or the wall clock.

Subpackages, each importing only from those before it: ``backend``, ``particles``, ``geometry``,
``constraints``, ``contact``, ``self_collision``, ``stepping``. Any of them may import ``commands``
and ``parameters``. Built on them: ``effect`` (the interface of effects), ``target_stream`` and
``target_motion`` (motion of pins and colliders), ``pin_states``, ``measure`` (momentum, energy,
strain) and ``simulation``.
"""
