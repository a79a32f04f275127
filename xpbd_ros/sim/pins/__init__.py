"""
Pins: their scene keys, the active pins and their states, and the wrenches of the cloth on them.

The effect ``pin`` puts these together. Imports the rooms below: ``backend``, ``particles``,
``geometry`` and the motion of targets.
"""
