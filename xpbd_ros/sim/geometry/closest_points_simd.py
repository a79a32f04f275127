"""
Closest points of a point and a triangle, and of two edges, by lanes.

The same formulas as ``geometry.closest_points`` (C. Ericson, "Real-time collision detection",
2005, 5.1), with all regions computed and one selected. Points are tuples of vectors (x, y, z) [m].
"""

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import both, fma, larger, select, smaller


@jit(inline=True)
def dot(a, b):
    """Return a · b."""
    return fma(a[0], b[0], fma(a[1], b[1], a[2] * b[2]))


@jit(inline=True)
def minus(a, b):
    """Return a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@jit(inline=True)
def share(part, whole):
    """Return part / whole clamped to 0 … 1; 0 unless whole > 0."""
    there = whole > 0.0
    clamped = smaller(larger(part / select(there, whole, 1.0), 0.0), 1.0)
    return select(there, clamped, 0.0)


@jit(inline=True)
def on_triangle(p, a, b, c):
    """Return the weights v, w of b and c at the point of abc closest to p, and p - that point."""
    ab, ac, ap = minus(b, a), minus(c, a), minus(p, a)
    d1, d2 = dot(ab, ap), dot(ac, ap)
    bb, bc, cc = dot(ab, ab), dot(ab, ac), dot(ac, ac)
    d3, d4, d5, d6 = d1 - bb, d2 - bc, d1 - bc, d2 - cc
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    zero = d1 - d1
    # the interior, then edges bc, ac, c, ab, b, a: the last that applies counts
    v, w, whole = vb, vc, va + vb + vc
    here = both(both(va <= 0.0, d4 >= d3), d5 >= d6)
    v, w = select(here, d5 - d6, v), select(here, d4 - d3, w)
    whole = select(here, (d4 - d3) + (d5 - d6), whole)
    here = both(both(vb <= 0.0, d2 >= 0.0), d6 <= 0.0)
    v, w, whole = select(here, zero, v), select(here, d2, w), select(here, d2 - d6, whole)
    here = both(d6 >= 0.0, d5 <= d6)
    v, w, whole = select(here, zero, v), select(here, d6 - d6 + 1.0, w), select(here, 1.0, whole)
    here = both(both(vc <= 0.0, d1 >= 0.0), d3 <= 0.0)
    v, w, whole = select(here, d1, v), select(here, zero, w), select(here, d1 - d3, whole)
    here = both(d3 >= 0.0, d4 <= d3)
    v, w, whole = select(here, zero + 1.0, v), select(here, zero, w), select(here, 1.0, whole)
    here = both(d1 <= 0.0, d2 <= 0.0)
    there = whole > 0.0
    per = select(there, 1.0 / select(there, whole, 1.0), 0.0)
    v = smaller(larger(per * select(here, zero, v), 0.0), 1.0)
    w = smaller(larger(per * select(here, zero, w), 0.0), 1.0)
    return v, w, (ap[0] - fma(v, ab[0], w * ac[0]), ap[1] - fma(v, ab[1], w * ac[1]),
                  ap[2] - fma(v, ab[2], w * ac[2]))


@jit(inline=True)
def on_edges(a, b, c, d):
    """Return the weights s, t of b and d where ab and cd are closest, and the vector cd to ab."""
    u, v, r = minus(b, a), minus(d, c), minus(a, c)
    uu, vv, uv, ur, vr = dot(u, u), dot(v, v), dot(u, v), dot(u, r), dot(v, r)
    s = share(uv * vr - ur * vv, uu * vv - uv * uv)
    way = fma(uv, s, vr)
    t = share(way, vv)
    inside = both(way > 0.0, way < vv)
    s = select(inside, s, share(fma(uv, t, -ur), uu))
    return s, t, (fma(s, u[0], r[0]) - t * v[0], fma(s, u[1], r[1]) - t * v[1],
                  fma(s, u[2], r[2]) - t * v[2])
