"""The configuration: every key with its default, range, unit and meaning, on one screen.

A key is added by adding one line here; loading, checking, printing and hashing follow from it.
"""
# ruff: noqa: E501  one key a line, however long, keeps the whole table on one screen

import warnings
from math import cos, radians, sin
from pathlib import Path
from typing import Annotated, Literal

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    PlainSerializer,
    PlainValidator,
    Tag,
)
from pydantic_core import PydanticCustomError

AUTO_TILT_DEG = 40.0
"""Where the search starts for ``tilt: auto``: the middle of what hand-held floor photos show."""


def _path(value: object) -> Path:
    if isinstance(value, Path):
        return value
    if not isinstance(value, str) or not value or "\0" in value:
        raise PydanticCustomError("path", "expected a path")
    return Path(value)


def _distortion(value: object) -> object:
    if isinstance(value, list | tuple) and len(value) not in (0, 4, 5, 8):
        raise PydanticCustomError("distortion", "expected a list of 0, 4, 5 or 8 numbers")
    return value


def _kind(value: object) -> str:
    """Which alternative of a key with several is meant, so that errors speak of that one."""
    if isinstance(value, list | tuple):
        return "list"
    return "word" if isinstance(value, str) else "number"


FilePath = Annotated[Path, PlainValidator(_path), PlainSerializer(str, return_type=str)]
Tilt = Annotated[
    Annotated[float, Field(gt=0, le=90), Tag("number")] | Annotated[Literal["auto"], Tag("word")],
    Discriminator(_kind),
]
Roll = Annotated[float, Field(gt=-45, lt=45)]
Height = Annotated[float, Field(gt=0, le=1000)]
Coefficient = Annotated[float, Field(ge=-1e4, le=1e4)]
Distortion = Annotated[tuple[Coefficient, ...], Field(strict=False), BeforeValidator(_distortion)]
ImagePair = Annotated[tuple[str, str], Field(strict=False)]
PairList = Annotated[tuple[ImagePair, ...], Field(strict=False)]
Pairs = Annotated[
    Annotated[Literal["consecutive", "exhaustive"], Tag("word")] | Annotated[PairList, Tag("list")],
    Discriminator(_kind),
]
Pixel = Annotated[
    tuple[Annotated[float, Field(ge=-1, le=65535)], Annotated[float, Field(ge=-1, le=65535)]],
    Field(strict=False),
]
Metres = Annotated[float, Field(ge=-1e7, le=1e7)]
Position = Annotated[tuple[Metres, Metres], Field(strict=False)]
Controls = Annotated[tuple["ControlConfig", ...], Field(strict=False)]
Cells = Annotated[int, Field(ge=8, le=2000)]
Grid = Annotated[tuple[Cells, Cells, Cells], Field(strict=False)]


class Section(BaseModel):
    """Strict base: unknown keys, wrong types and numbers that are not finite are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


# fmt: off
class CameraConfig(Section):
    """Intrinsics; pixel centres at integers. A calibration file may stand in its place."""

    width: int = Field(ge=16, le=65535, description="image width, pixels")
    height: int = Field(ge=16, le=65535, description="image height, pixels")
    fx: float = Field(gt=0, le=1e6, description="focal length along a row, pixels")
    fy: float = Field(gt=0, le=1e6, description="focal length along a column, pixels")
    cx: float = Field(ge=-1e5, le=1e5, description="principal point, column, pixels")
    cy: float = Field(ge=-1e5, le=1e5, description="principal point, row, pixels")
    skew: float = Field(0.0, ge=-1e4, le=1e4, description="skew, pixels")
    distortion: Distortion = Field((), description="OpenCV order k1 k2 p1 p2 k3 k4 k5 k6; 0, 4, 5 or 8 of them")


class OverrideConfig(Section):
    """What differs for one image; a key left out keeps the robot's value."""

    tilt: Tilt | None = Field(None, description="degrees of the optical axis below the horizon")
    height: Height | None = Field(None, description="camera centre above the ground, metres")
    camera: str | None = Field(None, description="name of a camera")
    roll: Roll | None = Field(None, description="degrees about the optical axis, clockwise seen from behind")


class RobotConfig(Section):
    """One robot, or one walk with one camera."""

    images: FilePath = Field(description="folder, glob, one image or one video; relative to this file or absolute")
    camera: str = Field(description="name of a camera; may be left out if there is only one")
    height: Height = Field(description="camera centre above the ground, metres; all lengths scale with it")
    tilt: Tilt = Field(description="degrees of the optical axis below the horizon, approximate; auto = find it")
    roll: Roll = Field(0.0, description="degrees about the optical axis, clockwise seen from behind")
    poses: FilePath | None = Field(None, description="known poses, camera to map: TUM file, one line an image in order; or COLMAP text model (folder or images.txt)")
    overrides: dict[str, OverrideConfig] = Field({}, description="what differs for single images, by file name")


class MatchConfig(Section):
    """Ground homographies between pairs of images."""

    pairs: Pairs = Field("consecutive", description="consecutive, exhaustive, or a list of pairs; an image is robot/file name")
    features: Literal["sift", "invariants"] = Field("sift", description="what is matched between overhead views")


with warnings.catch_warnings():
    # pydantic's own deprecated method `validate` makes room for the key of that name
    warnings.filterwarnings("ignore", message='Field name "validate"', category=UserWarning)

    class OverlapConfig(Section):
        """Which images of different robots show the same ground."""

        distance: Literal["absolute", "squared", "intersection", "chi2"] = Field("intersection", description="distance between colour histograms")
        threshold: float = Field(0.2, gt=0, le=2, description="a candidate's histogram distance is below this; pictures that share distinctive spots are candidates at any distance")
        validate: Literal["first", "all"] = Field("all", description="all = every candidate by a homography, first = best first, until the robots are joined")  # type: ignore[assignment]


class ControlConfig(Section):
    """A ground point whose place on the site is known."""

    image: str = Field(description="image that shows it, robot/file name")
    pixel: Pixel = Field(description="column and row in the photograph, pixel centres at integers")
    map: Position = Field(description="x and y on the site, metres")


class SlamConfig(Section):
    """The joint map."""

    reference: str | None = Field(None, description="image whose robot frame is the map; null = first image of the first robot")
    height_sigma: float | None = Field(None, gt=0, le=100, description="how far single pictures' heights may be off their robot's, metres; null = judged by the data")
    scale_sigma: float = Field(0.005, gt=0, le=1, description="uncertainty of the configured heights, hence of the map's scale, relative")
    tilt_sigma_deg: float = Field(3.0, gt=0, le=45, description="uncertainty of a robot's configured tilt, degrees")
    roll_sigma_deg: float = Field(3.0, gt=0, le=45, description="uncertainty of a robot's configured roll, degrees")
    control: Controls = Field((), description="known ground points, each {image, pixel, map}: two or more fix scale and frame of the map")
    loops: bool = Field(True, description="look for more pairs where the map shows common ground")


class MosaicConfig(Section):
    """The overhead map."""

    resolution: float = Field(0.005, gt=0, le=10, description="metres per pixel")
    blend: Literal["robust", "half", "best"] = Field("robust", description="robust = median of the views that show ground, half = mean of the half nearest the mean, best = sharpest view")


class ReconstructConfig(Section):
    """Obstacles in 3D."""

    grid: Grid = Field((200, 200, 100), description="voxels along x, y, z")
    iterations: int = Field(1500, ge=1, le=1_000_000, description="at most this many evolution steps")
    method: Literal["level-set", "visual-hull", "voxel-coloring", "space-carving"] = Field("level-set", description="how the volume is found")
    evolution: Literal["volume", "layers"] = Field("volume", description="level set in 3D, or in layers one above the other")


class Config(Section):
    """Everything a run depends on; paths are absolute and cameras are numbers once loaded."""

    cameras: dict[str, CameraConfig] = Field(min_length=1, description="intrinsics by name; or the path of a calibration file")
    robots: dict[str, RobotConfig] = Field(min_length=1, description="robots by name; the first one's first image is the map's origin")
    output: FilePath = Field(Path("runs"), description="folder of the artefacts; relative to this file or absolute")
    seed: int = Field(0, ge=0, le=2**63 - 1, description="start of all random choices")
    match: MatchConfig = MatchConfig()
    overlap: OverlapConfig = OverlapConfig()
    slam: SlamConfig = SlamConfig()
    mosaic: MosaicConfig = MosaicConfig()
    reconstruct: ReconstructConfig = ReconstructConfig()
# fmt: on


def sees_ground(camera: CameraConfig, tilt_deg: float, roll_deg: float) -> bool:
    """Whether any corner of the image lies below the horizon.

    Parameters
    ----------
    camera : CameraConfig
        Intrinsics; distortion is left out of account.
    tilt_deg, roll_deg : float
        Degrees, as configured.
    """
    tilt, roll = radians(tilt_deg), radians(roll_deg)
    down = (cos(tilt) * sin(roll), cos(tilt) * cos(roll), sin(tilt))  # in camera axes
    for u in (-0.5, camera.width - 0.5):
        for v in (-0.5, camera.height - 0.5):
            y = (v - camera.cy) / camera.fy
            x = (u - camera.cx - camera.skew * y) / camera.fx
            if down[0] * x + down[1] * y + down[2] > 0:
                return True
    return False
