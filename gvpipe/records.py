"""The typed content of every JSON artefact: what one stage hands to the next.

Angles are in degrees and lengths in metres, as the files have them. Arrays are checked for shape
and finiteness when a record is made, so a file that lies is refused where it is read.
"""

from collections.abc import Callable, Iterator
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, PlainSerializer, PlainValidator, WithJsonSchema

from gvpipe.core.types import Float


def _shaped(*shape: int | None) -> Callable[[Any], NDArray[np.float64]]:
    """Make a validator for finite float arrays of a shape; None leaves a size open."""

    def validate(value: Any) -> NDArray[np.float64]:
        try:
            array = np.array(value, dtype=np.float64)
        except (TypeError, ValueError):
            raise ValueError(f"expected numbers of shape {shape}") from None
        if array.size == 0 and None in shape:
            array = array.reshape([0 if n is None else n for n in shape])
        if array.ndim != len(shape) or any(
            want not in (None, have) for want, have in zip(shape, array.shape, strict=True)
        ):
            raise ValueError(f"expected shape {shape}, found {array.shape}")
        if not np.isfinite(array).all():
            raise ValueError("expected finite numbers")
        array.setflags(write=False)
        return array

    return validate


_as_lists = PlainSerializer(lambda array: array.tolist(), return_type=list)
_schema = WithJsonSchema({"type": "array"})
Matrix3 = Annotated[Float, PlainValidator(_shaped(3, 3)), _as_lists, _schema]
Matrix6 = Annotated[Float, PlainValidator(_shaped(6, 6)), _as_lists, _schema]
Vector3 = Annotated[Float, PlainValidator(_shaped(3)), _as_lists, _schema]
Polygon = Annotated[Float, PlainValidator(_shaped(None, 2)), _as_lists, _schema]


class Record(BaseModel):
    """Base of all rows: frozen, strict about keys, free of NaN."""

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        allow_inf_nan=False,
        arbitrary_types_allowed=True,
        populate_by_name=True,
    )

    def named_images(self) -> Iterator[str]:
        """List the images that this row and the rows in it name."""
        for key in type(self).model_fields:
            value = getattr(self, key)
            if key in ("image", "image_i", "image_j", "reference") and value is not None:
                yield value
            elif key == "images":
                yield from value
            elif isinstance(value, tuple):
                for row in value:
                    yield from row.named_images() if isinstance(row, Record) else ()


class SkippedImage(Record):
    """An image that could not be used."""

    image: str
    reason: str


class Header(Record):
    """What every JSON artefact begins with: provenance and freshness."""

    schema_id: str = Field(alias="schema")
    gvpipe_version: str
    config_sha256: str
    inputs: dict[str, str]
    files: dict[str, str]
    seed: int
    units: Literal["metre"] = "metre"
    scale_source: Literal["height", "poses", "control"]
    wall_s: float
    content_sha256: str = ""
    skipped: tuple[SkippedImage, ...]
    reason: str | None = None


class Body(Record):
    """Base of the stage's own part of an artefact.

    `stage` names the command and its folder, `file` the JSON in that folder.
    """

    stage: ClassVar[str]
    file: ClassVar[str]


class PairRow(Record):
    """One pair of `match.json`."""

    image_i: str
    image_j: str
    status: Literal["ok", "rejected"]
    reason: str | None = None
    probability: float | None = None
    H: Matrix3 | None = None
    inliers: int = 0
    candidates: int = 0
    trials: int = 0
    error_px: float | None = None
    H_initial: Matrix3 | None = None
    overhead: Matrix3 | None = None
    tilt_i_deg: float | None = None
    tilt_j_deg: float | None = None


class MatchBody(Body):
    """Ground homographies between pairs of pictures."""

    stage: ClassVar[str] = "match"
    file: ClassVar[str] = "match.json"
    pairs: tuple[PairRow, ...]


class GammaRow(Record):
    """The thesis' location triplet, with its angle convention."""

    rho_heights: float
    phi1_deg: float
    phi2_deg: float


class MotionFields(Record):
    """Motion between two cameras, as both methods give it."""

    R: Matrix3
    t: Vector3
    normal: Vector3
    tilt_i_deg: float
    tilt_j_deg: float
    yaw_deg: float
    distance_m: float
    gamma: GammaRow


class MotionRow(MotionFields):
    """One motion of `localize.json`."""

    image_i: str
    image_j: str
    geometric: MotionFields
    covariance: Matrix6


class LocalizeBody(Body):
    """Relative camera poses of matched pairs."""

    stage: ClassVar[str] = "localize"
    file: ClassVar[str] = "localize.json"
    motions: tuple[MotionRow, ...]


class UnregisteredRow(Record):
    """An image that could not be used or is on no map, and why."""

    image: str
    reason: str


class CandidateRow(Record):
    """One candidate overlap between two robots."""

    image_i: str
    image_j: str
    distance: float
    validated: bool
    reason: str | None = None
    inliers: int = 0
    H: Matrix3 | None = None


class OverlapRow(Record):
    """The candidates of one pair of robots, best first."""

    robots: tuple[str, str]
    candidates: tuple[CandidateRow, ...]


class OverlapBody(Body):
    """Pictures of different robots that show the same ground."""

    stage: ClassVar[str] = "overlap"
    file: ClassVar[str] = "overlap.json"
    overlaps: tuple[OverlapRow, ...]
    left_out: tuple[UnregisteredRow, ...] = ()


class PoseRow(Record):
    """One camera on the map."""

    image: str
    robot: str
    component: int
    R: Matrix3
    t: Vector3
    x: float
    y: float
    yaw_deg: float
    tilt_deg: float
    roll_deg: float
    height_m: float
    covariance: Matrix6


class EdgeRow(Record):
    """One constraint between two cameras of the map."""

    image_i: str
    image_j: str
    kind: Literal["odometry", "loop", "overlap"]
    residual_m: float


class RejectedEdgeRow(Record):
    """A constraint that contradicts the others and was left out."""

    image_i: str
    image_j: str
    kind: Literal["odometry", "loop", "overlap"]
    reason: str


class ClosingRow(Record):
    """Closing error of one loop or overlap by plain concatenation and after adjustment."""

    image_i: str
    image_j: str
    concatenated_m: float
    adjusted_m: float


class ControlRow(Record):
    """How far a known ground point is from where the map sees it."""

    image: str
    component: int
    error_px: float
    error_m: float


class SlamBody(Body):
    """All robots on metric maps, one for each connected component."""

    stage: ClassVar[str] = "slam"
    file: ClassVar[str] = "slam.json"
    reference: str | None
    poses: tuple[PoseRow, ...]
    edges: tuple[EdgeRow, ...]
    rejected_edges: tuple[RejectedEdgeRow, ...] = ()
    closing: tuple[ClosingRow, ...] = ()
    control: tuple[ControlRow, ...] = ()
    components: int
    unregistered: tuple[UnregisteredRow, ...]


class MosaicPart(Record):
    """The overhead map of one component; `suffix` ends the names of its files."""

    component: int
    suffix: str
    map_from_pixel: Matrix3
    width: int
    height: int
    images: tuple[str, ...]
    coverage_m2: float


class MosaicBody(Body):
    """The overhead map of the main component; `components` lists it and the others."""

    stage: ClassVar[str] = "mosaic"
    file: ClassVar[str] = "mosaic.json"
    component: int
    resolution: float
    map_from_pixel: Matrix3
    blend: str
    width: int
    height: int
    images: tuple[str, ...]
    coverage_m2: float
    components: tuple[MosaicPart, ...] = ()
    error_levels_per_step: float = 0.125


class ObstacleRow(Record):
    """One obstacle standing on the ground.

    `confidence`, 0 to 1, is the mean over `views` views of intersection over union of the
    obstacle's picture and the view's silhouette near it; `azimuth_span_deg` is the smallest
    angle, seen from above, that holds the directions in which these views lie.
    """

    id: int
    footprint: Polygon
    height_m: float
    volume_m3: float
    centroid: Vector3
    confidence: float
    views: int
    azimuth_span_deg: float


class ReconstructBody(Body):
    """Obstacles in 3D."""

    stage: ClassVar[str] = "reconstruct"
    file: ClassVar[str] = "obstacles.json"
    method: str
    obstacles: tuple[ObstacleRow, ...]
    energy: tuple[tuple[int, float], ...]
    iterations: int
    converged: bool


class ReportedStage(Record):
    """Whether a stage's artefact is in the report, and if not, why."""

    stage: str
    shown: bool
    reason: str | None = None


class ReportBody(Body):
    """What the report's page was made from."""

    stage: ClassVar[str] = "report"
    file: ClassVar[str] = "report.json"
    stages: tuple[ReportedStage, ...]
    warnings: tuple[str, ...]
