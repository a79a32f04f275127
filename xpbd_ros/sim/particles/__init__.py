"""
Particle state: arrays by slot, their memory layout, time integration and its multistep history.

It imports ``backend``. It knows neither constraints nor effects.
"""
