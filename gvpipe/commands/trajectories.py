"""Trajectories from whatever file they are in, and which pose belongs to which."""

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gvpipe.core.types import Camera, Pose, Rejected
from gvpipe.errors import InputError
from gvpipe.formats.colmap import read_cameras, read_images
from gvpipe.formats.files import read_regular_file
from gvpipe.formats.kitti import read_kitti
from gvpipe.formats.tum import read_tum
from gvpipe.names import escape
from gvpipe.report import log

MOST_JSON_BYTES = 256 << 20


@dataclass(frozen=True)
class Trajectory:
    """Camera poses of one file.

    Attributes
    ----------
    source : str
        The file, for messages.
    poses : tuple of Pose
        Camera to map.
    stamps : tuple of float, optional
        Time of each, where the file has it.
    names : tuple of str, optional
        Image of each, where the file has it.
    cameras : tuple of Camera, optional
        Intrinsics of each, where the file has them.
    """

    source: str
    poses: tuple[Pose, ...]
    stamps: tuple[float, ...] | None = None
    names: tuple[str, ...] | None = None
    cameras: tuple[Camera, ...] | None = None


def read_trajectory(path: Path) -> Trajectory:
    """Read poses by what the file looks like.

    Parameters
    ----------
    path : Path
        A TUM or KITTI file, ``slam.json``, ``groundtruth.json`` of ``gvpipe synth``, or the
        folder of a COLMAP text model.

    Raises
    ------
    InputError
        If it is none of these, is damaged, or holds no pose.
    """
    if path.is_dir() or path.name == "images.txt":
        found = _colmap(path if path.is_dir() else path.parent)
    elif path.suffix == ".json":
        found = _json(path)
    elif _columns(path) == 12:
        found = Trajectory(escape(str(path)), tuple(read_kitti(path)))
    else:
        rows = read_tum(path)
        stamps, poses = tuple(t for t, _ in rows), tuple(p for _, p in rows)
        found = Trajectory(escape(str(path)), poses, stamps=stamps)
    if not found.poses:
        raise InputError(f"{found.source}: holds no pose")
    return found


def _columns(path: Path) -> int:
    """Count the words of the first line that is no comment; 0 if the file cannot be read."""
    head = read_regular_file(path, 0, first=1 << 16)
    if isinstance(head, Rejected):
        return 0
    lines = (line for line in head.splitlines() if line.strip() and not line.startswith(b"#"))
    return len(next(lines, b"").split())


def _colmap(folder: Path) -> Trajectory:
    images = read_images(folder / "images.txt")
    images.sort(key=lambda image: image.name)
    known = read_cameras(folder / "cameras.txt") if (folder / "cameras.txt").exists() else {}
    cameras = None
    if all(image.camera in known for image in images):
        found = [known[image.camera] for image in images]
        cameras = tuple(Camera(c.width, c.height, c.fx, c.fy, c.cx, c.cy, c.skew) for c in found)
    return Trajectory(
        escape(str(folder)),
        tuple(image.map_from_camera for image in images),
        names=tuple(image.name for image in images),
        cameras=cameras,
    )


def load_json(path: Path) -> dict[str, Any]:
    """Read a JSON object of bounded size.

    Raises
    ------
    InputError
        If it cannot be read or is none.
    """
    raw = read_regular_file(path, MOST_JSON_BYTES)
    if isinstance(raw, Rejected):
        raise InputError(f"{escape(str(path))}: {raw.reason}")
    try:
        document = json.loads(raw)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{escape(str(path))}: is not JSON: {error}") from error
    if not isinstance(document, dict):
        raise InputError(f"{escape(str(path))}: expected a JSON object")
    return document


def _json(path: Path) -> Trajectory:
    """Poses of slam.json or groundtruth.json."""
    document, source = load_json(path), escape(str(path))
    key, convert = ("poses", _slam_pose) if "poses" in document else ("images", _true_pose)
    rows = document.get(key)
    if not isinstance(rows, list):
        raise InputError(f"{source}: has neither poses (slam.json) nor images (groundtruth.json)")
    try:
        if key == "poses":
            rows = _largest_component(rows)
        poses = tuple(convert(row) for row in rows)
        names = tuple(str(row["image"] if "image" in row else row["file"]) for row in rows)
        cameras = tuple(map(_camera, rows)) if all("K" in row for row in rows) else None
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{source}: {key}: {type(error).__name__}: {error}") from error
    if not all(np.isfinite(p.rotation).all() and np.isfinite(p.translation).all() for p in poses):
        raise InputError(f"{source}: {key}: a pose is not finite")
    return Trajectory(source, poses, names=names, cameras=cameras)


def _largest_component(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Keep the map with most images: coordinates of different maps do not compare."""
    counts: dict[int, int] = {}
    for row in rows:
        counts[row["component"]] = counts.get(row["component"], 0) + 1
    main = min(counts, key=lambda component: (-counts[component], component), default=0)
    return [row for row in rows if row["component"] == main]


def _arrays(row: dict[str, Any]) -> Pose:
    return Pose(np.array(row["R"], float).reshape(3, 3), np.array(row["t"], float).reshape(3))


def _slam_pose(row: dict[str, Any]) -> Pose:
    return _arrays(row)


def _true_pose(row: dict[str, Any]) -> Pose:
    return _arrays(row).inverse()


def _camera(row: dict[str, Any]) -> Camera:
    k = np.array(row["K"], float).reshape(3, 3)
    numbers = (float(v) for v in (k[0, 0], k[1, 1], k[0, 2], k[1, 2], k[0, 1]))
    return Camera(int(row["width"]), int(row["height"]), *numbers)


def associate(
    estimate: Trajectory, reference: Trajectory, max_gap_s: float
) -> list[tuple[int, int]]:
    """Pair the poses of two trajectories.

    Parameters
    ----------
    estimate, reference : Trajectory
        By image names if both have them; where these do not fit or are missing, by time if both
        have it; by order only where names or times are missing, for they would contradict it.
    max_gap_s : float
        Largest difference of paired times.

    Returns
    -------
    pairs : list of (int, int)
        Indices, in the order of the estimate; no pose is used twice.

    Raises
    ------
    InputError
        If nothing fits together.
    """
    both = f"{estimate.source} and {reference.source}"
    pairs: list[tuple[int, int]] = []
    if estimate.names and reference.names:
        pairs = _by_name(estimate.names, reference.names)
    if not pairs and estimate.stamps and reference.stamps:
        pairs = _by_time(estimate.stamps, reference.stamps, max_gap_s)
    if pairs:
        return pairs
    if estimate.names and reference.names:
        first = f"{escape(estimate.names[0])} and {escape(reference.names[0])} begin them"
        hint = "expected the same names, or TUM or KITTI files, which go by time or order"
        raise InputError(f"{both}: no image names agree ({first}); {hint}")
    if estimate.stamps and reference.stamps:
        first = f"{estimate.stamps[0]!r} and {reference.stamps[0]!r} s begin them"
        raise InputError(f"{both}: no times within {max_gap_s:g} s of each other; {first}")
    if len(estimate.poses) != len(reference.poses):
        counts = f"{len(estimate.poses)} and {len(reference.poses)} poses"
        raise InputError(f"{both}: {counts}; expected names or times in both, or as many poses")
    return [(k, k) for k in range(len(estimate.poses))]


def _by_name(estimate: Sequence[str], reference: Sequence[str]) -> list[tuple[int, int]]:
    """Pair equal names, else the longest common endings, else files of one name within robots."""
    keys: list[Callable[[str], str]] = [
        lambda name: name,
        lambda name: "/".join(name.split("/")[-2:]),
        lambda name: name.rsplit("/", 1)[-1],
        lambda name: re.sub(r"\.\w+$", "", name.rsplit("/", 1)[-1]),
    ]
    for key in keys:
        table = {key(name): k for k, name in enumerate(reference)}
        unique = len(table) == len(reference) and len({*map(key, estimate)}) == len(estimate)
        pairs = [(k, table[key(name)]) for k, name in enumerate(estimate) if key(name) in table]
        if unique and pairs:
            return pairs
    return _within_robots(estimate, reference)


def _within_robots(estimate: Sequence[str], reference: Sequence[str]) -> list[tuple[int, int]]:
    """Pair files of one name in folders that come at the same place: robots called otherwise."""
    folders, true_folders = (
        list(dict.fromkeys(name.rpartition("/")[0] for name in names))
        for names in (estimate, reference)
    )
    if len(folders) != len(true_folders):
        return []
    table = {name: k for k, name in enumerate(reference)}
    there = dict(zip(folders, true_folders, strict=True))
    pairs = []
    for k, name in enumerate(estimate):
        folder, _, file = name.rpartition("/")
        found = table.get(f"{there[folder]}/{file}")
        if found is not None:
            pairs.append((k, found))
    if pairs:
        taken = ", ".join(f"{escape(a)} = {escape(b)}" for a, b in there.items())
        log.info("robots are taken in their order: %s", taken)
    return pairs


def _by_time(
    estimate: Sequence[float], reference: Sequence[float], max_gap_s: float
) -> list[tuple[int, int]]:
    """Pair nearest times, the closest first, each once."""
    order = np.argsort(reference, kind="stable")
    times = np.asarray(reference)[order]
    gaps = []
    for k, stamp in enumerate(estimate):
        at = int(np.searchsorted(times, stamp))
        near = [n for n in range(max(at - 2, 0), min(at + 2, len(times)))]
        gaps += [(abs(float(times[n]) - stamp), k, int(order[n])) for n in near]
    used_i: set[int] = set()
    used_j: set[int] = set()
    pairs = []
    for gap, i, j in sorted(gaps):
        if gap <= max_gap_s and i not in used_i and j not in used_j:
            used_i.add(i)
            used_j.add(j)
            pairs.append((i, j))
    return sorted(pairs)


def paired(
    estimate: Path, reference: Path, max_gap_s: float
) -> tuple[list[Pose], list[Pose], list[str]]:
    """Read two files; poses that belong together, and what they are called."""
    first, second = read_trajectory(estimate), read_trajectory(reference)
    pairs = associate(first, second, max_gap_s)
    names = [
        first.names[i] if first.names else repr(first.stamps[i]) if first.stamps else str(i)
        for i, _ in pairs
    ]
    return [first.poses[i] for i, _ in pairs], [second.poses[j] for _, j in pairs], names
