"""
Particle state: arrays by slot, their memory layout, time integration and its multistep history.

It imports ``backend`` only; constraints and effects build on it.
"""
