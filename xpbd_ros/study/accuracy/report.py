"""The files of a study: tables, report and the settings file of the recommendation."""

import base64
from collections.abc import Sequence
import csv
from datetime import datetime, timezone
from html import escape
import math
from pathlib import Path
from statistics import median

import yaml

from xpbd_ros import __version__
from xpbd_ros.study.accuracy.choose import Default, POSITION, Row, SHAPE
from xpbd_ros.study.accuracy.errors import Errors
from xpbd_ros.study.accuracy.measure import Study
from xpbd_ros.study.accuracy.solver_setting import Setting
from xpbd_ros.study.accuracy.timing import Timing
from xpbd_ros.study.machine import describe

ALONE = 0.9
"""CPU time over wall time below which other processes disturbed a timing"""
STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1f2328; max-width: 76rem; margin: 2rem auto;
       padding: 0 1rem }
img { max-width: 100% } table { border-collapse: collapse; font-size: 13px }
td, th { padding: 2px 9px; text-align: right; border-bottom: 1px solid #e3e6ea }
td:first-child, th:first-child, td:last-child, th:last-child { text-align: left }
tr.front { background: #fdf3d7 } tr.chosen { font-weight: 600 } pre { background: #f5f6f8;
       padding: .7rem; overflow-x: auto }
"""


def numbers_of(row: Row, by: str) -> dict:
    """Return a row as the keys of JSON and CSV."""
    errors, timing = row.errors, row.timing

    def last(values):
        return values[-1] if values and errors.finite else math.nan
    return {
        **vars(row.setting),
        'ms_p50': timing.ms_p50 if timing else None, 'ms_p95': timing.ms_p95 if timing else None,
        'real_time_factor': timing.real_time_factor if timing else None,
        'bytes': timing.bytes if timing else None,
        'rms_error_m': last(errors.rms_m), 'max_error_m': last(errors.max_m),
        'strain_error': last(errors.strain), 'energy_drift': last(errors.energy),
        'residual_m': errors.residual_m,
        'height_error_m': errors.height_m, 'mean_strain_error': errors.mean_strain,
        'mean_energy_error': errors.mean_energy,
        'error_m': row.error(by), 'pareto': row.pareto, 'scene': row.scene,
        'baseline': row.setting.is_baseline, 'note': errors.note,
    }


def numbers_of_default(one: Default, by: str) -> dict:
    """Return a setting of ``auto`` as keys of JSON."""
    return {'budget_ms': one.budget_ms, **numbers_of(one.row, by),
            'best': numbers_of(one.best, by), 'ratio': one.ratio}


def settings_text(study: Study, row: Row) -> str:
    """Return a settings file, for ``run --settings`` and the node's parameter ``settings``."""
    note = (f'# {study.scene.name}: {study.what} {row.error(study.by):.3g} m, '
            f'{row.timed.ms_p50:.3g} ms per frame ({row.timed.ms_p95:.3g} ms p95)\n'
            f'# on {describe(study.machine)}; found by xpbd_ros accuracy {__version__}\n')
    keys, scene = row.setting.block(), study.scene.top.solver
    if scene.error_target is not None:
        keys['max_substeps'] = max(scene.max_substeps, row.setting.substeps)
    return note + yaml.safe_dump({'solver': keys}, sort_keys=False)


def write_csv(study: Study, file: Path) -> Path:
    """Write all rows to a CSV file, with the errors at each time."""
    times = [f'{frame * study.frame_dt:.6g}' for frame in study.truth.frames]
    with file.open('w', newline='', encoding='utf-8') as stream:
        writer = None
        for row in study.rows:
            line = numbers_of(row, study.by)
            for name, values in (('rms', row.errors.rms_m), ('max', row.errors.max_m)):
                line.update({f'{name}_error_m_at_{t}_s': values[k] if values else math.nan
                             for k, t in enumerate(times)})
            if writer is None:
                writer = csv.DictWriter(stream, list(line))
                writer.writeheader()
            writer.writerow(line)
    return file


HEADS = ('setting', 'ms', 'ms p95', '× real time', 'KiB')
ERRORS = {POSITION: {'RMS m': 'rms_error_m', 'max m': 'max_error_m', 'strain': 'strain_error',
                     'energy': 'energy_drift', 'residual m': 'residual_m',
                     'heights m': 'height_error_m'},
          SHAPE: {'heights m': 'height_error_m', 'strain': 'mean_strain_error',
                  'energy': 'mean_energy_error', 'residual m': 'residual_m',
                  'RMS m, early': 'rms_error_m', 'max m, early': 'max_error_m'}}
"""columns of errors: heading and key, by the error that settings are judged by"""


def heads(by: str) -> list[str]:
    """Return the headings of the table."""
    return [*HEADS, *ERRORS[by], 'note']


def name_of(setting: Setting) -> str:
    """Return a setting as text, such as 'line bdf2 8×1'."""
    name = f'{setting.method} {setting.integrator} {setting.substeps}×{setting.iterations}'
    if setting.rough_frames:
        name += f' and line {setting.rough_integrator} {setting.rough_substeps}×1'
    return name if setting.precision == 'float64' else f'{name} {setting.precision}'


def cells(row: Row, by: str) -> list[str]:
    """Return the cells of a row of the table."""
    n = numbers_of(row, by)
    note = ', '.join(filter(None, ('the scene' if row.scene else '',
                                   'baseline' if n['baseline'] else '', n['note'])))
    return [name_of(row.setting),
            *(_short(n[key]) for key in ('ms_p50', 'ms_p95', 'real_time_factor')),
            '' if n['bytes'] is None else f"{n['bytes'] / 1024:.0f}",
            *(_short(n[key], '.1e') for key in ERRORS[by].values()), note]


def _short(value: float | None, form: str = '.3g') -> str:
    return '' if value is None or not math.isfinite(value) else f'{value:{form}}'


def facts(study: Study, chosen: Row | None, budget: float | None, max_error: float | None,
          again: tuple[Errors, Timing] | None) -> list[tuple[str, str]]:
    """Return (heading, text) of the summary above the table."""
    said = [('scene', f'{study.scene.name}: {study.particles} particles, {study.frames} frames '
             f'of {1e3 * study.frame_dt:.4g} ms'),
            ('machine', describe(study.machine)),
            ('truth', study.truth.text)]
    said += [('note', text) for text in study.notes]
    share = median([row.timing.cpu_share for row in study.rows if row.timing] or [1.0])
    if share < ALONE:
        said.append(('note', f'the machine was busy: timed runs had {100.0 * share:.0f} % of a '
                     'core, and their times may be too long'))
    if study.by == SHAPE:
        said.append(('note', f'settings are judged by their shape: {study.what}; it is known to '
                     f'{study.floor:.2g} m'))
    wish = (f'an error of {max_error:g} m at most' if max_error is not None else '')
    if budget is not None:
        wish += (' and ' if wish else '') + f'{budget:.4g} ms per frame (p95)'
    said.append(('asked', wish))
    if max_error is not None and max_error < study.floor:
        said.append(('note', f'the uncertainty of the truth is {study.floor:.2g} m; smaller '
                     'errors cannot be verified'))
    said += [('default', text) for text in texts_of(study.defaults, study.by)]
    if chosen is None:
        said.append(('found', 'no setting meets this'))
        return said
    said.append(('found', f'{name_of(chosen.setting)}: {study.what} '
                 f'{chosen.error(study.by):.3g} m, {chosen.timed.ms_p50:.3g} ms per frame, '
                 f'{chosen.timed.ms_p95:.3g} ms p95'))
    if again is not None:
        errors, timing = again
        error = Row(chosen.setting, errors).error(study.by)
        over = budget is not None and timing.ms_p95 > budget
        said.append(('rerun', f'{error:.3g} m, {timing.ms_p50:.3g} ms, {timing.ms_p95:.3g} ms '
                     'p95' + ', over the budget' * over))
    return said


def texts_of(defaults: Sequence[Default], by: str) -> list[str]:
    """Return a line for each setting of ``auto``, with the budgets that lead to it."""
    budgets: dict[str, list[str]] = {}
    for default in defaults:
        budgets.setdefault(text_of(default, by), []).append(f'{default.budget_ms:g}')
    return [f'auto with {", ".join(found)} ms is {text}' for text, found in budgets.items()]


def text_of(default: Default, by: str) -> str:
    """Return a setting of ``auto`` and the best one as fast."""
    row, best = default.row, default.best
    text = f'{name_of(row.setting)}: {row.error(by):.3g} m, {row.timed.ms_p95:.3g} ms p95; '
    if default.ratio <= 1.0:
        return text + 'no setting as fast is more accurate'
    return text + (f'as fast and {default.ratio:.3g} times as accurate is '
                   f'{name_of(best.setting)}: {best.error(by):.3g} m, '
                   f'{best.timed.ms_p95:.3g} ms p95')


def write_page(study: Study, file: Path, picture: Path, said: Sequence[tuple[str, str]],
               chosen: Row | None, settings: str) -> Path:
    """Write the report: one self-contained HTML file."""
    image = base64.b64encode(picture.read_bytes()).decode()
    parts = ['<!DOCTYPE html>', '<html lang="en"><head><meta charset="utf-8">',
             f'<title>{escape(study.scene.name)}: accuracy against time</title>',
             f'<style>{STYLE}</style></head><body>',
             f'<h1>{escape(study.scene.name)}: error against time</h1>',
             f'<p>xpbd_ros {__version__}, '
             f'{datetime.now(timezone.utc):%Y-%m-%d %H:%M} UTC</p>', '<table>',
             *(f'<tr><th>{name}</th><td>{escape(text)}</td></tr>' for name, text in said),
             '</table>',
             f'<p><img alt="error against time" src="data:image/png;base64,{image}"></p>']
    if settings:
        parts += ['<h2>Recommended settings</h2>', f'<pre>{escape(settings)}</pre>']
    parts += ['<h2>All settings</h2>',
              f'<p>{escape(legend(study))} Rows on the Pareto front are tinted.</p>',
              _table(heads(study.by), [(cells(row, study.by), ' '.join(filter(None, (
                  'front' if row.pareto else '', 'chosen' if row is chosen else ''))))
                  for row in study.rows])]
    if study.refused:
        parts += ['<h2>Left out</h2>', *(f'<p>{one.method}: {escape(one.reason)}</p>'
                                         for one in study.refused)]
    if len(study.truth.frames):
        parts += ['<h2>At other times</h2>', _table(
            ('setting', *(f'RMS m at {frame * study.frame_dt:.3g} s'
                          for frame in study.truth.frames), ''),
            [([name_of(row.setting), *(_short(value, '.1e') for value in row.errors.rms_m), ''],
              'front' if row.pareto else '') for row in study.rows])]
    parts += ['<h2>The scene</h2>',
              f'<pre>{escape(yaml.safe_dump(study.scene.raw, sort_keys=False))}</pre>',
              '</body></html>']
    file.write_text('\n'.join(parts), encoding='utf-8')
    return file


def legend(study: Study) -> str:
    """Return an explanation of the columns."""
    mean = f'mean from {study.settled_s:.3g} s on'
    frames = study.truth.frames
    at = f'at {frames[-1] * study.frame_dt:.3g} s' if len(frames) else 'at no time'
    strain_and_energy = ('strain (root mean square over the edges) and energy (of the largest '
                         'kinetic energy)')
    text = 'Times are CPU times per frame, on one core. '
    if study.by == SHAPE:
        text += (f'Heights (of the particles, lowest first, root mean square), '
                 f'{strain_and_energy} are errors of the {mean}; positions are compared {at}. ')
    else:
        text += (f'Errors of positions, {strain_and_energy} are those {at}; heights (of the '
                 f'particles, lowest first) those of the {mean}. ')
    return text + 'The residual is that of C + α f, root mean square over the edges.'


def _table(heads: Sequence[str], rows: Sequence[tuple[Sequence[str], str]]) -> str:
    lines = ['<table>', '<tr>' + ''.join(f'<th>{escape(head)}</th>' for head in heads) + '</tr>']
    lines += [f'<tr class="{kind}">' + ''.join(f'<td>{escape(cell)}</td>' for cell in row)
              + '</tr>' for row, kind in rows]
    return '\n'.join([*lines, '</table>'])
