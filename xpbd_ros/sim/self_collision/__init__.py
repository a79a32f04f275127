"""
Contact of cloth with cloth: neighbour list, narrow phase, pair contacts with friction, and the
motion limit that prevents passing through.

It imports ``backend``, ``particles``, ``geometry`` and ``contact``: projections of pair contacts
and of contacts with colliders alternate.
"""
