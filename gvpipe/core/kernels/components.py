"""What hangs together in a graph."""

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.kernels.jit import kernel

Index = NDArray[np.int64]


@kernel
def _root(above: Index, node: int) -> int:
    """Follow a node up; the way is halved for those that come after."""
    while above[node] != node:
        above[node] = above[above[node]]
        node = above[node]
    return node


@kernel
def connected(count: int, left: Index, right: Index) -> Index:
    """Label the components of a graph.

    Parameters
    ----------
    count : int
        Nodes.
    left, right : (E,) int64
        The two nodes of each edge.

    Returns
    -------
    label : (count,) int64
        From 0, in the order of the first node of each component.
    """
    above = np.arange(count)
    for k in range(len(left)):
        a, b = _root(above, left[k]), _root(above, right[k])
        above[max(a, b)] = min(a, b)  # what is above a node comes before it
    label = np.empty(count, np.int64)
    found = 0
    for node in range(count):
        if above[node] == node:
            label[node] = found
            found += 1
        else:
            label[node] = label[above[node]]
    return label
