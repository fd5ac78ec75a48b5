"""A map that grows picture by picture, each placed where most of its links want it."""

import heapq

import numpy as np

from gvpipe.core.kernels.jit import kernel
from gvpipe.core.types import Float, Index


@kernel
def _carry(pose: Float, centre_here: Float, centre_there: Float, turn: float) -> Float:
    """Pose at the other end of a link, whose heading differs by `turn`."""
    heading = pose[2] + turn
    c, s, d, t = np.cos(pose[2]), np.sin(pose[2]), np.cos(heading), np.sin(heading)
    out = np.empty(3)
    out[0] = pose[0] + c * centre_here[0] - s * centre_here[1]
    out[0] -= d * centre_there[0] - t * centre_there[1]
    out[1] = pose[1] + s * centre_here[0] + c * centre_here[1]
    out[1] -= t * centre_there[0] + d * centre_there[1]
    out[2] = (heading + np.pi) % (2.0 * np.pi) - np.pi
    return out


@kernel
def _apart(
    a: Float, b: Float, centre_i: Float, centre_j: Float, turn: float, radius: float
) -> float:
    """Squared disagreement (metres) of a link between poses a of image i and b of image j."""
    c, s, d, t = np.cos(a[2]), np.sin(a[2]), np.cos(b[2]), np.sin(b[2])
    x = a[0] + c * centre_i[0] - s * centre_i[1] - b[0] - d * centre_j[0] + t * centre_j[1]
    y = a[1] + s * centre_i[0] + c * centre_i[1] - b[1] - t * centre_j[0] - d * centre_j[1]
    w = ((a[2] - b[2] - turn + np.pi) % (2.0 * np.pi) - np.pi) * radius
    return float(x * x + y * y + w * w)


@kernel
def grow_map(
    i: Index, j: Index, centre_i: Float, centre_j: Float, turn: Float, radius: Float,
    allowed: Float, trust: Float, first: Index, touching: Index,
) -> tuple[Float, Index]:  # fmt: skip
    """Place the images one by one, each where most of its links to placed images want it.

    Parameters
    ----------
    i, j, centre_i, centre_j, turn, radius, trust
        Links, as in `Placements`.
    allowed : (E,) float64
        Disagreement up to which a link supports a pose, metres.
    first, touching : (N + 1,) int64, (2 E,) int64
        Links ``touching[first[n]:first[n + 1]]`` of image n.

    Returns
    -------
    planar : (N, 3) float64
        x, y (metres) and heading (radians), each connected part in the frame of its first image.
    component : (N,) int64
        Number of each image's connected part.
    """
    count = len(first) - 1
    planar, component = np.zeros((count, 3)), np.full(count, -1, dtype=np.int64)
    carried, best = np.zeros((len(i), 3)), np.zeros((count, 3))
    wanted, votes = np.empty(len(touching), dtype=np.int64), np.zeros(count, dtype=np.int64)
    part = 0
    for root in range(count):
        if component[root] >= 0:
            continue
        queue = [(0.0, root, 0)]
        while len(queue):
            _, image, seen = heapq.heappop(queue)
            if component[image] >= 0 or seen != votes[image]:
                continue
            planar[image], component[image] = best[image], part
            for k in touching[first[image] : first[image + 1]]:
                forward = i[k] == image
                other = j[k] if forward else i[k]
                if component[other] >= 0:
                    continue
                if forward:
                    carried[k] = _carry(planar[image], centre_i[k], centre_j[k], -turn[k])
                else:
                    carried[k] = _carry(planar[image], centre_j[k], centre_i[k], turn[k])
                wanted[first[other] + votes[other]] = k
                votes[other] += 1
                top = -1.0
                for n in wanted[first[other] : first[other] + votes[other]]:
                    support = 0.0
                    for m in wanted[first[other] : first[other] + votes[other]]:
                        if i[m] == other:
                            a, b = carried[n], planar[j[m]]
                        else:
                            a, b = planar[i[m]], carried[n]
                        apart = _apart(a, b, centre_i[m], centre_j[m], turn[m], radius[m])
                        if apart <= allowed[m] ** 2:
                            support += trust[m]
                    if support > top:
                        top = support
                        best[other] = carried[n]
                heapq.heappush(queue, (-top, other, votes[other]))
        part += 1
    return planar, component
