"""The step of the level-set evolution, and the layout of arrays that all kernels of it share.

Arrays are float32 and indexed [x, y, z]. Those named *padded* have one more voxel at either end of
z that repeats its neighbour; along x and y borders are repeated by clamping. Each column (i, j) is
worked on from ``spans[i, j, 0]`` to ``spans[i, j, 1]`` (padded indices): an unbroken row that the
compiler can vectorise. Kernels read one buffer and write another, so slabs of x can run in any
order, on any number of threads, with identical results.

Rows are given as places in the flattened arrays, which are unsigned so that no index can count
from the end: making a view of each row costs more than the work on a short one.
"""

import numpy as np

from gvpipe.core.kernels.jit import kernel

Scale = tuple[np.float32, np.float32, np.float32]
Row = np.ndarray[tuple[int], np.dtype[np.float32]]
Flat = np.ndarray[tuple[int], np.dtype[np.float32]]
Volume = np.ndarray[tuple[int, int, int], np.dtype[np.float32]]
Spans = np.ndarray[tuple[int, int, int], np.dtype[np.int32]]
Place = np.uintp
Cross = tuple[np.uintp, np.uintp, np.uintp, np.uintp, np.uintp]
"""Places of a row and of its neighbours at x - 1, x + 1, y - 1 and y + 1."""
Corners = tuple[np.uintp, np.uintp, np.uintp, np.uintp]
"""Places of the rows at (x - 1, y - 1), (x - 1, y + 1), (x + 1, y - 1) and (x + 1, y + 1)."""


@kernel
def place(i: int, j: int, k: int, ny: int, depth: int) -> Place:
    """Where voxel (i, j, k) is in a flattened array."""
    return np.uintp((i * ny + j) * depth + k)


@kernel
def cross(i: int, j: int, k: int, nx: int, ny: int, depth: int) -> Cross:
    """Where a row that begins at voxel (i, j, k) and its four neighbours are; borders repeat."""
    return (
        place(i, j, k, ny, depth),
        place(max(i - 1, 0), j, k, ny, depth),
        place(min(i + 1, nx - 1), j, k, ny, depth),
        place(i, max(j - 1, 0), k, ny, depth),
        place(i, min(j + 1, ny - 1), k, ny, depth),
    )


@kernel
def _corners(i: int, j: int, k: int, nx: int, ny: int, depth: int) -> Corners:
    """Where the four rows diagonal to that of voxel (i, j, k) are; borders repeat."""
    west, east = max(i - 1, 0), min(i + 1, nx - 1)
    south, north = max(j - 1, 0), min(j + 1, ny - 1)
    return (
        place(west, south, k, ny, depth),
        place(west, north, k, ny, depth),
        place(east, south, k, ny, depth),
        place(east, north, k, ny, depth),
    )


@kernel
def _transport(
    out: Row, rate: Row, u: Flat, f: Flat, g: Flat, rows: Cross, n: Place, inv: Scale
) -> None:
    """Volume term and advection of a row, ``grad g . grad u - f |grad u|``, and the CFL rate."""
    zero, one, half, next_ = np.float32(0), np.float32(1), np.float32(0.5), np.uintp(1)
    c, xm, xp, ym, yp = rows
    ix, iy, iz = inv
    diffusion = np.float32(2) * (ix * ix + iy * iy + iz * iz)
    for k in range(n):
        here, force = u[c + k], f[c + k]
        ax, bx = (here - u[xm + k]) * ix, (u[xp + k] - here) * ix
        ay, by = (here - u[ym + k]) * iy, (u[yp + k] - here) * iy
        az, bz = (here - u[c + k - next_]) * iz, (u[c + k + next_] - here) * iz
        # Godunov: for f < 0 the characteristics turn round
        s = one if force >= zero else -one
        px, qx = max(s * ax, zero), min(s * bx, zero)
        py, qy = max(s * ay, zero), min(s * by, zero)
        pz, qz = max(s * az, zero), min(s * bz, zero)
        slope = np.sqrt(max(px * px, qx * qx) + max(py * py, qy * qy) + max(pz * pz, qz * qz))
        # upwind advection with velocity -grad g
        gx = (g[xp + k] - g[xm + k]) * half * ix
        gy = (g[yp + k] - g[ym + k]) * half * iy
        gz = (g[c + k + next_] - g[c + k - next_]) * half * iz
        flow = max(gx, zero) * bx + min(gx, zero) * ax
        flow += max(gy, zero) * by + min(gy, zero) * ay
        flow += max(gz, zero) * bz + min(gz, zero) * az
        out[k] = flow - force * slope
        rate[k] = (
            abs(force) * (ix + iy + iz)
            + (abs(gx) * ix + abs(gy) * iy + abs(gz) * iz)
            + g[c + k] * diffusion
        )


@kernel
def _curvature(
    out: Row, u: Flat, rows: Cross, corners: Corners, n: Place, inv: Scale, limit: np.float32
) -> None:
    """Curvature times slope of a row, ``div(grad u / |grad u|) |grad u|``, central, clipped."""
    two, half, quarter = np.float32(2), np.float32(0.5), np.float32(0.25)
    tiny, next_ = np.float32(1e-6), np.uintp(1)
    c, xm, xp, ym, yp = rows
    mm, mp, pm, pp = corners
    ix, iy, iz = inv
    for k in range(n):
        above, below = k + next_, k - next_
        twice = two * u[c + k]
        ux = (u[xp + k] - u[xm + k]) * half * ix
        uy = (u[yp + k] - u[ym + k]) * half * iy
        uz = (u[c + above] - u[c + below]) * half * iz
        uxx = (u[xp + k] - twice + u[xm + k]) * ix * ix
        uyy = (u[yp + k] - twice + u[ym + k]) * iy * iy
        uzz = (u[c + above] - twice + u[c + below]) * iz * iz
        uxy = (u[pp + k] - u[pm + k] - u[mp + k] + u[mm + k]) * quarter * ix * iy
        uxz = (u[xp + above] - u[xp + below] - u[xm + above] + u[xm + below]) * quarter * ix * iz
        uyz = (u[yp + above] - u[yp + below] - u[ym + above] + u[ym + below]) * quarter * iy * iz
        x2, y2, z2 = ux * ux, uy * uy, uz * uz
        square = x2 + y2 + z2
        bend = x2 * (uyy + uzz) + y2 * (uxx + uzz) + z2 * (uxx + uyy)
        bend -= two * (ux * uy * uxy + ux * uz * uxz + uy * uz * uyz)
        bend /= square + tiny
        most = limit * np.sqrt(square)
        out[k] = min(max(bend, -most), most)


@kernel
def _apply(
    out: Flat, u: Flat, g: Flat, c: Place, n: Place, change: Row, rate: Row, bend: Row,
    cfl: np.float32, floor: np.float32,
) -> None:  # fmt: skip
    """Take each voxel's own time step."""
    for k in range(n):
        step = cfl / max(rate[k], floor)
        out[c + k] = u[c + k] + step * (change[k] + g[c + k] * bend[k])


@kernel
def evolve_slab(
    u: Volume, out: Volume, f: Volume, g: Volume, spans: Spans, inv: Scale,
    cfl: np.float32, limit: np.float32, floor: np.float32, start: int, stop: int,
) -> None:  # fmt: skip
    """One time step for columns with start <= i < stop: ``out = u + dt u_t``.

    Parameters
    ----------
    u, out : (nx, ny, nz + 2) float32
        Read and written, padded; they agree outside the spans.
    f, g : (nx, ny, nz + 2) float32
        Volume and area weights, padded.
    spans : (nx, ny, 2) int32
        First and last-plus-one padded index of each column's work.
    inv : 3 float32
        One over the spacing; 0 along z evolves every layer on its own.
    cfl, limit : float32
        Courant number; largest |curvature| (1/length).
    floor : float32
        Smallest rate (1/time) by which a time step is divided, where f and g vanish.

    Notes
    -----
    The time step is the largest stable one of each voxel: scaling a descent direction by a
    positive factor leaves it a descent direction with the same stationary surfaces.
    """
    nx, ny, depth = u.shape
    flat, written = u.reshape(u.size), out.reshape(u.size)
    volume, area = f.reshape(u.size), g.reshape(u.size)
    change, rate = np.empty(depth, np.float32), np.empty(depth, np.float32)
    bend = np.empty(depth, np.float32)
    for i in range(start, stop):
        for j in range(ny):
            a, b = spans[i, j, 0], spans[i, j, 1]
            if a >= b:
                continue
            n = np.uintp(b - a)
            rows = cross(i, j, a, nx, ny, depth)
            _transport(change, rate, flat, volume, area, rows, n, inv)
            _curvature(bend, flat, rows, _corners(i, j, a, nx, ny, depth), n, inv, limit)
            _apply(written, flat, area, rows[0], n, change, rate, bend, cfl, floor)
            out[i, j, 0], out[i, j, depth - 1] = out[i, j, 1], out[i, j, depth - 2]
