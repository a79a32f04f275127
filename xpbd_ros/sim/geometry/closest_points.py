"""
Closest points of a point and a triangle, and of two edges, as barycentric weights.

C. Ericson, "Real-time collision detection", 2005, 5.1. Points are tuples (x, y, z) [m]. The
weights of the corners are returned, so that closest points can move with the corners. Degenerate
triangles and edges are allowed.
"""

from xpbd_ros.sim.backend.jit import jit


@jit(inline=True)
def minus(a, b):
    """Return a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@jit(inline=True)
def dot(a, b):
    """Return a · b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@jit(inline=True)
def cross(a, b):
    """Return a × b."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@jit(inline=True)
def share(part, whole):
    """Return part / whole clamped to 0 … 1; 0 unless whole > 0."""
    return min(1.0, max(0.0, part / whole)) if whole > 0.0 else 0.0


@jit
def on_triangle(p, a, b, c):
    """Return the weights of a, b and c at the point of the triangle abc closest to p."""
    ab, ac, ap = minus(b, a), minus(c, a), minus(p, a)
    d1, d2 = dot(ab, ap), dot(ac, ap)
    if d1 <= 0.0 and d2 <= 0.0:
        return 1.0, 0.0, 0.0
    bp = minus(p, b)
    d3, d4 = dot(ab, bp), dot(ac, bp)
    if d3 >= 0.0 and d4 <= d3:
        return 0.0, 1.0, 0.0
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        v = share(d1, d1 - d3)
        return 1.0 - v, v, 0.0
    cp = minus(p, c)
    d5, d6 = dot(ab, cp), dot(ac, cp)
    if d6 >= 0.0 and d5 <= d6:
        return 0.0, 0.0, 1.0
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        w = share(d2, d2 - d6)
        return 1.0 - w, 0.0, w
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 >= d3 and d5 >= d6:
        w = share(d4 - d3, (d4 - d3) + (d5 - d6))
        return 0.0, 1.0 - w, w
    v, w = share(vb, va + vb + vc), share(vc, va + vb + vc)
    return max(0.0, 1.0 - v - w), v, w


@jit
def on_edges(a, b, c, d):
    """Return the weights of b and d at the closest points of the edges ab and cd."""
    u, v, r = minus(b, a), minus(d, c), minus(a, c)
    uu, vv, uv, ur, vr = dot(u, u), dot(v, v), dot(u, v), dot(u, r), dot(v, r)
    s = share(uv * vr - ur * vv, uu * vv - uv * uv)
    t = uv * s + vr
    if t <= 0.0:
        return share(-ur, uu), 0.0
    if t >= vv:
        return share(uv - ur, uu), 1.0
    return s, t / vv
