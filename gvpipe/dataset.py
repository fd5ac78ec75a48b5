"""The images of a run: which there are, which cannot be used and why, and their pixels."""

from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from math import radians
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvpipe.config import AUTO_TILT_DEG, CameraConfig, Config, OverrideConfig, RobotConfig
from gvpipe.core.types import Camera, Mount, Pose, View
from gvpipe.errors import ConfigError, InputError
from gvpipe.examine import FoundImage, examine
from gvpipe.filelist import list_files
from gvpipe.formats.files import file_sha256
from gvpipe.knownposes import known_poses, pose_file
from gvpipe.names import escape, nearest
from gvpipe.pixels import PixelSource, PixelStore, inside_photograph


@dataclass(frozen=True)
class ImageEntry:
    """One usable image.

    Attributes
    ----------
    image_id : str
        ``robot/file name``, or ``robot/file name#frame`` in a video; printable UTF-8.
    robot : str
        Name of the robot.
    camera : Camera
        Intrinsics of the undistorted image.
    mount : Mount
        How the camera was held, as configured for this image.
    sha256 : str
        Of the file's bytes (of the whole video), hexadecimal.
    size_bytes : int
        Of the file.
    exif_orientation : int or None
        As tagged; never applied.
    source : PixelSource
        Where the pixels come from.
    """

    image_id: str
    robot: str
    camera: Camera
    mount: Mount
    sha256: str
    size_bytes: int
    exif_orientation: int | None
    source: PixelSource


@dataclass(frozen=True)
class Skipped:
    """An image that cannot be used, and why."""

    image: str
    reason: str


@dataclass(frozen=True)
class Dataset:
    """What every stage sees of the input; can be sent to worker processes.

    Attributes
    ----------
    entries : tuple of ImageEntry
        Usable images, robots in the order of the configuration, each in natural order.
    skipped : tuple of Skipped
        The others.
    poses : dict of str to Pose
        Known map_from_camera by image id, for robots that have them.
    pose_files : dict of str to str
        SHA-256 of each robot's pose file, by robot.
    """

    entries: tuple[ImageEntry, ...]
    skipped: tuple[Skipped, ...] = ()
    poses: Mapping[str, Pose] = field(default_factory=dict)
    pose_files: Mapping[str, str] = field(default_factory=dict)
    _by_id: dict[str, ImageEntry] = field(init=False, repr=False, compare=False)
    _pixels: PixelStore = field(init=False, repr=False, compare=False, default_factory=PixelStore)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_by_id", {entry.image_id: entry for entry in self.entries})

    @property
    def robots(self) -> dict[str, tuple[ImageEntry, ...]]:
        """Usable images of each robot."""
        robots: dict[str, list[ImageEntry]] = {}
        for entry in self.entries:
            robots.setdefault(entry.robot, []).append(entry)
        return {name: tuple(entries) for name, entries in robots.items()}

    def entry(self, image_id: str) -> ImageEntry:
        """Look a usable image up; KeyError if there is none of that id."""
        return self._by_id[image_id]

    def view(self, image_id: str) -> View:
        """Read an image: decoded, undistorted, with its camera and mount.

        Raises
        ------
        KeyError
            If there is no usable image of that id.
        InputError
            If the file is gone or is not the one that was opened.
        """
        entry = self._by_id[image_id]
        return View(image_id, self._pixels.read(entry.source), entry.camera, entry.mount)

    def inside(self, image_id: str) -> NDArray[np.bool_] | None:
        """Where a view shows the photograph, (H, W) bool, not its continued border; None = all."""
        return inside_photograph(self._by_id[image_id].source)


def open_dataset(config: Config, *, jobs: int = 1) -> Dataset:
    """List, read and check all images once.

    Parameters
    ----------
    config : Config
        As loaded.
    jobs : int
        Threads that decode.

    Returns
    -------
    dataset : Dataset
        The same for any number of jobs.

    Raises
    ------
    InputError
        If a robot has no usable image, two images share an id, or known poses do not fit.
    ConfigError
        If the configuration names an image that is not there.
    """
    entries: list[ImageEntry] = []
    skipped: list[Skipped] = []
    poses: dict[str, Pose] = {}
    pose_files: dict[str, str] = {}
    with ThreadPoolExecutor(max_workers=max(jobs, 1)) as pool:
        for name, robot in config.robots.items():
            files = _files_of(name, robot)
            found = [item for items in pool.map(examine, files) for item in items]
            _check_names(name, robot, found)
            outcomes = [_outcome(name, robot, config.cameras, item) for item in found]
            entries += [o for o in outcomes if isinstance(o, ImageEntry)]
            skipped += [o for o in outcomes if isinstance(o, Skipped)]
            if not any(isinstance(o, ImageEntry) for o in outcomes):
                raise InputError(_nothing_usable(name, robot, outcomes))
            if robot.poses is not None:
                heights = {
                    _image_id(name, item): _mount(robot, _override(robot, item)).height
                    for item in found
                    if item.counts
                }
                key = f"robots.{name}.height"
                poses |= known_poses(robot.poses, robot.images, heights, key)
                pose_files[name] = file_sha256(pose_file(robot.poses))[0]
    _check_ids(config, [e.image_id for e in entries] + [s.image for s in skipped])
    usable = {entry.image_id for entry in entries}
    known = {image_id: pose for image_id, pose in poses.items() if image_id in usable}
    return Dataset(tuple(entries), tuple(skipped), known, pose_files)


def _files_of(name: str, robot: RobotConfig) -> list[tuple[Path, bool]]:
    """Files of a robot, each with whether it was named (not just met in a folder)."""
    try:
        return [(path, not robot.images.is_dir()) for path in list_files(robot.images)]
    except InputError as error:
        raise InputError(f"robots.{name}.images: {error}") from error


def _image_id(robot: str, item: FoundImage) -> str:
    return f"{robot}/{escape(item.name)}"


def _check_names(name: str, robot: RobotConfig, found: Iterable[FoundImage]) -> None:
    """Each image has a name of its own, and each override an image."""
    paths: dict[str, Path] = {}
    names: set[str] = set()
    for item in found:
        image_id = _image_id(name, item)
        if image_id in paths:
            both = f"{escape(str(paths[image_id]))} and {escape(str(item.path))}"
            raise InputError(f"robots.{name}.images: {both} are both called {image_id}")
        paths[image_id] = item.path
        names |= {escape(item.name), escape(item.path.name)}
    where = escape(str(robot.images))
    lines = [
        f"robots.{name}.overrides.{escape(key)}: no such image in {where}{nearest(key, names)}"
        for key in robot.overrides
        if key not in names
    ]
    if lines:
        raise ConfigError("\n".join(lines))


def _outcome(
    name: str, robot: RobotConfig, cameras: Mapping[str, CameraConfig], item: FoundImage
) -> ImageEntry | Skipped:
    """Join a file with the configuration."""
    image_id = _image_id(name, item)
    if item.problem:
        return Skipped(image_id, item.problem)
    over = _override(robot, item)
    camera_name = over.camera or robot.camera
    config = cameras[camera_name]
    if (item.width, item.height) != (config.width, config.height):
        have, want = f"{item.width}x{item.height}", f"{config.width}x{config.height}"
        return Skipped(image_id, f"is {have}, but camera {camera_name} is {want}")
    camera = Camera(
        config.width, config.height, config.fx, config.fy, config.cx, config.cy, config.skew
    )
    distortion = config.distortion if any(config.distortion) else ()
    return ImageEntry(
        image_id=image_id,
        robot=name,
        camera=camera,
        mount=_mount(robot, over),
        sha256=item.sha256,
        size_bytes=item.size_bytes,
        exif_orientation=item.orientation,
        source=PixelSource(item.path, item.frame, item.sha256, camera, distortion),
    )


def _override(robot: RobotConfig, item: FoundImage) -> OverrideConfig:
    """Look up what differs for a file, or for a frame."""
    over = robot.overrides.get(escape(item.name)) or robot.overrides.get(escape(item.path.name))
    return over or OverrideConfig()


def _mount(robot: RobotConfig, over: OverrideConfig) -> Mount:
    """How the camera is held, in radians and metres."""
    tilt = robot.tilt if over.tilt is None else over.tilt
    return Mount(
        tilt=radians(AUTO_TILT_DEG if tilt == "auto" else tilt),
        roll=radians(robot.roll if over.roll is None else over.roll),
        height=robot.height if over.height is None else over.height,
        tilt_known=tilt != "auto",
    )


def _nothing_usable(name: str, robot: RobotConfig, outcomes: Iterable[ImageEntry | Skipped]) -> str:
    """Say why a robot has no image."""
    reasons = [f"{o.image}: {o.reason}" for o in outcomes if isinstance(o, Skipped)]
    detail = f"; {len(reasons)} skipped, the first is {reasons[0]}" if reasons else ""
    return f"robots.{name}.images: {escape(str(robot.images))}: no usable image{detail}"


def _check_ids(config: Config, ids: list[str]) -> None:
    """Images named in the configuration must exist, usable or not."""
    pairs = config.match.pairs if isinstance(config.match.pairs, tuple) else ()
    named = [(f"match.pairs.{k}", image_id) for k, pair in enumerate(pairs) for image_id in pair]
    if config.slam.reference is not None:
        named.append(("slam.reference", config.slam.reference))
    named += [(f"slam.control.{k}.image", p.image) for k, p in enumerate(config.slam.control)]
    known = set(ids)
    lines = [
        f"{key}: {escape(image_id)}: no such image{nearest(image_id, ids)}"
        for key, image_id in named
        if image_id not in known
    ]
    if lines:
        raise ConfigError("\n".join(lines))
