"""Loops of the level-set engine: evolution, redistancing, energy, change of resolution.

Arrays are float32 and indexed [x, y, z]. Those named *padded* have one more voxel at either end of
z that repeats its neighbour; along x and y borders are repeated by clamping. Each column (i, j) is
worked on from ``spans[i, j, 0]`` to ``spans[i, j, 1]`` (padded indices): an unbroken row that the
compiler can vectorise. Kernels read one buffer and write another, so slabs of x can run in any
order, on any number of threads, with identical results.
"""

import numpy as np

from gvpipe.core.kernels.jit import kernel

Scale = tuple[np.float32, np.float32, np.float32]
Row = np.ndarray[tuple[int], np.dtype[np.float32]]
Volume = np.ndarray[tuple[int, int, int], np.dtype[np.float32]]
Spans = np.ndarray[tuple[int, int, int], np.dtype[np.int32]]


@kernel
def _transport(
    out: Row, rate: Row, c: Row, xm: Row, xp: Row, ym: Row, yp: Row, f: Row, g: Row,
    gxm: Row, gxp: Row, gym: Row, gyp: Row, inv: Scale,
) -> None:  # fmt: skip
    """Volume term and advection of a row, ``grad g . grad u - f |grad u|``, and the CFL rate."""
    zero, one, half = np.float32(0), np.float32(1), np.float32(0.5)
    ix, iy, iz = inv
    diffusion = np.float32(2) * (ix * ix + iy * iy + iz * iz)
    for k in range(out.size):
        u = c[k + 1]
        ax, bx = (u - xm[k + 1]) * ix, (xp[k + 1] - u) * ix
        ay, by = (u - ym[k + 1]) * iy, (yp[k + 1] - u) * iy
        az, bz = (u - c[k]) * iz, (c[k + 2] - u) * iz
        # Godunov: for f < 0 the characteristics turn round
        s = one if f[k + 1] >= zero else -one
        px, qx = max(s * ax, zero), min(s * bx, zero)
        py, qy = max(s * ay, zero), min(s * by, zero)
        pz, qz = max(s * az, zero), min(s * bz, zero)
        slope = np.sqrt(max(px * px, qx * qx) + max(py * py, qy * qy) + max(pz * pz, qz * qz))
        # upwind advection with velocity -grad g
        gx = (gxp[k + 1] - gxm[k + 1]) * half * ix
        gy = (gyp[k + 1] - gym[k + 1]) * half * iy
        gz = (g[k + 2] - g[k]) * half * iz
        flow = max(gx, zero) * bx + min(gx, zero) * ax
        flow += max(gy, zero) * by + min(gy, zero) * ay
        flow += max(gz, zero) * bz + min(gz, zero) * az
        out[k] = flow - f[k + 1] * slope
        rate[k] = (
            abs(f[k + 1]) * (ix + iy + iz)
            + (abs(gx) * ix + abs(gy) * iy + abs(gz) * iz)
            + g[k + 1] * diffusion
        )


@kernel
def _curvature(
    out: Row, c: Row, xm: Row, xp: Row, ym: Row, yp: Row, mm: Row, mp: Row, pm: Row, pp: Row,
    inv: Scale, limit: np.float32,
) -> None:  # fmt: skip
    """Curvature times slope of a row, ``div(grad u / |grad u|) |grad u|``, central, clipped."""
    two, half, quarter = np.float32(2), np.float32(0.5), np.float32(0.25)
    tiny = np.float32(1e-6)
    ix, iy, iz = inv
    for k in range(out.size):
        u = two * c[k + 1]
        ux = (xp[k + 1] - xm[k + 1]) * half * ix
        uy = (yp[k + 1] - ym[k + 1]) * half * iy
        uz = (c[k + 2] - c[k]) * half * iz
        uxx = (xp[k + 1] - u + xm[k + 1]) * ix * ix
        uyy = (yp[k + 1] - u + ym[k + 1]) * iy * iy
        uzz = (c[k + 2] - u + c[k]) * iz * iz
        uxy = (pp[k] - pm[k] - mp[k] + mm[k]) * quarter * ix * iy
        uxz = (xp[k + 2] - xp[k] - xm[k + 2] + xm[k]) * quarter * ix * iz
        uyz = (yp[k + 2] - yp[k] - ym[k + 2] + ym[k]) * quarter * iy * iz
        x2, y2, z2 = ux * ux, uy * uy, uz * uz
        square = x2 + y2 + z2
        bend = x2 * (uyy + uzz) + y2 * (uxx + uzz) + z2 * (uxx + uyy)
        bend -= two * (ux * uy * uxy + ux * uz * uxz + uy * uz * uyz)
        bend /= square + tiny
        most = limit * np.sqrt(square)
        out[k] = min(max(bend, -most), most)


@kernel
def _apply(
    out: Row, c: Row, g: Row, change: Row, rate: Row, bend: Row, cfl: np.float32, floor: np.float32
) -> None:
    """Take each voxel's own time step."""
    n = change.size
    for k in range(n):
        step = cfl / max(rate[k], floor)
        out[k + 1] = c[k + 1] + step * (change[k] + g[k + 1] * bend[k])


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
    change, rate = np.empty(depth, np.float32), np.empty(depth, np.float32)
    bend = np.empty(depth, np.float32)
    for i in range(start, stop):
        im, ip = max(i - 1, 0), min(i + 1, nx - 1)
        for j in range(ny):
            a, b = spans[i, j, 0], spans[i, j, 1]
            if a >= b:
                continue
            n, lo, hi = b - a, a - 1, b + 1
            jm, jp = max(j - 1, 0), min(j + 1, ny - 1)
            c, xm, xp = u[i, j, lo:hi], u[im, j, lo:hi], u[ip, j, lo:hi]
            ym, yp = u[i, jm, lo:hi], u[i, jp, lo:hi]
            _transport(
                change[:n], rate[:n], c, xm, xp, ym, yp, f[i, j, lo:hi], g[i, j, lo:hi],
                g[im, j, lo:hi], g[ip, j, lo:hi], g[i, jm, lo:hi], g[i, jp, lo:hi], inv,
            )  # fmt: skip
            _curvature(
                bend[:n], c, xm, xp, ym, yp, u[im, jm, a:b], u[im, jp, a:b],
                u[ip, jm, a:b], u[ip, jp, a:b], inv, limit,
            )  # fmt: skip
            _apply(out[i, j, lo:hi], c, g[i, j, lo:hi], change[:n], rate[:n], bend[:n], cfl, floor)
            out[i, j, 0], out[i, j, depth - 1] = out[i, j, 1], out[i, j, depth - 2]
