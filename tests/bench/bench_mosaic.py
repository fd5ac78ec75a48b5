"""Time and memory of the mosaic against plain numpy tiles: python tests/bench/bench_mosaic.py.

100 pictures of 640 x 480 into 4000 x 4000 pixels. Each engine runs in a process of its own, so
that its peak memory is its own; the pictures are in memory before the clock starts, the compiled
loops are warm. gvpipe's bands are read one after the other, as its command writes them; numpy
fills the whole mosaic.
"""

import resource
import subprocess
import sys
import time

import numpy as np

from gvpipe.core.geometry.ground import pixel_from_plane
from gvpipe.core.geometry.pose import planar_pose
from gvpipe.core.mosaic.blend import BLENDS
from gvpipe.core.mosaic.compose import Composition, compose
from gvpipe.core.mosaic.raster import MosaicRaster, max_depth
from gvpipe.core.types import Camera, Mount, PosedView

CAMERA = Camera(640, 480, 560.0, 560.0, 319.5, 239.5)
SIDE, RESOLUTION = 4000, 0.005


def scene() -> tuple[list[PosedView], MosaicRaster]:
    """Cameras on a 10 x 10 lattice of 2 m, 1.4 m high, headings all round."""
    rng = np.random.default_rng(0)
    views = []
    for k in range(100):
        x, y = (k % 10) * 2.0 + 1.0, (k // 10) * 2.0 + 1.0
        pose = planar_pose(x, y, rng.uniform(0, 2 * np.pi), Mount(np.radians(50), 0.0, 1.4))
        pixels = rng.integers(0, 256, (480, 640, 3), dtype=np.uint8)
        views.append(PosedView(f"A/{k}", pixels, CAMERA, pose))
    return views, MosaicRaster(SIDE, SIDE, RESOLUTION, 0.0, SIDE * RESOLUTION)


def numpy_tiles(views: list[PosedView], raster: MosaicRaster, blend: str) -> np.ndarray:
    """Compute the same mosaics with whole-array numpy on tiles of 500 pixels, no compiled loop."""
    rgba = np.zeros((raster.height, raster.width, 4), np.uint8)
    homographies = [
        pixel_from_plane(v.camera, v.map_from_camera) @ raster.map_from_pixel for v in views
    ]
    for row in range(0, raster.height, 500):
        for column in range(0, raster.width, 500):
            v, u = np.mgrid[row : row + 500, column : column + 500].astype(np.float32)
            stack, density = [], []
            for view, a in zip(views, homographies, strict=True):
                w = np.maximum(a[2, 0] * u + a[2, 1] * v + a[2, 2], 1e-3)
                x = (a[0, 0] * u + a[0, 1] * v + a[0, 2]) / w
                y = (a[1, 0] * u + a[1, 1] * v + a[1, 2]) / w
                ok = (w > 1e-3) & (w <= max_depth(view, raster.resolution))
                ok &= (x >= 0) & (x <= 639) & (y >= 0) & (y <= 479)
                if not ok.any():
                    continue
                x0 = np.clip(x.astype(np.int32), 0, 638)
                y0 = np.clip(y.astype(np.int32), 0, 478)
                fx, fy = (x - x0)[..., None], (y - y0)[..., None]
                p = view.pixels
                sample = (1 - fy) * ((1 - fx) * p[y0, x0] + fx * p[y0, x0 + 1]) + fy * (
                    (1 - fx) * p[y0 + 1, x0] + fx * p[y0 + 1, x0 + 1]
                )
                stack.append(np.where(ok[..., None], sample, np.nan).astype(np.float32))
                density.append(np.where(ok, abs(np.linalg.det(a)) / w**3, -1.0).astype(np.float32))
            if stack:
                window = rgba[row : row + 500, column : column + 500]
                _numpy_blend(np.stack(stack), np.stack(density), blend, window)
    return rgba


def _numpy_blend(stack: np.ndarray, density: np.ndarray, blend: str, out: np.ndarray) -> None:
    seen = density >= 0
    if blend == "best":
        best = density.argmax(axis=0)
        colour = np.take_along_axis(stack, best[None, ..., None], axis=0)[0]
    else:
        keep, count = seen.copy(), seen.sum(axis=0)
        filled = np.where(seen[..., None], stack, 0.0)
        for _ in range(int(count.max()) // 2):
            more = keep.sum(axis=0) > (count + 1) // 2
            mean = (filled * keep[..., None]).sum(axis=0) / np.maximum(keep.sum(axis=0), 1)[
                ..., None
            ]
            far = np.where(keep, ((filled - mean) ** 2).sum(axis=-1), -1.0).argmax(axis=0)
            drop = (np.arange(len(stack))[:, None, None] == far) & more
            keep &= ~drop
        colour = (filled * keep[..., None]).sum(axis=0) / np.maximum(keep.sum(axis=0), 1)[..., None]
    any_seen = seen.any(axis=0)
    out[..., :3] = np.where(any_seen[..., None], colour + 0.5, 0).astype(np.uint8)
    out[..., 3] = 255 * any_seen


def run(engine: str, blend: str, jobs: int) -> None:
    views, raster = scene()
    if engine == "gvpipe":
        compose(views, MosaicRaster(64, 64, RESOLUTION, 5.0, 5.0), BLENDS[blend])
    start, cpu = time.perf_counter(), time.process_time()
    if engine == "gvpipe":
        bands = Composition(views, raster, BLENDS[blend], jobs).bands()
        seen = sum(int((band.rgba[..., 3] > 0).sum()) for band in bands)
    else:
        seen = int((numpy_tiles(views, raster, blend)[..., 3] > 0).sum())
    wall, cpu = time.perf_counter() - start, time.process_time() - cpu
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    sys.stdout.write(
        f"{blend:6s} {engine:7s} jobs {jobs}: {wall:6.2f} s wall, {cpu:6.2f} s CPU, "
        f"peak memory {peak:4.0f} MB, covered {seen / SIDE**2:.0%}\n"
    )


if __name__ == "__main__":
    if len(sys.argv) > 1:
        run(sys.argv[1], sys.argv[2], int(sys.argv[3]))
    else:
        for case in (
            ("gvpipe", "best", "2"),
            ("gvpipe", "robust", "1"),
            ("gvpipe", "robust", "2"),
            ("gvpipe", "half", "2"),
            ("numpy", "half", "1"),
        ):
            subprocess.run([sys.executable, __file__, *case], check=True)
