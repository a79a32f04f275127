"""Particles that seams join: they lie on one another, and pairs of them are no contacts."""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


def kin(slots: np.ndarray, seam) -> np.ndarray | None:
    """
    Return a number for each particle in natural order, equal for those sewn together.

    Parameters
    ----------
    slots : slot of each particle, shape (particles,)
    seam : the effect ``seam`` as built; None in a scene without

    """
    if seam is None or seam.data is None:
        return None
    number = np.zeros(slots.max() + 1, np.int64)
    number[slots] = np.arange(len(slots))
    pairs = number[seam.data.first], number[seam.data.second]
    joined = coo_array((np.ones(len(pairs[0])), pairs), (len(slots), len(slots)))
    return connected_components(joined, directed=False)[1].astype(np.int64)
