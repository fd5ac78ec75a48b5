"""Memory of a large mosaic: python tests/bench/bench_large_mosaic.py FOLDER PICTURE ...

A thousand pictures of 640 x 480 (the given files over and over, at poses of their own, read from
disk when needed) into 20,000 x 20,000 pixels, with all layers, as the mosaic command writes them.
The camera is lens A of a typical robot; the files must be 640 x 480.
"""

import resource
import sys
import time
from pathlib import Path

import numpy as np

from gvpipe.core.geometry.pose import planar_pose
from gvpipe.core.mosaic.blend import BLENDS
from gvpipe.core.mosaic.compose import Composition
from gvpipe.core.mosaic.raster import MosaicRaster, Picture
from gvpipe.core.types import Camera, Mount
from gvpipe.formats.files import file_sha256
from gvpipe.pixels import PixelSource, PixelStore
from gvpipe.stages.mosaic import write_map

CAMERA = Camera(640, 480, 560.0, 560.0, 319.5, 239.5)
COUNT, SIDE, RESOLUTION = 1000, 20_000, 0.005


class Silent:
    """Counts nothing."""

    def advance(self, steps: int = 1) -> None:
        """Do nothing."""


def main(folder: Path, files: list[Path]) -> None:
    store, rng = PixelStore(), np.random.default_rng(0)
    sources = [PixelSource(f, None, file_sha256(f)[0], CAMERA, ()) for f in files]

    def reader(k: int):
        # every picture decodes its own file: nothing is shared through the cache
        camera = Camera(640, 480, 560.0, 560.0, 319.5, 239.5 + 1e-9 * k)
        of = sources[k % len(sources)]
        source = PixelSource(of.path, of.frame, of.sha256, camera, ())
        return lambda: store.read(source)

    pictures = []
    across = int(np.ceil(np.sqrt(COUNT)))
    for k in range(COUNT):
        x, y = (k % across + 0.5, k // across + 0.5)
        pitch = SIDE * RESOLUTION / across
        mount = Mount(np.radians(40), 0.0, 1.0)
        pose = planar_pose(x * pitch, y * pitch, rng.uniform(0, 2 * np.pi), mount)
        pictures.append(Picture(CAMERA, pose, reader(k)))
    raster = MosaicRaster(SIDE, SIDE, RESOLUTION, 0.0, SIDE * RESOLUTION)
    start = time.perf_counter()
    composition = Composition(pictures, raster, BLENDS["robust"], 2)
    surveyed = time.perf_counter() - start
    write_map(composition, folder, "", Silent())
    wall = time.perf_counter() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    covered = composition.survey.covered_m2 / (SIDE * RESOLUTION) ** 2
    sys.stdout.write(
        f"survey {surveyed:.0f} s, all {wall:.0f} s, peak memory {peak:.0f} MB, "
        f"covered {covered:.0%}\n"
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]), [Path(name) for name in sys.argv[2:]])
