"""Shapes of the constraints that bend grids: three particles in a line, and cells."""

from xpbd_ros.sim.constraints.grid_batches import Shape


def curvature_shapes(rows: int, columns: int) -> list[Shape]:
    """Return the shapes of three in a row, in interior and boundary rows, and in a column."""
    across = ((0, 0), (0, 1), (0, 2))
    inside, rim = (range(1, rows - 1), range(0, rows, rows - 1)) if rows > 1 else (
        range(1), range(0))
    return [Shape(across, inside, range(columns - 2), 0),
            Shape(across, rim, range(columns - 2), 0),
            Shape(((0, 0), (1, 0), (2, 0)), range(rows - 2), range(columns), 1)]


def twist_shapes(rows: int, columns: int) -> list[Shape]:
    """Return the shape of the four particles of a cell."""
    return [Shape(((0, 0), (0, 1), (1, 0), (1, 1)), range(rows - 1), range(columns - 1), 0)]
