"""A chart of the deviation of a run from a recorded one against time."""

from collections.abc import Sequence
from pathlib import Path

from xpbd_ros.study import chart

FLOOR = 1e-7
"""deviations below this are drawn here [m]: clouds are float32"""


def draw(file: Path, track: Sequence, frame_dt: float, title: str) -> Path:
    """
    Draw the largest and the RMS deviation [mm] of the particles of each frame.

    Parameters
    ----------
    file : PNG file to write
    track : ``Deviation`` of each frame
    frame_dt : length of a frame [s]
    title : heading

    """
    figure, ((axis,),) = chart.page(8.0, 4.0)
    times = [frame_dt * each.frame for each in track]
    if not any(each.largest > FLOOR for each in track):    # on one level: no range of its own
        axis.set_ylim(1e2 * FLOOR, 1e4 * FLOOR)
    for name, colour in (('largest', chart.COLOURS[0]), ('rms', chart.COLOURS[1])):
        label = 'RMS' if name == 'rms' else name
        axis.semilogy(times, [1e3 * max(getattr(each, name), FLOOR) for each in track],
                      color=colour, label=label, linewidth=1.5)
    same = not any(each.largest for each in track)
    axis.set_title(f'{title}: bit-identical' if same else title, fontsize=9, color=chart.INK,
                   loc='left')
    axis.set_xlabel('time [s]', fontsize=8, color=chart.INK)
    axis.set_ylabel('deviation [mm]', fontsize=8, color=chart.INK)
    axis.legend(fontsize=8, frameon=False)
    return chart.save(figure, file)
