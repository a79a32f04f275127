"""
The guards in the solver: which case needs each, and what the code would be without it.

``without`` runs a case on a copy of the package from which one guard was taken out; it must fail.
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
    """One guard."""

    case: str
    """the id of a case that fails without it"""
    attempt: str
    """of that case, as its row is named"""
    what: str
    """what it does"""
    file: str
    """where it is, in the package"""
    code: str
    """a piece of that file, there once"""
    without: str
    """what stands there instead where the guard is out"""


GUARDS = (
    Guard('H5', 'gauss_seidel backward_euler 8x1 all of them',
          'edges without a direction part along an axis', 'sim/constraints/distance.py',
          'select(apart_, dx, ux)', 'dx'),
    Guard('H2', 'line bdf2 8x1 float32 1e+300 m/N',
          'compliances end where their square would be infinite', 'sim/constraints/distance.py',
          'float(np.sqrt(np.finfo(dtype).max))', 'np.inf'),
    Guard('H7', 'line bdf2 8x1 a book that shuts further', 'hinges count whole turns',
          'effects/hinge.py', '2.0 * pi, nearest((last - now) * (0.5 / pi))', '0.0, last'),
    Guard('H8', 'line bdf2 8x1 nearly a line, stiff', 'what is squeezed flat is not thrown out',
          'effects/membrane.py', 'squeezed = larger(0.5 * root(shortest) - shortest, 0.0)',
          'squeezed = 0.0 * shortest'),
    Guard('H9', 'line bdf2 8x1 a point', 'a body in a point opens as its rest shape lies',
          'effects/volume.py', 'alone = select(there, 0.0, per / REST)', 'alone = 0.0 * per'),
    Guard('H11', 'line bdf2 8x1 a sheet by its corners',
          'rigid lines that are pulled too far are straight',
          'sim/constraints/overextended_lines.py',
          'taut.count[0] = len(found)', 'taut.count[0] = 0'),
    Guard('H11', 'line bdf2 8x1 a strip', 'edges between two pins are left alone',
          'sim/constraints/distance.py', 'both(total > 0.0, there)', 'there'),
    Guard('H13', 'line bdf2 8x1 both', 'targets are followed at a largest speed',
          'sim/target_motion.py',
          'slower = min(1.0, self.max_speed * dt / distance if distance > 0.0 else 1.0)',
          'slower = 1.0'),
    Guard('H15', 'line bdf2 8x1 appears half a radius deep',
          'what is too deep comes out slowly', 'sim/contact/contacts.py', 'DEPENETRATION = 1.0',
          'DEPENETRATION = 1e9'),
    Guard('H15', 'line bdf2 8x1 appears half a radius deep',
          'what undoes an old overlap is no velocity', 'effects/contact.py',
          '        if still > 0.0:', '        if False:'),
    Guard('H16', 'gauss_seidel backward_euler 8x1',
          'between two colliders each gives half', 'sim/contact/contacts.py',
          'if contacts.count[3]:', 'if False:'),
    Guard('H18', 'line bdf2 8x1 the cloth moves', 'what is fast is followed on its way',
          'sim/contact/contacts.py', 'if not contacts.crossed[k] and step', 'if False and step'),
    Guard('H17', 'line bdf2 8x1 one particle at the centre of a sphere',
          'the centre of a ball has a normal', 'sim/contact/signed_distance.py',
          '    if l > 0.0:\n        return l - radius, x / l',
          '    if True:\n        return l - radius, x / l'),
    Guard('H17', 'explicit leapfrog 100x1 centre of a sphere',
          'an unstable frame of explicit is recomputed with line',
          'sim/stepping/explicit_guard.py',
          'if is_stable(before', 'if True or is_stable(before'),
    Guard('H27', 'line bdf2 16x1 slammed shut', 'planes part cloth from cloth',
          'sim/self_collision/separating_planes.py',
          'if parts(planes, m, near, state.x):', 'if True:'),
    Guard('H28', 'line bdf2 1x1 held', 'the air carries nothing faster than itself',
          'effects/drag.py', '    s /= max(1.0, trace)\n', ''),
    Guard('H29', 'line bdf2 8x1 restitution 0', 'what was touched has no history',
          'sim/particles/history.py', 'history.fresh[i] = TOUCHED', 'pass'),
    Guard('H32', 'line ndf2 2x1 particles anywhere', 'line closes with a pass over its edges',
          'sim/stepping/methods.py', 'Line: (forth, back, close)', 'Line: (forth, back)'),
    Guard('H32', 'line bdf2 4x1 stiff in bending', 'line sweeps back over what it swept forth',
          'sim/stepping/methods.py', 'Line: (forth, back, close)', 'Line: (forth, close)'),
    Guard('H32', 'jacobi backward_euler 8x1 relaxation too large',
          'implausible frames are rolled back', 'sim/stepping/rollback.py',
          'if is_plausible(state, self._x, REACH * (self._size + drive)):', 'if True:'),
    Guard('H33', 'line bdf2 8x1 a sway that dies away', 'what is too small to matter becomes 0',
          'sim/backend/denormals.py', 'FLUSH = 0x8040', 'FLUSH = 0'),
)


def without(guard: Guard) -> str:
    """Return what the case misses on a copy of the package that lacks the guard."""
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
