"""What is drawn over a panel."""

from matplotlib.figure import Figure
import numpy as np

from support.pictures import ABOVE, SQUARE
from xpbd_ros.study.picture import fit, Path
from xpbd_ros.study.picture.marks import draw_path


def test_a_path_is_faint_where_hidden_and_dotted_ahead():
    view = fit(SQUARE, ABOVE, 100, 100)
    depth = np.full((100, 100), np.inf)
    depth[:, :50] = 0.1    # something near covers the left half
    line = np.array([[-0.9, 0.05, 0], [0.9, 0.05, 0]])

    def drawn(present):
        axes = Figure().add_axes((0, 0, 1, 1))
        draw_path(axes, Path(line, present=present), view, depth, 0.5)
        collection, = axes.collections
        middle = np.array([segment[:, 0].mean() for segment in collection.get_segments()])
        return middle, collection.get_colors()[:, 3]

    middle, opacity = drawn(-1)
    assert (opacity[middle < 45] < 0.5).all() and (opacity[middle > 55] == 1).all()
    ahead, _ = drawn(0)
    assert len(ahead) < 0.8 * len(middle)
