"""Rays into scenes of boxes, cylinders and spheres on a plane, with soft light."""

import math

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.kernels.jit import kernel
from gvpipe.core.types import Float

Index = NDArray[np.int64]

FAR = 1e30
"""Distance of what a ray does not meet."""

LIFT = 1e-5
"""Metres by which a shadow ray starts off the surface that it leaves."""

BOX, CYLINDER, SPHERE = 0, 1, 2
"""Kinds of solids."""


@kernel
def _enter_box(
    ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, hx: float, hy: float, h: float
) -> float:
    """Distance at which a ray enters a box on the ground; FAR if it does not."""
    near, far = -FAR, FAR
    for o, d, low, high in ((ox, dx, -hx, hx), (oy, dy, -hy, hy), (oz, dz, 0.0, h)):
        if abs(d) < 1e-12:
            if o < low or o > high:
                return FAR
            continue
        a, b = (low - o) / d, (high - o) / d
        near, far = max(near, min(a, b)), min(far, max(a, b))
    return near if near > 0.0 and near < far else FAR


@kernel
def _enter_cylinder(
    ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, r: float, h: float
) -> float:
    """Do the same for an upright cylinder."""
    best = FAR
    a, b, c = dx * dx + dy * dy, ox * dx + oy * dy, ox * ox + oy * oy - r * r
    root = b * b - a * c
    if a > 1e-12 and root > 0.0:
        t = (-b - math.sqrt(root)) / a
        z = oz + t * dz
        if t > 0.0 and 0.0 <= z <= h:
            best = t
    if abs(dz) > 1e-12:
        t = (h - oz) / dz
        x, y = ox + t * dx, oy + t * dy
        if 0.0 < t < best and x * x + y * y <= r * r:
            best = t
    return best


@kernel
def _enter_sphere(
    ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, r: float
) -> float:
    """Do the same for a sphere that touches the ground."""
    z = oz - r
    b = ox * dx + oy * dy + z * dz
    root = b * b - (ox * ox + oy * oy + z * z - r * r)
    if root <= 0.0:
        return FAR
    t = -b - math.sqrt(root)
    return t if t > 0.0 else FAR


@kernel
def _first_solid(
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
    kinds: Index,
    places: Float,
    sizes: Float,
) -> tuple[float, int]:
    """Distance to the nearest solid along a unit ray, and which; (FAR, -1) if none."""
    best, which = FAR, -1
    for k in range(len(kinds)):
        px, py, c, s = places[k, 0], places[k, 1], places[k, 2], places[k, 3]
        lx, ly = c * (ox - px) + s * (oy - py), -s * (ox - px) + c * (oy - py)
        ex, ey = c * dx + s * dy, -s * dx + c * dy
        if kinds[k] == BOX:
            t = _enter_box(lx, ly, oz, ex, ey, dz, sizes[k, 0] / 2, sizes[k, 1] / 2, sizes[k, 2])
        elif kinds[k] == CYLINDER:
            t = _enter_cylinder(lx, ly, oz, ex, ey, dz, sizes[k, 0] / 2, sizes[k, 2])
        else:
            t = _enter_sphere(lx, ly, oz, ex, ey, dz, sizes[k, 2] / 2)
        if t < best:
            best, which = t, k
    return best, which


@kernel
def _local_normal(
    kind: int, x: float, y: float, z: float, size: Float
) -> tuple[float, float, float]:
    """Outward normal at a surface point, both in the solid's own axes."""
    if kind == SPHERE:
        r = size[2] / 2
        return x / r, y / r, (z - r) / r
    up = abs(z - size[2])
    if kind == CYLINDER:
        rho = math.sqrt(x * x + y * y)
        if up < abs(rho - size[0] / 2):
            return 0.0, 0.0, 1.0
        return x / rho, y / rho, 0.0
    side_x, side_y = abs(abs(x) - size[0] / 2), abs(abs(y) - size[1] / 2)
    if up < side_x and up < side_y:
        return 0.0, 0.0, 1.0
    if side_x < side_y:
        return math.copysign(1.0, x), 0.0, 0.0
    return 0.0, math.copysign(1.0, y), 0.0


@kernel
def _texel(
    texels: NDArray[np.float32], start: int, size: int, u: float, v: float, channel: int
) -> float:
    """Bilinear sample of one periodic level."""
    fu, fv = math.floor(u), math.floor(v)
    au, av = u - fu, v - fv
    u0, v0 = int(fu) % size, int(fv) % size
    u1, v1 = (u0 + 1) % size, (v0 + 1) % size
    low = (1 - au) * texels[start + v0 * size + u0, channel]
    low += au * texels[start + v0 * size + u1, channel]
    high = (1 - au) * texels[start + v1 * size + u0, channel]
    high += au * texels[start + v1 * size + u1, channel]
    return (1 - av) * low + av * high


@kernel
def _sample(
    texels: NDArray[np.float32],
    starts: Index,
    sizes: Index,
    period: float,
    a: float,
    b: float,
    footprint: float,
    out: Float,
) -> None:
    """Texture colour at surface coordinates (metres), averaged over a footprint (metres)."""
    detail = math.log2(max(footprint * sizes[0] / period, 1.0))
    level = min(int(detail), len(sizes) - 2)
    part = min(detail - level, 1.0)
    for channel in range(3):
        value = 0.0
        for step in range(2):
            weight = part if step else 1.0 - part
            size = sizes[level + step]
            u, v = a / period * size - 0.5, b / period * size - 0.5
            value += weight * _texel(texels, starts[level + step], size, u, v, channel)
        out[channel] = value


@kernel
def _scatter(index: int, salt: int) -> float:
    """Well mixed number from 0 to 1 for a ray's number."""
    h = (index * 2654435761 + salt * 40503) & 0xFFFFFFFF
    h = ((h ^ (h >> 15)) * 2246822519) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 3266489917) & 0xFFFFFFFF
    return float(h ^ (h >> 16)) / 4294967296.0


@kernel
def _light(
    x: float,
    y: float,
    z: float,
    nx: float,
    ny: float,
    nz: float,
    kinds: Index,
    places: Float,
    sizes: Float,
    sun: Float,
    softness: float,
    ambient: float,
    index: int,
    samples: int,
) -> float:
    """Light that reaches a surface point: sun through its disc, sky over the hemisphere."""
    total_sun, total_sky = 0.0, 0.0
    x, y, z = x + LIFT * nx, y + LIFT * ny, z + LIFT * nz
    first_a, first_b = _scatter(index, 1), _scatter(index, 2)
    for k in range(samples):
        # steps of a lattice that fills the square evenly, from a start of each ray's own
        a, b = (first_a + 0.7548776662466927 * k) % 1.0, (first_b + 0.5698402909980532 * k) % 1.0
        turn = 2.0 * math.pi * b
        reach = softness * math.sqrt(a)
        # the sun's disc is small, so any two directions about across it will do
        dx = sun[0] + reach * math.cos(turn)
        dy = sun[1] + reach * math.sin(turn)
        dz = sun[2]
        norm = math.sqrt(dx * dx + dy * dy + dz * dz)
        dx, dy, dz = dx / norm, dy / norm, dz / norm
        facing = nx * dx + ny * dy + nz * dz
        if facing > 0.0:
            _, hit = _first_solid(x, y, z, dx, dy, dz, kinds, places, sizes)
            if hit < 0:
                total_sun += facing
        # uniform point of the unit sphere added to the normal: cosine-weighted direction
        cz = 1.0 - 2.0 * a
        ring = math.sqrt(max(1.0 - cz * cz, 0.0))
        dx, dy, dz = nx + ring * math.cos(turn), ny + ring * math.sin(turn), nz + cz
        norm = math.sqrt(dx * dx + dy * dy + dz * dz)
        if norm < 1e-9:
            continue
        dx, dy, dz = dx / norm, dy / norm, dz / norm
        if dz <= 0.0:
            total_sky += 0.35  # light that the ground throws back
            continue
        _, hit = _first_solid(x, y, z, dx, dy, dz, kinds, places, sizes)
        total_sky += 1.0 if hit < 0 else 0.25
    return ((1.0 - ambient) * total_sun + ambient * total_sky) / samples


@kernel
def trace(
    rays: Float,
    origin: Float,
    kinds: Index,
    places: Float,
    sizes: Float,
    colours: Float,
    texels: NDArray[np.float32],
    starts: Index,
    level_sizes: Index,
    periods: Float,
    sun: Float,
    softness: float,
    ambient: float,
    spread: float,
    samples: int,
    first: int,
    colour: Float,
    which: NDArray[np.int16],
) -> None:
    """Follow unit rays to the first surface; fills `colour` (N, 3) and `which` (N,).

    `which` is the solid's number, -1 for the ground, -2 for the sky; `spread` is the angle
    between neighbouring rays, radians; `first` numbers the rays of several passes apart.
    """
    texture = np.empty(3)
    ox, oy, oz = origin[0], origin[1], origin[2]
    for n in range(len(rays)):
        dx, dy, dz = rays[n, 0], rays[n, 1], rays[n, 2]
        t, k = _first_solid(ox, oy, oz, dx, dy, dz, kinds, places, sizes)
        which[n] = k
        if k < 0:
            if dz > -1e-9:
                which[n] = -2
                colour[n, 0], colour[n, 1], colour[n, 2] = 150.0, 180.0, 220.0
                continue
            t = -oz / dz
        x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
        nx, ny, nz = 0.0, 0.0, 1.0
        a, b = x, y
        if k >= 0:
            c, s = places[k, 2], places[k, 3]
            lx = c * (x - places[k, 0]) + s * (y - places[k, 1])
            ly = -s * (x - places[k, 0]) + c * (y - places[k, 1])
            mx, my, nz = _local_normal(kinds[k], lx, ly, z, sizes[k])
            nx, ny = c * mx - s * my, s * mx + c * my
            # the texture lies flat on the coordinate plane that the surface faces most
            if abs(nz) >= abs(mx) and abs(nz) >= abs(my):
                a, b = lx, ly
            elif abs(mx) >= abs(my):
                a, b = ly + 0.37, z
            else:
                a, b = lx + 0.71, z
        facing = max(abs(dx * nx + dy * ny + dz * nz), 1e-3)
        footprint = t * spread / math.sqrt(facing)
        skin = k + 1
        _sample(texels[skin], starts, level_sizes, periods[skin], a, b, footprint, texture)
        light = _light(
            x, y, z, nx, ny, nz, kinds, places, sizes, sun, softness, ambient, first + n, samples
        )
        for channel in range(3):
            colour[n, channel] = texture[channel] * colours[skin, channel] * light
