"""Draw residuals over values."""

from collections.abc import Mapping
from pathlib import Path

from xpbd_ros.fit.solve import Fit
from xpbd_ros.study.chart import COLOURS, INK, MUTED, page, save


def draw(found: Fit, file: Path, units: Mapping[str, str]) -> Path:
    """Draw the RMS residual over each value, with interval and unit; return the path."""
    figure, axes = page(3.6 * len(found.values), 3.2, columns=len(found.values))
    for axis, (key, value) in zip(axes[0], found.values.items()):
        axis.plot(*zip(*((v, 1e3 * rms) for v, rms in value.profile)), '-o', color=COLOURS[0],
                  markersize=3, linewidth=1.2)
        if value.determined:
            axis.axvspan(value.low, value.high, color=COLOURS[1], alpha=0.35, linewidth=0)
            text = f'{value.value:.4g}, 95 %: {value.low:.4g} to {value.high:.4g}'
        else:
            text = 'not determined'
        axis.axvline(value.value, color=INK if value.determined else MUTED, linewidth=0.8)
        if value.profile[-1][0] > 10.0 * value.profile[0][0]:    # or labels would overlap
            axis.set_xscale('log')
        axis.set_ylim(bottom=0.0)
        axis.set_title(f'{key}\n{text}', fontsize=7, loc='left', color=INK)
        axis.set_xlabel(f'value [{units[key]}]' if units[key] else 'value', fontsize=8)
        axis.grid(alpha=0.25)
    axes[0, 0].set_ylabel('RMS residual [mm]', fontsize=8)
    return save(figure, file)
