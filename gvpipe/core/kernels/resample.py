"""Loops over whole level-set volumes: energy, and halving and doubling of the resolution.

The layout of the arrays is that of :mod:`gvpipe.core.kernels.levelset`.
"""

import numpy as np

from gvpipe.core.kernels.jit import kernel
from gvpipe.core.kernels.levelset import Scale, Volume


@kernel
def _spline(t: np.float32) -> tuple[np.float32, np.float32]:
    """Quadratic B-spline and its integral at -1.5 < t < 1.5."""
    size, reach = abs(t), np.float32(1.5)
    if size <= np.float32(0.5):
        square = t * t
        step = np.float32(0.5) + t * (np.float32(0.75) - square / np.float32(3))
        return np.float32(0.75) - square, step
    left = reach - size
    tail = left * left * left / np.float32(6)
    return np.float32(0.5) * left * left, np.float32(1) - tail if t > 0 else tail


@kernel
def energy_slab(
    u: Volume, f: Volume, g: Volume, inv: Scale, pitch: np.float32, start: int, stop: int
) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Volume and area sums of each x slice, per voxel.

    Parameters
    ----------
    u, f, g : (nx, ny, nz + 2) float32
        Padded level-set function and weights.
    inv : 3 float32
        One over the spacing; 0 along z counts the length of curves in layers.
    pitch : float32
        Finest spacing: the smoothed delta is the quadratic B-spline of this spacing, whose shifts
        sum to one, so that a plane's energy does not depend on where it cuts the grid.

    Returns
    -------
    sums : (stop - start, 2) float64
        Sum of ``f H(u)`` and of ``g delta(u) |grad u|`` over each slice.
    """
    nx, ny, depth = u.shape
    ix, iy, iz = inv
    sums = np.zeros((stop - start, 2))
    half, reach = np.float32(0.5), np.float32(1.5)
    for i in range(start, stop):
        im, ip = max(i - 1, 0), min(i + 1, nx - 1)
        volume = area = 0.0
        for j in range(ny):
            row, fr, gr = u[i, j], f[i, j], g[i, j]
            xm, xp = u[im, j], u[ip, j]
            ym, yp = u[i, max(j - 1, 0)], u[i, min(j + 1, ny - 1)]
            for k in range(1, depth - 1):
                t = row[k] / pitch
                if t <= -reach:
                    continue
                if t >= reach:
                    volume += fr[k]
                    continue
                ux, uy = (xp[k] - xm[k]) * half * ix, (yp[k] - ym[k]) * half * iy
                uz = (row[k + 1] - row[k - 1]) * half * iz
                delta, step = _spline(t)
                volume += fr[k] * step
                area += gr[k] * delta / pitch * np.sqrt(ux * ux + uy * uy + uz * uz)
        sums[i - start, 0], sums[i - start, 1] = volume, area
    return sums


@kernel
def halve(a: Volume) -> Volume:
    """Average blocks of 2 x 2 x 2 voxels; an odd last voxel is counted twice (padded arrays)."""
    nx, ny, nz = a.shape[0], a.shape[1], a.shape[2] - 2
    mx, my, mz = (nx + 1) // 2, (ny + 1) // 2, (nz + 1) // 2
    out = np.empty((mx, my, mz + 2), np.float32)
    total = np.empty(nz + 2, np.float32)
    for i in range(mx):
        i0, i1 = 2 * i, min(2 * i + 1, nx - 1)
        for j in range(my):
            j0, j1 = 2 * j, min(2 * j + 1, ny - 1)
            p, q, r, s = a[i0, j0], a[i0, j1], a[i1, j0], a[i1, j1]
            for k in range(nz + 2):
                total[k] = p[k] + q[k] + r[k] + s[k]
            row = out[i, j]
            for k in range(mz):
                # an odd last voxel meets its own copy in the padding
                row[k + 1] = np.float32(0.125) * (total[2 * k + 1] + total[2 * k + 2])
            row[0], row[mz + 1] = row[1], row[mz]
    return out


@kernel
def double(a: Volume, out: Volume) -> None:
    """Interpolate trilinearly to twice the resolution; inverse of :func:`halve` (padded arrays).

    Parameters
    ----------
    a : (mx, my, mz + 2) float32
    out : (nx, ny, nz + 2) float32
        Written; nx is 2 mx or 2 mx - 1, likewise ny and nz.
    """
    near, far = np.float32(0.75), np.float32(0.25)
    mx, my, mz = a.shape[0], a.shape[1], a.shape[2] - 2
    nx, ny, nz = out.shape[0], out.shape[1], out.shape[2] - 2
    mixed = np.empty(mz + 2, np.float32)
    for i in range(nx):
        i0 = i // 2
        i1 = min(i0 + 1, mx - 1) if i % 2 else max(i0 - 1, 0)
        for j in range(ny):
            j0 = j // 2
            j1 = min(j0 + 1, my - 1) if j % 2 else max(j0 - 1, 0)
            p, q, r, s = a[i0, j0], a[i0, j1], a[i1, j0], a[i1, j1]
            for k in range(mz + 2):
                mixed[k] = near * (near * p[k] + far * q[k]) + far * (near * r[k] + far * s[k])
            row = out[i, j]
            for k in range(nz // 2):
                row[2 * k + 1] = near * mixed[k + 1] + far * mixed[k]
                row[2 * k + 2] = near * mixed[k + 1] + far * mixed[k + 2]
            if nz % 2:
                row[nz] = near * mixed[mz] + far * mixed[mz - 1]
            row[0], row[nz + 1] = row[1], row[nz]


@kernel
def nucleate(
    u: Volume, f: Volume, g: Volume, start: Volume, volume: np.float32, area: np.float32
) -> Volume:
    """Add cubes of 3 x 3 x 3 voxels that lower the energy each on its own.

    Parameters
    ----------
    u, f, g : (nx, ny, nz + 2) float32
        Padded level-set function and weights.
    start : (nx, ny, nz + 2) float32
        Cubes are centred only where this is positive and u is not.
    volume, area : float32
        Volume of a voxel, and a 27th of the area of a cube.

    Returns
    -------
    seeded : (nx, ny, nz + 2) float32
        u, and the size of its largest value inside the new cubes.
    """
    nx, ny, depth = u.shape
    zero = np.float32(0)
    seeded, inside = u.copy(), max(u.max(), -u.min())
    for i in range(1, nx - 1):
        for j in range(1, ny - 1):
            middle, here, allowed = f[i, j], u[i, j], start[i, j]
            for k in range(1, depth - 1):
                if middle[k] >= zero or here[k] > zero or allowed[k] <= zero:
                    continue
                change = zero
                for a in range(i - 1, i + 2):
                    for b in range(j - 1, j + 2):
                        for c in range(k - 1, k + 2):
                            change += f[a, b, c] * volume + g[a, b, c] * area
                if change < zero:
                    seeded[i - 1 : i + 2, j - 1 : j + 2, k - 1 : k + 2] = inside
    return seeded
