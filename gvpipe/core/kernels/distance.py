"""Loops that keep a level-set function a signed distance in a narrow band around its front.

The layout of the arrays is that of :mod:`gvpipe.core.kernels.levelset`.
"""

import numpy as np

from gvpipe.core.kernels.jit import kernel
from gvpipe.core.kernels.levelset import Cross, Flat, Place, Scale, Spans, Volume, cross


@kernel
def _steepest(backward: np.float32, forward: np.float32) -> np.float32:
    """Largest of the one-sided and central slopes, squared."""
    central = np.float32(0.5) * (backward + forward)
    return max(max(backward * backward, forward * forward), central * central)


@kernel
def _anchor(out: Flat, u: Flat, rows: Cross, n: Place, inv: Scale) -> None:
    """Divide voxels that have a neighbour across the front by the slope there; keep the others."""
    ix, iy, iz = inv
    c, xm, xp, ym, yp = rows
    zero, tiny, next_ = np.float32(0), np.float32(1e-6), np.uintp(1)
    for k in range(n):
        here, down, up = u[c + k], u[c + k - next_], u[c + k + next_]
        west, east, south, north = u[xm + k], u[xp + k], u[ym + k], u[yp + k]
        low = min(min(west, east), min(south, north))
        high = max(max(west, east), max(south, north))
        low = min(low, min(down, up)) if iz > zero else low
        high = max(high, max(down, up)) if iz > zero else high
        slope = _steepest((here - west) * ix, (east - here) * ix)
        slope += _steepest((here - south) * iy, (north - here) * iy)
        slope += _steepest((here - down) * iz, (up - here) * iz)
        other = low if here > zero else -high
        out[c + k] = here / np.sqrt(slope + tiny) if other <= zero else here


@kernel
def _eikonal(out: Flat, u: Flat, rows: Cross, n: Place, inv: Scale) -> None:
    """Solve ``|grad u| = 1`` upwind from the neighbours; keep voxels next to the front."""
    ix, iy, iz = inv
    c, xm, xp, ym, yp = rows
    zero, far, next_ = np.float32(0), np.float32(1e18), np.uintp(1)
    for k in range(n):
        here = u[c + k]
        s = np.float32(1) if here > zero else np.float32(-1)
        a = min(s * u[xm + k], s * u[xp + k])
        b = min(s * u[ym + k], s * u[yp + k])
        d = min(s * u[c + k - next_], s * u[c + k + next_]) if iz > zero else far
        at_front = min(a, min(b, d)) <= zero
        # sort the three nearest neighbours, each with its spacing
        p, q, r = ix, iy, iz
        a, b, p, q = (b, a, q, p) if b < a else (a, b, p, q)
        b, d, q, r = (d, b, r, q) if d < b else (b, d, q, r)
        a, b, p, q = (b, a, q, p) if b < a else (a, b, p, q)
        # with b and d measured from a, the sums stay small where a is large
        b, d, p, q, r = b - a, d - a, p * p, q * q, r * r
        one = np.float32(1) / np.sqrt(p)
        two = (q * b + np.sqrt(max(p + q - p * q * b * b, zero))) / (p + q)
        t, w = p + q + r, q * b + r * d
        three = (w + np.sqrt(max(w * w - t * (q * b * b + r * d * d - np.float32(1)), zero))) / t
        rise = one if one <= b else (two if two <= d else three)
        out[c + k] = here if at_front else s * (a + rise)


@kernel
def distance_slab(
    u: Volume, out: Volume, spans: Spans, inv: Scale, anchor: bool, start: int, stop: int
) -> None:
    """One pass towards a signed distance for columns with start <= i < stop.

    Parameters
    ----------
    u, out : (nx, ny, nz + 2) float32
        Read and written, padded; they agree outside the spans.
    spans : (nx, ny, 2) int32
    inv : 3 float32
        One over the spacing; 0 along z measures within each layer.
    anchor : bool
        True for the first pass, which sets the voxels next to the front (first-order subcell
        distance of Russo and Smereka, J. Comput. Phys. 163, 2000); each later pass makes one
        more layer of voxels on either side right.
    """
    nx, ny, depth = u.shape
    flat, written = u.reshape(u.size), out.reshape(u.size)
    for i in range(start, stop):
        for j in range(ny):
            a, b = spans[i, j, 0], spans[i, j, 1]
            if a >= b:
                continue
            rows, n = cross(i, j, a, nx, ny, depth), np.uintp(b - a)
            if anchor:
                _anchor(written, flat, rows, n, inv)
            else:
                _eikonal(written, flat, rows, n, inv)
            out[i, j, 0], out[i, j, depth - 1] = out[i, j, 1], out[i, j, depth - 2]


@kernel
def front_spans(u: Volume, planar: bool, width: int, old: Spans) -> Spans:
    """Where each column comes within `width` voxels of the front.

    Parameters
    ----------
    u : (nx, ny, nz + 2) float32
        Padded level-set function.
    planar : bool
        Look for the front along x and y only (layers that do not see each other).
    width : int
        Voxels by which the front is dilated along each axis.
    old : (nx, ny, 2) int32
        Spans that the front has not left.

    Returns
    -------
    spans : (nx, ny, 2) int32
        First and last-plus-one padded index; equal where the column is far from the front.
    """
    nx, ny, depth = u.shape
    spans = np.empty((nx, ny, 2), np.int32)
    zero = np.float32(0)
    for i in range(nx):
        for j in range(ny):
            row, east = u[i, j], u[min(i + 1, nx - 1), j]
            north = u[i, min(j + 1, ny - 1)]
            first, last = depth, 0
            for k in range(old[i, j, 0], old[i, j, 1]):
                here = row[k] > zero
                if (
                    here != (east[k] > zero)
                    or here != (north[k] > zero)
                    or (not planar and here != (row[k + 1] > zero))
                ):
                    first, last = min(first, k), k
            spans[i, j, 0], spans[i, j, 1] = first, last + 1
    reach = 0 if planar else width
    rows = np.empty((nx, ny, 2), np.int32)
    for i in range(nx):
        for j in range(ny):
            first, last = depth, 0
            for near in range(max(j - width, 0), min(j + width + 2, ny)):
                first, last = min(first, spans[i, near, 0]), max(last, spans[i, near, 1])
            rows[i, j, 0], rows[i, j, 1] = first, last
    for i in range(nx):
        for j in range(ny):
            first, last = depth, 0
            for near in range(max(i - width, 0), min(i + width + 2, nx)):
                first, last = min(first, rows[near, j, 0]), max(last, rows[near, j, 1])
            found = first < depth
            spans[i, j, 0] = max(first - reach, 1) if found else 1
            spans[i, j, 1] = min(last + reach + 1, depth - 1) if found else 1
    return spans


@kernel
def settle(u: Volume, out: Volume, old: Spans, new: Spans, clip: np.float32) -> None:
    """Set what lies outside the new spans to +-clip and make both buffers agree.

    Parameters
    ----------
    u, out : (nx, ny, nz + 2) float32
        The current buffer, and the one to be written next.
    old, new : (nx, ny, 2) int32
        Spans before and now.
    clip : float32
        Largest |u| kept.
    """
    nx, ny, depth = u.shape
    for i in range(nx):
        for j in range(ny):
            if old[i, j, 0] >= old[i, j, 1] and new[i, j, 0] >= new[i, j, 1]:
                continue
            row = u[i, j]
            for k in range(depth):
                value = min(max(row[k], -clip), clip)
                inside = new[i, j, 0] <= k < new[i, j, 1]
                row[k] = value if inside else (clip if value > 0 else -clip)
            row[0], row[depth - 1] = row[1], row[depth - 2]
            out[i, j] = row
