"""Loops of the voxel carvers: silhouettes by octree, colours by plane sweeps.

Pixels are looked up at the nearest integer. ``pixel_from_index`` takes homogeneous voxel indices
to homogeneous pixels whose third component is the depth.
"""

import numpy as np

from gvpipe.core.kernels.jit import kernel

Matrices = np.ndarray[tuple[int, int, int], np.dtype[np.float64]]
Counts = np.ndarray[tuple[int, int, int], np.dtype[np.int32]]
Occupancy = np.ndarray[tuple[int, int, int], np.dtype[np.bool_]]

EMPTY, FULL, MIXED, UNSEEN = 0, 1, 2, 3
"""What views say of a block: all background, all obstacle, some of both, nothing."""


@kernel
def _judge(
    m: np.ndarray[tuple[int, int], np.dtype[np.float64]],
    background: np.ndarray[tuple[int, int], np.dtype[np.int32]],
    known: np.ndarray[tuple[int, int], np.dtype[np.int32]],
    low: np.ndarray[tuple[int], np.dtype[np.int64]],
    high: np.ndarray[tuple[int], np.dtype[np.int64]],
) -> int:
    """Judge by one view all voxels from `low` to `high`, both included."""
    height, width = known.shape[0] - 1, known.shape[1] - 1
    left = top = np.inf
    right = bottom = -np.inf
    behind = 0
    for corner in range(8):
        x = high[0] if corner & 1 else low[0]
        y = high[1] if corner & 2 else low[1]
        z = high[2] if corner & 4 else low[2]
        w = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
        if w <= 0.0:
            behind += 1
            continue
        u = (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) / w
        v = (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) / w
        left, right, top, bottom = min(left, u), max(right, u), min(top, v), max(bottom, v)
    if behind == 8:
        return UNSEEN
    if behind:
        return MIXED
    u0, v0 = max(np.rint(left), 0.0), max(np.rint(top), 0.0)
    u1, v1 = min(np.rint(right), width - 1.0), min(np.rint(bottom), height - 1.0)
    if u0 > u1 or v0 > v1:
        return UNSEEN
    a, b, c, d = int(v0), int(v1) + 1, int(u0), int(u1) + 1
    whole = (np.rint(right) - np.rint(left) + 1.0) * (np.rint(bottom) - np.rint(top) + 1.0)
    seen = known[b, d] - known[a, d] - known[b, c] + known[a, c]
    if seen == 0:
        return UNSEEN
    empty = background[b, d] - background[a, d] - background[b, c] + background[a, c]
    if empty == whole:
        return EMPTY
    return FULL if empty == 0 and seen == whole else MIXED


@kernel
def carve_silhouettes(
    pixel_from_index: Matrices, background: Counts, known: Counts, least: int, block: int,
    shape: tuple[int, int, int],
) -> Occupancy:  # fmt: skip
    """Keep the voxels that no view sees as background, from large blocks down to single voxels.

    Parameters
    ----------
    pixel_from_index : (V, 3, 4) float64
    background, known : (V, H + 1, W + 1) int32
        Summed-area tables of the pixels that show background and of those that show anything.
    least : int
        Voxels that fewer views see are empty.
    block : int
        Side of the largest blocks, voxels, a power of two.
    shape : (int, int, int)
        Grid.

    Returns
    -------
    occupied : (nx, ny, nz) bool
        The same as if every voxel had been tested on its own.
    """
    occupied = np.zeros(shape, np.bool_)
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    stack = np.empty((8 * 32, 4), np.int64)
    for x in range(0, shape[0], block):
        for y in range(0, shape[1], block):
            for z in range(0, shape[2], block):
                stack[0, 0], stack[0, 1], stack[0, 2], stack[0, 3] = x, y, z, block
                top = 1
                while top > 0:
                    top -= 1
                    size = stack[top, 3]
                    for a in range(3):
                        low[a] = stack[top, a]
                        high[a] = min(low[a] + size, shape[a]) - 1
                    verdict = _verdict(pixel_from_index, background, known, least, low, high)
                    if verdict == FULL:
                        occupied[
                            low[0] : high[0] + 1, low[1] : high[1] + 1, low[2] : high[2] + 1
                        ] = True
                    elif verdict == MIXED and size > 1:
                        half = size // 2
                        for part in range(8):
                            i = low[0] + half * (part & 1)
                            j = low[1] + half * (part >> 1 & 1)
                            k = low[2] + half * (part >> 2 & 1)
                            if i < shape[0] and j < shape[1] and k < shape[2]:
                                stack[top, 0], stack[top, 1] = i, j
                                stack[top, 2], stack[top, 3] = k, half
                                top += 1
    return occupied


@kernel
def _verdict(
    pixel_from_index: Matrices, background: Counts, known: Counts, least: int,
    low: np.ndarray[tuple[int], np.dtype[np.int64]],
    high: np.ndarray[tuple[int], np.dtype[np.int64]],
) -> int:  # fmt: skip
    """Judge a block by all views together."""
    full = mixed = 0
    for view in range(len(pixel_from_index)):
        says = _judge(pixel_from_index[view], background[view], known[view], low, high)
        if says == EMPTY:
            return EMPTY
        full += says == FULL
        mixed += says == MIXED
    if full + mixed < least:
        return EMPTY
    return FULL if mixed == 0 else MIXED


@kernel
def _window(
    m: np.ndarray[tuple[int, int], np.dtype[np.float64]],
    index: tuple[int, int, int],
    height: int,
    width: int,
) -> tuple[int, int, int, int]:
    """Pixels ``[v0:v1, u0:u1]`` that the cube of a voxel covers; empty if not all in the image."""
    left = top = np.inf
    right = bottom = -np.inf
    for corner in range(8):
        x = index[0] + (0.5 if corner & 1 else -0.5)
        y = index[1] + (0.5 if corner & 2 else -0.5)
        z = index[2] + (0.5 if corner & 4 else -0.5)
        w = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
        if w <= 0.0:
            return 0, 0, 0, 0
        u = (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) / w
        v = (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) / w
        left, right, top, bottom = min(left, u), max(right, u), min(top, v), max(bottom, v)
    if left < 0 or top < 0 or right > width - 1 or bottom > height - 1:
        return 0, 0, 0, 0
    return int(np.rint(top)), int(np.rint(bottom)) + 1, int(np.rint(left)), int(np.rint(right)) + 1


@kernel
def _spread(
    index: tuple[int, int, int], ahead: np.ndarray[tuple[int], np.dtype[np.bool_]],
    pixel_from_index: Matrices, images: np.ndarray, usable: np.ndarray, taken: np.ndarray,
    mean: np.ndarray,
) -> float:  # fmt: skip
    """Compute how far the views' mean colours of a voxel deviate; 0 if fewer than two see it."""
    height, width = usable.shape[1], usable.shape[2]
    count = 0
    square = 0.0
    mean[:] = 0.0
    for view in range(len(images)):
        if not ahead[view]:
            continue
        a, b, c, d = _window(pixel_from_index[view], index, height, width)
        n = 0
        red = green = blue = 0.0
        for v in range(a, b):
            for u in range(c, d):
                if usable[view, v, u] and not taken[view, v, u]:
                    n += 1
                    red += images[view, v, u, 0]
                    green += images[view, v, u, 1]
                    blue += images[view, v, u, 2]
        # a view in which most of the voxel is hidden or cut off shows something else
        if n == 0 or 2 * n < (b - a) * (d - c):
            continue
        red, green, blue = red / n, green / n, blue / n
        mean[0] += red
        mean[1] += green
        mean[2] += blue
        square += red * red + green * green + blue * blue
        count += 1
    if count < 2:
        return 0.0
    total = mean[0] * mean[0] + mean[1] * mean[1] + mean[2] * mean[2]
    return np.sqrt(max(square - total / count, 0.0) / (count - 1))


@kernel
def _buried(occupied: Occupancy, index: tuple[int, int, int]) -> bool:
    """Whether a voxel is inside the grid and has six occupied neighbours: no view can see it."""
    x, y, z = index
    if min(x, min(y, z)) == 0:
        return False
    if x + 1 == occupied.shape[0] or y + 1 == occupied.shape[1] or z + 1 == occupied.shape[2]:
        return False
    return (
        occupied[x - 1, y, z]
        and occupied[x + 1, y, z]
        and occupied[x, y - 1, z]
        and occupied[x, y + 1, z]
        and occupied[x, y, z - 1]
        and occupied[x, y, z + 1]
    )


@kernel
def sweep_colours(
    occupied: Occupancy, axis: int, forward: bool, cameras: np.ndarray, pixel_from_index: Matrices,
    images: np.ndarray, usable: np.ndarray, most: float,
) -> int:  # fmt: skip
    """Carve what has different colours in the views that a sweeping plane has passed.

    Parameters
    ----------
    occupied : (nx, ny, nz) bool
        Changed in place.
    axis, forward : int, bool
        The plane's normal and whether it moves towards larger indices.
    cameras : (V, 3) float64
        Camera centres, voxel indices.
    pixel_from_index : (V, 3, 4) float64
    images : (V, H, W, 3) uint8
    usable : (V, H, W) bool
        Pixels that show an obstacle.
    most : float
        Voxels whose colours deviate more are carved, grey levels.

    Returns
    -------
    carved : int
        How many voxels were removed.

    Notes
    -----
    Layers are visited away from the cameras, so whatever hides a voxel was decided before it; the
    pixels of a layer's remaining voxels are taken when the whole layer is done.
    """
    taken = np.zeros(usable.shape, np.bool_)
    ahead = np.empty(len(cameras), np.bool_)
    mean = np.empty(3)
    carved = 0
    depth = occupied.shape[axis]
    rows, columns = occupied.shape[(axis + 1) % 3], occupied.shape[(axis + 2) % 3]
    for step in range(depth):
        layer = step if forward else depth - 1 - step
        for view in range(len(cameras)):
            passed = layer - cameras[view, axis]
            ahead[view] = passed > 1.0 if forward else passed < -1.0
        for taking in range(2):
            for p in range(rows):
                for q in range(columns):
                    if axis == 0:
                        index = (layer, p, q)
                    elif axis == 1:
                        index = (q, layer, p)
                    else:
                        index = (p, q, layer)
                    if not occupied[index] or _buried(occupied, index):
                        continue
                    if taking:
                        _take(index, ahead, pixel_from_index, taken)
                    elif (
                        _spread(index, ahead, pixel_from_index, images, usable, taken, mean) > most
                    ):
                        occupied[index] = False
                        carved += 1
    return carved


@kernel
def _take(
    index: tuple[int, int, int], ahead: np.ndarray[tuple[int], np.dtype[np.bool_]],
    pixel_from_index: Matrices, taken: np.ndarray,
) -> None:  # fmt: skip
    """Mark the pixels of a voxel as explained."""
    for view in range(len(taken)):
        if ahead[view]:
            a, b, c, d = _window(pixel_from_index[view], index, taken.shape[1], taken.shape[2])
            taken[view, a:b, c:d] = True
