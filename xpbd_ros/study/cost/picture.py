"""What a substep is spent on, as bars."""

from pathlib import Path

from xpbd_ros.study.chart import COLOURS, MUTED, page, save
from xpbd_ros.study.cost.measure import Cost


def draw(found: Cost, title: str, file: Path | str) -> Path:
    """Write the picture and return where."""
    rows = [row for row in found.effects + found.others if row.present][::-1]
    figure, axes = page(7.0, 0.8 + 0.32 * len(rows))
    axis = axes[0, 0]
    colours = [COLOURS[0] if row in found.effects else MUTED for row in rows]
    axis.barh([row.name for row in rows], [row.us_per_substep for row in rows], color=colours,
              xerr=[row.us_spread for row in rows], ecolor=MUTED)
    for k, row in enumerate(rows):
        axis.annotate(f'{row.us_per_substep:.1f} µs, {100 * row.share:.0f} %',
                      (max(row.us_per_substep + row.us_spread, 0.0), k), (4, 0), fontsize=8,
                      textcoords='offset points', va='center')
    axis.margins(x=0.25)
    axis.set_xlabel('µs per substep', fontsize=8)
    axis.set_title(title, fontsize=10, loc='left')
    return save(figure, file)
