"""The tables of whole scenes: the reference swing's error against time, and how cost scales."""

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

import candidates
from kernels import STRIP
from native import GridBound, Native, Textbook
from report import Report
from timing import interleave, Timed
from works import FRAME_DT, grid_work, scene_work, SUBSTEPS
from xpbd_ros.study.reference import limit, problem_of

STIFFNESSES = (5e3, 5e4)
"""[N/m]"""
FRAMES = 30
"""of the swing: 0.5 s"""
MOST_SUBSTEPS = 8192
SURE = 1e-6
"""uncertainty [m] wanted of the reference"""


# The swing

@dataclass
class Ours:
    """One setting of our solver on the swing."""

    n: int
    stiffness: float
    setting: dict
    row: dict = field(init=False)

    def __post_init__(self):
        self.reset()
        solver = self.simulation.solver
        self.row = {'method': self.setting['method'], 'substeps': solver.substeps,
                    'integrator': self.setting['integrator'] or solver.integrator}

    def reset(self) -> None:
        """Go back to the start."""
        self.simulation = candidates.swing(self.n, self.stiffness, **self.setting)

    def run(self, frames: int) -> None:
        """Advance."""
        for _ in range(frames):
            self.simulation.step()

    def positions(self) -> np.ndarray:
        """Return x [m], shape (particles, 3)."""
        return self.simulation.frame().x


class Plain:
    """The textbook on the same masses and constraints; or, on them, a leapfrog."""

    def __init__(self, native: Native, work, substeps: int, *, leapfrog: bool = False):
        self.cloth = Textbook(native, work, 'float64')
        self.advance = self.cloth.leapfrog if leapfrog else self.cloth.advance
        self.reset, self.positions = self.cloth.reset, self.cloth.positions
        self.substeps = substeps
        self.row = {'method': 'textbook_leapfrog' if leapfrog else 'textbook',
                    'integrator': 'leapfrog' if leapfrog else 'backward_euler',
                    'substeps': substeps}

    def run(self, frames: int) -> None:
        """Advance."""
        self.advance(frames, FRAME_DT, self.substeps)


def swing(report: Report, n: int) -> None:
    """Error after 0.5 s against time per frame, float64, one thread."""
    for stiffness in STIFFNESSES:
        report.say(f'\nswing, n = {n}, {stiffness:g} N/m, float64')
        found = report.attempt('reference', _reference, report, n, stiffness)
        if found is not None:
            _swing(report, n, stiffness, *found)


def _reference(report: Report, n: int, stiffness: float):
    problem = problem_of(candidates.swing(
        n, stiffness, method='gauss_seidel', integrator='backward_euler', substeps=1))
    reference = limit(problem, FRAMES * FRAME_DT, SURE)
    report.say(f'  reference: {reference.method}, {len(reference.ladder)} rungs, known to '
               f'{reference.uncertainty:.0e} m')
    return scene_work(problem, n), reference


def _swing(report: Report, n: int, stiffness: float, work, reference) -> None:
    runs = []

    def add(name, make, *arguments, **options):
        run = report.attempt(name, lambda: make(*arguments, **options))
        if run is None:
            return None
        run.reset()
        run.run(FRAMES)
        run.row['rms_error_m'] = reference.error(run.positions())
        runs.append(run)
        return run.row['rms_error_m']

    substeps, error = 16, np.inf
    while error is not None and error > report.goal and substeps <= MOST_SUBSTEPS:
        error = add('textbook', Plain, report.native, work, substeps)
        substeps *= 2
    add('textbook_leapfrog', Plain, report.native, work, candidates.stable(n, stiffness),
        leapfrog=True)
    for setting in candidates.swing_settings(n, stiffness):
        add(f'{setting["method"]}, {setting["integrator"]}', Ours, n, stiffness, setting)
    times = 1e3 * interleave([Timed(run.run, reset=run.reset, most=FRAMES) for run in runs],
                             rounds=report.rounds, seconds=6 * report.seconds)
    report.say(f"  {'':24} {'integrator':>15} {'substeps':>8} {'ms':>8} {'fastest':>8} "
               f"{'slowest':>8} {'error, m':>9}")
    for run, ms in zip(runs, times):
        run.row.update(n=n, stiffness=stiffness, ms=float(np.median(ms)), ms_min=float(ms.min()),
                       ms_max=float(ms.max()))
        row = run.row
        report.data['swing'].append(row)
        report.say(f'  {row["method"]:24} {row["integrator"]:>15} {row["substeps"]:8} '
                   f'{row["ms"]:8.2f} {row["ms_min"]:8.2f} {row["ms_max"]:8.2f} '
                   f'{row["rms_error_m"]:9.1e}')
    _goals(report, [run.row for run in runs])


def _goals(report: Report, rows: list[dict]) -> None:
    """Say how much of the textbook's time for an error each of the others takes for less."""
    plain = [row for row in rows if row['method'] == 'textbook']
    if not plain:
        return
    if plain[-1]['rms_error_m'] > report.goal:
        report.say(f'  the textbook does not get to {report.goal:g} m')
        return
    ladder = plain[-2:]
    errors, ms = (np.log([row[key] for row in ladder]) for key in ('rms_error_m', 'ms'))
    needed = float(np.exp(np.interp(np.log(report.goal), errors[::-1], ms[::-1])))
    report.say(f'  the textbook needs {needed:.1f} ms for {report.goal:g} m')
    for row in rows:
        if row['method'] == 'textbook' or not row['rms_error_m'] <= report.goal:
            continue
        share = row['ms'] / needed
        report.data['swing_goals'].append({
            **{key: row[key] for key in ('n', 'stiffness', 'method', 'integrator', 'substeps',
                                         'rms_error_m')},
            'textbook_ms': needed, 'share_of_textbook': share})
        report.say(f'    {row["method"]}, {row["integrator"]}, {row["substeps"]} × 1: '
                   f'{row["rms_error_m"]:.1e} m in {share:.3f} of that')


# Scaling

def scaling(report: Report, sizes: Iterable[int]) -> None:
    """Time per frame of the swing at 5 kN/m, and of the bound on the grid work, at 10 × 1."""
    report.say('\nscaling, 10 × 1, float64: ms per frame')
    found: dict[tuple[str, str], dict[int, float]] = {}
    for n in sizes:
        entries = []
        for method, work, make, *arguments in (
                ('textbook', 'swing', _plain_frames, report.native),
                ('bound', 'grid', _bound_frames, report.native),
                *((f'{setting["method"]}, {setting["integrator"]}', 'swing', _our_frames, setting)
                  for setting in candidates.SCALED)):
            timed = report.attempt(method, make, n, *arguments)
            if timed is not None:
                entries.append((method, work, timed))
        times = 1e3 * interleave([timed for *_, timed in entries], rounds=report.rounds,
                                 seconds=report.seconds)
        for (method, work, _), ms in zip(entries, times):
            found.setdefault((method, work), {})[n] = float(np.median(ms))
            report.data['scaling'].append({
                'method': method, 'work': work, 'n': n, 'ms': float(np.median(ms)),
                'ms_min': float(ms.min()), 'ms_max': float(ms.max())})
    report.say(f"  {'':32} {'work':6} " + ' '.join(f'{n:>8}' for n in sizes) + '  exponent')
    for (method, work), ms in found.items():
        exponent = None
        if len(ms) > 1:
            exponent = float(np.polyfit(2 * np.log(list(ms)), np.log(list(ms.values())), 1)[0])
            report.data['exponents'].append(
                {'method': method, 'work': work, 'exponent': exponent})
        report.say(f'  {method:32} {work:6} '
                   + ' '.join(f'{ms[n]:8.3f}' for n in sizes)
                   + ('' if exponent is None else f'  {exponent:8.2f}'))


def _plain_frames(n: int, native: Native) -> Timed:
    native.need('textbook')
    problem = problem_of(candidates.swing(
        n, STIFFNESSES[0], method='gauss_seidel', integrator='backward_euler', substeps=SUBSTEPS))
    return Timed(Plain(native, scene_work(problem, n), SUBSTEPS).run)


def _bound_frames(n: int, native: Native) -> Timed:
    bound = GridBound(native, grid_work(n), 'float64', estimate=False, strip=STRIP)
    return Timed(lambda frames: bound.advance(frames * SUBSTEPS, FRAME_DT / SUBSTEPS))


def _our_frames(n: int, setting: dict) -> Timed:
    return Timed(Ours(n, STIFFNESSES[0], {**setting, 'substeps': SUBSTEPS}).run)
