"""Draw the plain motions of thesis section 5.3 over their exact solutions: figs. 5.8 to 5.10.

Run it by ``python -m tests.bench.fig_motions OUT.png``. Lines are the computed fronts at equal
times, lighter to darker; red dots are the exact solutions (the shrinking star has none: only its
area is known, which falls by 2 pi a unit of time whatever the shape).
"""

import argparse
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from skimage.measure import find_contours

from gvpipe.core.reconstruct.motions import step_along_normal, step_by_curvature, step_by_velocity
from gvpipe.formats.figures import sheet
from gvpipe.formats.raster import png_bytes

Array = NDArray[np.float64]

SIDE, CELLS, FRONTS = 400, 201, 6
AXIS = np.linspace(-1.0, 1.0, CELLS)
X, Y = np.meshgrid(AXIS, AXIS, indexing="ij")
H = float(AXIS[1] - AXIS[0])


def star(x: Array, y: Array) -> Array:
    """Negative inside a star with seven tips."""
    return np.hypot(x, y) - (0.45 + 0.15 * np.cos(7 * np.arctan2(y, x)))


def polygon(x: Array, y: Array) -> Array:
    """Negative inside a triangle beside the origin."""
    corners = np.array([[0.15, -0.25], [0.75, -0.1], [0.35, 0.4]])
    sides = np.roll(corners, -1, axis=0) - corners
    normals = np.column_stack([sides[:, 1], -sides[:, 0]]) / np.linalg.norm(sides, axis=1)[:, None]
    gaps = [(x - a[0]) * n[0] + (y - a[1]) * n[1] for a, n in zip(corners, normals, strict=True)]
    return np.max(gaps, axis=0)


def fine_distance(phi_of: Callable[[Array, Array], Array], times: int = 4) -> Array:
    """Signed distance to a shape on the grid, measured on one that is finer."""
    axis = np.linspace(-1.0, 1.0, times * (CELLS - 1) + 1)
    inside = phi_of(*np.meshgrid(axis, axis, indexing="ij")) < 0
    h = H / times
    outside = distance_transform_edt(~inside) - 0.5
    distance = h * np.where(inside, 0.5 - distance_transform_edt(inside), outside)
    return np.asarray(distance[::times, ::times])


def fronts(phi: Array, step: Callable[[Array], Array], steps: int) -> Iterator[Array]:
    """Six moments of a motion, the start among them."""
    for k in range(steps * (FRONTS - 1) + 1):
        if k % steps == 0:
            yield phi
        phi = step(phi)


def draw(computed: list[Array], exact: list[Array]) -> NDArray[np.uint8]:
    picture = np.full((SIDE, SIDE, 3), 255, np.uint8)
    for k, phi in enumerate(computed):
        shade = int(190 * (1 - k / (FRONTS - 1)))
        cv2.polylines(picture, _pixels(phi), False, (shade, shade, shade), 2, cv2.LINE_AA)
    for phi in exact:
        for line in _pixels(phi):
            for u, v in line[::12]:
                cv2.circle(picture, (int(u), int(v)), 2, (214, 39, 40), -1, cv2.LINE_AA)
    return picture


def _pixels(phi: Array) -> list[NDArray[np.int32]]:
    lines = find_contours(phi, 0.0)
    scale = (SIDE - 1) / (CELLS - 1)
    return [
        np.rint(np.column_stack([c[:, 0], CELLS - 1 - c[:, 1]]) * scale).astype(np.int32)
        for c in lines
    ]


def gap(phi: Array, exact: Array) -> float:
    """Mean distance of the computed front from the exact one, cells."""
    return float(np.abs(exact[np.abs(phi) < 0.5 * H]).mean() / H)


def curvature_panel() -> tuple[NDArray[np.uint8], str]:
    dt, steps = 0.2 * H * H, 400
    # a signed distance, so that the area can be read off it
    found = list(fronts(fine_distance(star), lambda p: step_by_curvature(p, 1.0, H, dt), steps))
    insides = [(p < 0).sum() * H * H for p in found]
    rate = (insides[0] - insides[-1]) / (dt * steps * (FRONTS - 1))
    return draw(found, []), f"curvature: area falls {rate:.3f} (exact {2 * np.pi:.3f})"


def normal_panel() -> tuple[NDArray[np.uint8], str]:
    dt, steps = 0.4 * H, 15
    start = fine_distance(star)
    found = list(fronts(start, lambda p: step_along_normal(p, 1.0, H, dt), steps))
    exact = [start - k * steps * dt for k in range(FRONTS)]
    return draw(found, exact), f"normal speed 1: off by {gap(found[-1], exact[-1]):.2f} cells"


def rotation_panel() -> tuple[NDArray[np.uint8], str]:
    turn, steps = -np.pi / 2 / (FRONTS - 1), 60  # clockwise
    velocity = np.stack([Y, -X])
    step = -turn / steps
    found = list(fronts(polygon(X, Y), lambda p: step_by_velocity(p, velocity, H, step), steps))
    exact = []
    for k in range(FRONTS):
        c, s = np.cos(k * turn), np.sin(k * turn)
        exact.append(polygon(c * X + s * Y, -s * X + c * Y))
    return draw(found, exact), f"rotation by 90 deg: off by {gap(found[-1], exact[-1]):.2f} cells"


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path, help="PNG to write")
    panels = [curvature_panel(), normal_panel(), rotation_panel()]
    parser.parse_args(arguments).out.write_bytes(png_bytes(sheet(panels, columns=3)))
    sys.stdout.write("".join(f"{caption}\n" for _, caption in panels))


if __name__ == "__main__":
    main(sys.argv[1:])
