"""Charts in one style, drawn by matplotlib without a display."""

from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

INK, MUTED = '#1f2328', '#6b737c'
COLOURS = ('#0072b2', '#e69f00', '#009e73', '#d55e00', '#cc79a7', '#8a7a3c', '#56b4e9', '#7a5aa6')
"""the first five stay apart for readers who do not tell red from green"""


def page(width: float, height: float, *, rows: int = 1, columns: int = 1):
    """Return a figure [inches] and its axes, shape (rows, columns)."""
    figure = Figure(figsize=(width, height), dpi=150, facecolor='white', layout='constrained')
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False)
    for axis in axes.flat:
        axis.spines[['top', 'right']].set_visible(False)
        axis.tick_params(which='both', colors=INK, labelsize=7)
    return figure, axes


def save(figure, file: Path | str) -> Path:
    """Write a figure to a PNG file, and return its path."""
    figure.savefig(file, format='png')
    return Path(file)
