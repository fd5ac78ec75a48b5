"""Make the pictures of these pages from a run of the sample.

Usage: ``python docs/make_pictures.py CONFIG RUN``, after ``make run``.
"""

import sys
from pathlib import Path

import cv2
import numpy as np

from gvpipe.artefacts import read_artefact
from gvpipe.configfile import load_config
from gvpipe.core.geometry.ground import overhead_grid, overhead_view
from gvpipe.core.types import Image, Mount
from gvpipe.dataset import Dataset, open_dataset
from gvpipe.formats.jpeg import jpeg_bytes
from gvpipe.records import MatchBody, OverlapBody, PairRow

HERE = Path(__file__).parent / "img"
WIDTH = 960
LINES = 60


def main(config: Path, run: Path) -> None:
    """Write every picture."""
    dataset = open_dataset(load_config(config))
    match = read_artefact(run / "match", MatchBody)
    row = match.body.pairs[0]
    points = [match.arrays("match.npz")[f"0/points_{side}"] for side in "ij"]
    save("matches", matches(dataset, row, points[0], points[1]))
    save("overhead", overhead(dataset, row))
    overlap = read_artefact(run / "overlap", OverlapBody)
    best = next(c for c in overlap.body.overlaps[0].candidates if c.validated)
    names = (best.image_i, best.image_j)
    save("overlap", beside([dataset.view(name).pixels for name in names]))
    for stage, name in (
        ("mosaic", "mosaic"),
        ("mosaic", "evidence"),
        ("reconstruct", "evolution"),
        ("reconstruct", "terms"),
        ("reconstruct", "turntable"),
    ):
        save(name, on_white(run / stage / f"{name}.png"))


def save(name: str, pixels: Image) -> None:
    """Write one picture, not wider than the page."""
    height, width = pixels.shape[:2]
    scale = min(1.0, WIDTH / width, WIDTH / height)
    small = cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    (HERE / f"{name}.jpg").write_bytes(jpeg_bytes(np.asarray(small, np.uint8), 80))


def beside(pictures: list[Image]) -> Image:
    """Put pictures of one height side by side."""
    gap = np.full((pictures[0].shape[0], 8, 3), 255, np.uint8)
    return np.hstack([pictures[0], gap, *pictures[1:]])


def matches(dataset: Dataset, row: PairRow, points_i: np.ndarray, points_j: np.ndarray) -> Image:
    """Draw some of a pair's matches."""
    shown = beside([dataset.view(name).pixels for name in (row.image_i, row.image_j)])
    shift = np.array([dataset.entry(row.image_i).camera.width + 8, 0])
    chosen = np.unique(np.linspace(0, len(points_i) - 1, LINES).astype(int))
    for k in chosen:
        start, end = points_i[k], points_j[k] + shift
        corners = [tuple(round(v) for v in point) for point in (start, end)]
        cv2.line(shown, *corners, (33, 230, 193), 1, cv2.LINE_AA)
    return shown


def overhead(dataset: Dataset, row: PairRow) -> Image:
    """Show both pictures of a pair from above."""
    pictures = []
    for name, tilt in ((row.image_i, row.tilt_i_deg), (row.image_j, row.tilt_j_deg)):
        view = dataset.view(name)
        assert tilt is not None  # the first pair of the sample is matched
        mount = Mount(np.radians(tilt), view.mount.roll, view.mount.height)
        grid = overhead_grid(view.camera, mount, 250, 3 * mount.height)
        pixels, inside = overhead_view(view.pixels, view.camera, mount, grid)
        pictures.append(np.where(inside[..., None], pixels, 255).astype(np.uint8))
    height = max(picture.shape[0] for picture in pictures)
    padded = [
        cv2.copyMakeBorder(p, height - p.shape[0], 0, 0, 0, cv2.BORDER_CONSTANT, value=(255,) * 3)
        for p in pictures
    ]
    return beside([np.asarray(p, np.uint8) for p in padded])


def on_white(path: Path) -> Image:
    """Read a stage's picture, what is transparent made white."""
    pixels = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels.ndim == 2:
        pixels = np.repeat(pixels[..., None], 3, axis=2)
    if pixels.shape[2] == 4:
        alpha = pixels[..., 3:] / 255
        pixels = (pixels[..., :3] * alpha + 255 * (1 - alpha)).astype(np.uint8)
    return np.ascontiguousarray(pixels[..., 2::-1])


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
