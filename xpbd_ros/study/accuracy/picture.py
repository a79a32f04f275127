"""Draw error against time: a curve per method, the Pareto front, real time, recommendation."""

from collections.abc import Sequence
import math
from pathlib import Path

from xpbd_ros.sim.stepping.methods import METHODS
from xpbd_ros.study.accuracy.choose import Row
from xpbd_ros.study.accuracy.measure import Study
from xpbd_ros.study.accuracy.solver_setting import BASELINES, Setting
from xpbd_ros.study.chart import COLOURS, INK, MUTED, page, save

COLOUR = dict(zip(METHODS, (COLOURS[0], COLOURS[2], COLOURS[3], COLOURS[1], COLOURS[4])))
COLOUR.update(dict(zip(BASELINES, ('#4d5560', '#8b95a1', '#b8a24a', '#8c5a3c'))))
MARKER = dict(zip((*METHODS, *BASELINES), 'sDo^Pv<>X'))
DASHES = {'ndf2': '-', 'bdf2': (0, (5, 1.5, 1, 1.5)), 'backward_euler': '--', 'leapfrog': '-',
          'symplectic_euler': ':'}


def curve_of(setting: Setting) -> str:
    """Return the name of the curve that a setting is on."""
    if setting.is_baseline:
        return setting.method + (' 1×K' if setting.substeps == 1 else '')
    name = f'{setting.method} {setting.integrator}'
    if setting.precision != 'float64':
        name += f' {setting.precision}'
    if setting.iterations > 1:
        name += ' 1×K' if setting.substeps == 1 else f' N×{setting.iterations}'
    return name


def curves(rows: Sequence[Row], by: str) -> dict[str, list[Row]]:
    """Return the rows with a time and an error by curve, fastest first."""
    found: dict[str, list[Row]] = {}
    for row in rows:
        if row.timing is not None and math.isfinite(row.error(by)):
            found.setdefault(curve_of(row.setting), []).append(row)
    return {name: sorted(these, key=lambda row: row.timed.ms_p50)
            for name, these in found.items()}


def within(rows: Sequence[Row], by: str, ms: float) -> dict[str, Row]:
    """Return the most accurate row of each curve whose p95 is within a time [ms]."""
    found = {}
    for name, these in curves(rows, by).items():
        fast = [row for row in these if row.timed.ms_p95 <= ms]
        if fast:
            found[name] = min(fast, key=lambda row: row.error(by))
    return dict(sorted(found.items(), key=lambda item: item[1].error(by)))


def draw(study: Study, file: Path, *, chosen: Row | None, budget: float) -> Path:
    """Draw a study to a file, and return its path; ``budget`` [ms]."""
    figure, axes = page(11.5, 6.4, columns=2)
    _precision(axes[0, 0], study, chosen, budget)
    _bars(axes[0, 1], study, chosen, budget)
    figure.legend(handles=axes[0, 0].get_legend_handles_labels()[0], fontsize=7, frameon=False,
                  loc='outside lower center', ncols=5, handlelength=4.0, columnspacing=1.5)
    return save(figure, file)


def _precision(axis, study: Study, chosen: Row | None, budget: float) -> None:
    by = study.by
    known = curves(study.rows, by)
    for name, these in known.items():
        setting = these[0].setting
        colour = COLOUR[setting.method]
        single = setting.precision != 'float64'
        axis.loglog([row.timed.ms_p50 for row in these], [row.error(by) for row in these],
                    color=colour, linestyle=DASHES[setting.integrator], linewidth=1.0,
                    marker=MARKER[setting.method], markersize=5, markeredgewidth=0.8,
                    fillstyle='top' if single else 'full', markerfacecoloralt='white',
                    markerfacecolor='white' if setting.iterations > 1 else colour, label=name)
    front = sorted((row.timed.ms_p50, row.error(by)) for row in study.rows if row.pareto)
    if front:
        axis.plot(*zip(*front), color='#f0e442', linewidth=7, alpha=0.6, zorder=0,
                  solid_capstyle='round', label='Pareto front')
    if chosen is not None:
        axis.plot([chosen.timed.ms_p50], [chosen.error(by)], marker='o', markersize=12,
                  markerfacecolor='none', markeredgecolor=INK, markeredgewidth=1.6,
                  linestyle='none', label='recommended')
    frame_ms = 1e3 * study.frame_dt
    if budget != frame_ms:
        axis.axvline(budget, color=INK, linewidth=1.0, linestyle=':',
                     label=f'budget: {budget:.3g} ms')
    axis.axvline(frame_ms, color=INK, linewidth=1.0, label=f'real time: {frame_ms:.3g} ms')
    if study.floor > 0.0:
        axis.axhspan(1e-300, study.floor, color=MUTED, alpha=0.15, linewidth=0,
                     label=f'uncertainty of the true solution: {study.floor:.1g} m')
    errors = [max(row.error(by), 1e-300) for these in known.values() for row in these]
    if errors:
        low = min(errors)
        axis.set_ylim(min(low, study.floor if study.floor > low / 30.0 else low) / 2.0,
                      min(max(errors), study.truth.size) * 1.5)
    axis.set_xlabel('CPU time of a frame, median [ms]', fontsize=8)
    axis.set_ylabel(f'{study.what} [m]', fontsize=8)
    axis.set_title(f'{study.scene.name}: error against time '
                   f'({study.particles} particles)', fontsize=10, loc='left')
    axis.grid(alpha=0.2, which='major')


def _bars(axis, study: Study, chosen: Row | None, budget: float) -> None:
    found = within(study.rows, study.by, budget)
    names = list(found)[::-1]
    for place, name in enumerate(names):
        row = found[name]
        axis.barh(place, row.error(study.by), color=COLOUR[row.setting.method],
                  alpha=1.0 if row is chosen else 0.65,
                  edgecolor=INK if row is chosen else 'none')
        axis.annotate(f'{row.setting.substeps}×{row.setting.iterations}: '
                      f'{1e3 * row.error(study.by):.3g} mm',
                      (row.error(study.by), place), (4, 0), fontsize=7, va='center',
                      textcoords='offset points')
    axis.set_yticks(range(len(names)), names, fontsize=7)
    axis.set_xscale('log')
    axis.margins(x=0.35)
    axis.set_xlabel(f'{study.what} [m]', fontsize=8)
    axis.set_title(f'least error within {budget:.3g} ms per frame', fontsize=10, loc='left')
