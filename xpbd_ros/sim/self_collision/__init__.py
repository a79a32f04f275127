"""
Contact of cloth with cloth: neighbour lists, narrow phase, pair contacts with friction, and the
bound that lets nothing pass through.

It imports ``contact`` and what is below, since what colliders and cloth push must agree.
"""
