"""Known ground points of the configuration, and how well the map fits them."""

import numpy as np

from gvpipe.config import Config
from gvpipe.core.geometry.distortion import undistorted
from gvpipe.core.geometry.ground import pixel_from_plane
from gvpipe.core.geometry.homography import apply
from gvpipe.core.slam.location_graph import ControlPoint, MapResult
from gvpipe.core.slam.transfer import map_from_pixel
from gvpipe.core.types import Camera
from gvpipe.dataset import Dataset, ImageEntry
from gvpipe.records import ControlRow, SlamBody


def control_points(config: Config, dataset: Dataset) -> list[ControlPoint]:
    """Known points in usable images, with the lens' distortion taken out of their pixels."""
    entries = {entry.image_id: entry for entry in dataset.entries}
    return [
        ControlPoint(point.image, _undistorted(entries[point.image], point.pixel), point.map)
        for point in config.slam.control
        if point.image in entries
    ]


def _undistorted(entry: ImageEntry, pixel: tuple[float, float]) -> tuple[float, float]:
    """Where a pixel of the photograph is in the undistorted image."""
    u, v = undistorted(np.array([pixel]), entry.camera, entry.source.distortion)[0]
    return float(u), float(v)


def control_rows(
    control: list[ControlPoint], cameras: dict[str, Camera], result: MapResult
) -> tuple[ControlRow, ...]:
    """Compare the known points with where the map sees them."""
    rows = []
    for point in control:
        posed = result.poses.get(point.image)
        if posed is None or not result.ground[posed.component].fixed:
            continue
        pixel_from_map = pixel_from_plane(cameras[point.image], posed.map_from_camera)
        seen = apply(pixel_from_map, np.array([point.position]))[0]
        here = apply(
            map_from_pixel(cameras[point.image], posed.map_from_camera), np.array([point.pixel])
        )[0]
        error_px = float(np.hypot(*(seen - point.pixel)))
        error_m = float(np.hypot(*(here - point.position)))
        rows.append(
            ControlRow(
                image=point.image, component=posed.component, error_px=error_px, error_m=error_m
            )
        )
    return tuple(rows)


def control_summary(body: SlamBody) -> tuple[tuple[str, str], ...]:
    """Say how well the known points fit, for the closing table."""
    if not body.control:
        return ()
    worst = max(body.control, key=lambda row: row.error_px)
    text = f"{len(body.control)} known points, at most {worst.error_px:.1f} px off ({worst.image})"
    return (("control", text),)
