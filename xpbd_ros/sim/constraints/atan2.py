"""
Arc tangent of two arguments for vectors, by IEEE additions, multiplications and divisions only.

With t the smaller of |s|, |c| over the larger, and u = (t - 1) / (t + 1) where t > tan 22.5°,
atan u = u + u z P(z), z = u². P interpolates (atan u / u - 1) / z at the 12 Chebyshev points of
0 … tan² 22.5°; its error is 1.3e-18, below rounding. The result is accurate to a few ulp, with the
same bits for vectors of any width.
"""

from math import pi, sqrt

from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd import absolute, fma, larger, select

_P = (-0.3333333333333312, 0.1999999999994089, -0.1428571427925024, 0.11111110744919396,
      -0.09090896809056438, 0.07692045330765912, -0.06662951812061838, 0.05846878285787001,
      -0.050351024039430294, 0.037965256099576565, -0.017805395704537506)
_TAN = sqrt(2.0) - 1.0


@jit(inline=True)
def angle_of(s, c):
    """Return atan2(s, c) in -π … π; 0 where both are 0."""
    a, b = absolute(s), absolute(c)
    long = larger(a, b)
    steep, wide = a > b, long > 0.0
    t = select(steep, b, a) / select(wide, long, 1.0)
    far = t > _TAN
    u = select(far, (t - 1.0) / (t + 1.0), t)
    z = u * u
    p = fma(z, _P[10], _P[9])
    p = fma(z, p, _P[8])
    p = fma(z, p, _P[7])
    p = fma(z, p, _P[6])
    p = fma(z, p, _P[5])
    p = fma(z, p, _P[4])
    p = fma(z, p, _P[3])
    p = fma(z, p, _P[2])
    p = fma(z, p, _P[1])
    p = fma(z, p, _P[0])
    angle = fma(u * z, p, u)
    angle = select(far, 0.25 * pi + angle, angle)
    angle = select(steep, 0.5 * pi - angle, angle)
    angle = select(c < 0.0, pi - angle, angle)
    return select(s < 0.0, -angle, angle)
