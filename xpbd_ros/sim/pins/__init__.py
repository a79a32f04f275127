"""
Pins: their scene keys, the active pins and their states, and the wrenches of the cloth on them.

The effect ``pin`` puts these together. It imports ``backend``, ``particles``, ``geometry``,
``constraints``, ``stepping``, and the modules of commands and target motion.
"""
