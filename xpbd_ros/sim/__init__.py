"""
The simulation: numbers only, NumPy and Numba. It knows no ROS, no files and no clock.

From the bottom up, each room importing only from those before it: ``backend``, ``particles``,
``geometry``, ``constraints``, ``contact``, ``self_collision``, ``stepping``. Beside them stand
``commands`` and ``parameters``, which anything may import, and on top ``effect`` (what an effect
is), ``measure`` (momentum, energy, strain) and ``simulation``.
"""
