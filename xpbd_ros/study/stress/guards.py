"""
The guards in the solver, each with a case that fails without it.

``without`` runs that case on a copy of the package from which the guard is removed; it must fail.
"""

from dataclasses import dataclass
import os
from pathlib import Path
import shutil
import subprocess
import sys
import tempfile

PACKAGE = Path(__file__).parents[2]
RUN = """
import sys
from xpbd_ros.study.stress import all_hard
case = next(one for one in all_hard() if one.id == sys.argv[1])
attempt = next(each for each in case.attempts() if getattr(each, 'name', '') == sys.argv[2])
print(attempt.outcome().why)
"""


@dataclass(frozen=True)
class Guard:
    """One guard and the edit that removes it."""

    case: str
    """id of a case that fails without it"""
    attempt: str
    """name of an attempt of that case that fails without it"""
    what: str
    """description"""
    file: str
    """file with the guard, in the package"""
    code: str
    """text in that file that occurs once"""
    without: str
    """text that replaces it to remove the guard"""


GUARDS = (
    Guard('H5', 'gauss_seidel backward_euler 8x1 all of them',
          'edges of length 0 open along an axis', 'sim/constraints/distance.py',
          'select(far, d.x, axis[0])', 'd.x'),
    Guard('H2', 'line bdf2 8x1 float32 1e+300 m/N',
          'compliances are limited so that their squares are finite',
          'sim/constraints/projection.py',
          'float(np.sqrt(np.finfo(dtype).max))', 'np.inf'),
    Guard('H7', 'line bdf2 8x1 a book that shuts further', 'hinge angles count whole turns',
          'effects/hinge.py', '2.0 * pi, nearest((last - now) * (0.5 / pi))', '0.0, last'),
    Guard('H8', 'line bdf2 8x1 nearly a line, stiff', 'collapsed triangles do not overshoot',
          'effects/membrane.py', 'squeezed = larger(0.5 * root(shortest) - shortest, 0.0)',
          'squeezed = 0.0 * shortest'),
    Guard('H9', 'line bdf2 8x1 a point', 'a body in one point opens in its rest orientation',
          'effects/volume.py', 'alone = select(there, 0.0, per / REST)', 'alone = 0.0 * per'),
    Guard('H11', 'line bdf2 8x1 a sheet by its corners',
          'overextended rigid lines are straightened',
          'sim/constraints/overextended_lines.py',
          'taut.count[0] = len(found)', 'taut.count[0] = 0'),
    Guard('H11', 'line bdf2 8x1 a strip', 'edges between two pins are skipped',
          'sim/constraints/distance.py', 'both(total > 0.0, there)', 'there'),
    Guard('H13', 'line bdf2 8x1 both', 'the speed of pins is limited',
          'sim/target_motion.py',
          'slower = min(1.0, self.max_speed * dt / distance if distance > 0.0 else 1.0)',
          'slower = 1.0'),
    Guard('H15', 'line bdf2 8x1 appears half a radius deep',
          'deep penetrations are resolved slowly', 'sim/contact/contacts.py',
          'DEPENETRATION = 1.0',
          'DEPENETRATION = 1e9'),
    Guard('H15', 'line bdf2 8x1 appears half a radius deep',
          'resolving an old penetration adds no velocity', 'sim/contact/restitution.py',
          'if still > 0.0:', 'if False:'),
    Guard('H16', 'gauss_seidel backward_euler 8x1',
          'cloth between two colliders penetrates both equally', 'sim/contact/contacts.py',
          'if turn == CORNER and not contacts.count[3]:', 'if turn == CORNER:'),
    Guard('H18', 'line bdf2 8x1 the cloth moves', 'continuous detection for fast particles',
          'sim/contact/contacts.py', 'if not contacts.crossed[k] and step', 'if False and step'),
    Guard('H17', 'line bdf2 8x1 one particle at the centre of a sphere',
          'a normal is defined at the centre of a sphere', 'sim/contact/signed_distance.py',
          '    if l > 0.0:\n        return l - radius, x / l',
          '    if True:\n        return l - radius, x / l'),
    Guard('H17', 'explicit leapfrog 100x1 centre of a sphere',
          'an unstable frame of explicit is recomputed with line',
          'sim/stepping/explicit_guard.py',
          'if self._is_stable(before, more):', 'if True:'),
    Guard('H27', 'line bdf2 16x1 slammed shut', 'separating planes between triangles',
          'sim/self_collision/separating_planes.py',
          'if not parts(planes, m, near, state.x):', 'if False:'),
    Guard('H28', 'line bdf2 1x1 held', 'drag never accelerates cloth beyond the air speed',
          'effects/drag.py', '    s /= max(1.0, trace)\n', ''),
    Guard('H29', 'line bdf2 8x1 restitution 0', 'contact invalidates the multistep history',
          'sim/particles/history.py', 'history.fresh[i] += TOUCHED', 'pass'),
    Guard('H32', 'line ndf2 2x1 particles anywhere', 'line ends with a pass over its edges',
          'sim/stepping/methods.py', 'lines_again, back, close)', 'lines_again, back)'),
    Guard('H32', 'line bdf2 4x1 stiff in bending', 'line also sweeps backward',
          'sim/stepping/methods.py', 'lines_again, back, close)', 'lines_again, close)'),
    Guard('H32', 'jacobi backward_euler 8x1 relaxation too large',
          'implausible frames are rolled back', 'sim/stepping/rollback.py',
          'if self._is_plausible(REACH * (self._size + drive)):', 'if True:'),
    Guard('H33', 'line bdf2 8x1 a sway that dies away', 'denormal numbers are flushed to 0',
          'sim/backend/denormals.py', 'FLUSH = 0x8040', 'FLUSH = 0'),
)


def without(guard: Guard) -> str:
    """Return the criteria that the case misses on a copy of the package without the guard."""
    with tempfile.TemporaryDirectory(prefix='xpbd_ros_guard_') as folder:
        copy = Path(folder) / 'xpbd_ros'
        shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns('__pycache__'))
        file = copy / guard.file
        source = file.read_text(encoding='utf-8')
        assert source.count(guard.code) == 1, (guard.file, guard.code)
        file.write_text(source.replace(guard.code, guard.without), encoding='utf-8')
        done = subprocess.run(
            [sys.executable, '-c', RUN, guard.case, guard.attempt], cwd=folder, text=True,
            env={**os.environ, 'PYTHONPATH': folder, 'NUMBA_CACHE_DIR': str(Path(folder) / 'c')},
            capture_output=True, check=False)
        if done.returncode:
            raise RuntimeError(done.stderr)
        return done.stdout.strip()
