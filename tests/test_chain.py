"""The whole chain on a tiny set: truth, contract, freshness, determinism, exit codes."""

import hashlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from gvpipe.cli import run
from gvpipe.core.geometry.homography import apply, transfer_errors
from gvpipe.core.matching.features import Features, MatchOptions
from gvpipe.core.mosaic.occupancy import OCCUPIED
from gvpipe.core.types import View
from gvpipe.formats.occupancy import read_pgm
from gvpipe.stages import pairing
from tests.conftest import BOX_HIGH, STAGES, TinySet, make_tiny_set
from tests.synthetic import CAMERA, common_ground, true_homography

HEADER = {
    "schema",
    "gvpipe_version",
    "config_sha256",
    "inputs",
    "seed",
    "units",
    "scale_source",
    "wall_s",
    "skipped",
}
CONTRACT = {
    "match": {"pairs"},
    "localize": {"motions"},
    "overlap": {"overlaps"},
    "slam": {"poses", "edges", "components", "unregistered"},
    "mosaic": {"resolution", "map_from_pixel", "blend", "width", "height", "images"},
    "reconstruct": {"obstacles", "energy", "iterations"},
}
FILES = {
    "match": {"match.json", "match.npz"},
    "localize": {"localize.json"},
    "overlap": {"overlap.json", "overlap.npz"},
    "slam": {"slam.json", "A.tum", "B.tum", "location_graph.svg"},
    "mosaic": {"mosaic.png", "mosaic.json", "map.pgm", "map.yaml"},
    "reconstruct": {
        "obstacles.ply",
        "obstacles.glb",
        "points.ply",
        "volume.npz",
        "obstacles.json",
        "map.pgm",
        "map.yaml",
        "turntable.png",
        "evolution.png",
        "terms.png",
    },
}
ROWS = {
    ("match", "pairs"): "image_i image_j status reason H inliers candidates trials error_px "
    "H_initial overhead tilt_i_deg tilt_j_deg",
    ("localize", "motions"): "image_i image_j R t normal tilt_i_deg tilt_j_deg yaw_deg "
    "distance_m gamma geometric covariance",
    ("overlap", "overlaps"): "robots candidates",
    ("slam", "poses"): "image robot component R t x y yaw_deg tilt_deg roll_deg height_m "
    "covariance",
    ("slam", "edges"): "image_i image_j kind residual_m",
    ("reconstruct", "obstacles"): "id footprint height_m volume_m3 centroid confidence views",
}


def align(chain: TinySet) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Map to world: the rotation about z and shift that fit the camera centres best."""
    rows = chain.document("slam")["poses"]
    got = np.array([row["t"] for row in rows])
    want = np.array([chain.poses[row["image"]].translation for row in rows])
    a, b = got[:, :2] - got[:, :2].mean(0), want[:, :2] - want[:, :2].mean(0)
    angle = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    c, s = np.cos(angle), np.sin(angle)
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    shift = want.mean(0) - rotation @ got.mean(0)
    return rotation, np.array([*shift[:2], 0.0]), got, want


@pytest.mark.parametrize("stage", STAGES)
def test_every_promised_file_and_key_exists(chain: TinySet, stage: str) -> None:
    document = chain.document(stage)
    assert HEADER | CONTRACT[stage] <= document.keys()
    assert document["schema"] == f"gvpipe/{stage}/1"
    assert document["units"] == "metre"
    assert FILES[stage] <= {p.name for p in (chain.out() / stage).iterdir()}
    for (of, key), names in ROWS.items():
        if of == stage:
            assert document[key], key
            for row in document[key]:
                assert set(names.split()) <= row.keys()


def test_inputs_are_the_images_digests(chain: TinySet) -> None:
    inputs = chain.document("match")["inputs"]
    folder = chain.config.parent
    for image in chain.poses:
        assert inputs[image] == hashlib.sha256((folder / image).read_bytes()).hexdigest()


def test_all_pairs_match_and_are_right(chain: TinySet) -> None:
    rows = chain.document("match")["pairs"]
    assert all(row["status"] == "ok" for row in rows)
    with np.load(chain.out() / "match" / "match.npz", allow_pickle=False) as arrays:
        for k, row in enumerate(rows):
            assert len(arrays[f"{k}/points_i"]) == row["inliers"]
    for row in rows:
        i, j = chain.poses[row["image_i"]], chain.poses[row["image_j"]]
        true = true_homography(i, j, CAMERA, CAMERA)
        points = common_ground(true, i, CAMERA, CAMERA)
        assert transfer_errors(np.array(row["H"]), points, apply(true, points)).mean() < 1.0


def test_motions_are_true(chain: TinySet) -> None:
    rows = chain.document("localize")["motions"]
    assert len(rows) == len(chain.document("match")["pairs"])
    for row in rows:
        i, j = chain.poses[row["image_i"]], chain.poses[row["image_j"]]
        j_from_i = j.inverse() @ i
        assert np.abs(np.array(row["R"]) - j_from_i.rotation).max() < 0.03
        assert np.abs(np.array(row["t"]) - j_from_i.translation).max() < 0.03
        assert abs(row["distance_m"] - np.linalg.norm((i.translation - j.translation)[:2])) < 0.02


def test_one_map_within_a_centimetre(chain: TinySet) -> None:
    slam = chain.document("slam")
    assert slam["components"] == 1
    assert {row["image"] for row in slam["poses"]} == chain.poses.keys()
    rotation, shift, got, want = align(chain)
    assert np.sqrt((((got @ rotation.T + shift) - want) ** 2).sum(1).mean()) < 0.01
    for row in slam["poses"]:
        assert row["height_m"] == pytest.approx(0.6, abs=0.02)
        assert row["tilt_deg"] == pytest.approx(42.0, abs=0.5)
    assert any(edge["kind"] == "overlap" for edge in slam["edges"])


def test_map_frame_is_the_reference_robots(chain: TinySet) -> None:
    first = next(r for r in chain.document("slam")["poses"] if r["image"] == "A/0.png")
    assert np.abs(np.array(first["t"])[:2]).max() < 1e-9
    assert abs(np.array(first["R"])[1, 2]) < 1e-9  # the optical axis lies above the x axis


def test_trajectory_files_hold_the_poses(chain: TinySet) -> None:
    rows = {r["image"]: r for r in chain.document("slam")["poses"]}
    for robot in "AB":
        lines = [
            [float(v) for v in line.split()]
            for line in (chain.out() / "slam" / f"{robot}.tum").read_text().splitlines()
            if not line.startswith("#")
        ]
        ids = sorted(i for i in rows if i.startswith(robot))
        assert len(lines) == len(ids)
        for line, image in zip(lines, ids, strict=True):
            assert np.allclose(line[1:4], rows[image]["t"])
            x, y, z, w = line[4:]
            r = np.array(rows[image]["R"])
            assert w * w + x * x + y * y + z * z == pytest.approx(1.0)
            assert r[2, 1] - r[1, 2] == pytest.approx(4 * w * x, abs=1e-9)


def test_mosaic_and_ros_map_agree(chain: TinySet) -> None:
    body = chain.document("mosaic")
    data = np.frombuffer((chain.out() / "mosaic" / "mosaic.png").read_bytes(), np.uint8)
    picture = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    assert picture.shape == (body["height"], body["width"], 4)
    assert (picture[..., 3] > 0).mean() > 0.2
    pgm = (chain.out() / "mosaic" / "map.pgm").read_bytes()
    assert pgm.startswith(b"P5")
    assert set(np.frombuffer(pgm[-body["width"] * body["height"] :], np.uint8)) <= {0, 205, 254}


def test_the_box_is_found(chain: TinySet) -> None:
    obstacles = chain.document("reconstruct")["obstacles"]
    assert len(obstacles) == 1
    # cameras of one height leave a low roof on a flat top, as high as the hull of true silhouettes
    assert BOX_HIGH[2] - 0.01 < obstacles[0]["height_m"] < BOX_HIGH[2] + 0.05
    rotation, shift, *_ = align(chain)
    centre = rotation @ np.array(obstacles[0]["centroid"]) + shift
    assert np.abs(centre[:2]).max() < 0.03
    assert obstacles[0]["volume_m3"] == pytest.approx(0.22 * 0.16 * 0.16, rel=0.4)
    mesh = trimesh.load(chain.out() / "reconstruct" / "obstacles.ply", process=False)
    assert mesh.is_watertight


def test_the_box_stands_in_the_ros_map_of_reconstruct(chain: TinySet) -> None:
    cells = {
        stage: read_pgm((chain.out() / stage / "map.pgm").read_bytes())
        for stage in ("mosaic", "reconstruct")
    }
    assert cells["mosaic"].shape == cells["reconstruct"].shape
    body = chain.document("mosaic")
    (obstacle,) = chain.document("reconstruct")["obstacles"]
    x, y, _ = obstacle["centroid"]
    u, v, _ = np.linalg.inv(np.array(body["map_from_pixel"])) @ (x, y, 1.0)
    assert cells["reconstruct"][round(v), round(u)] == OCCUPIED
    area = (cells["reconstruct"] == OCCUPIED).sum() * body["resolution"] ** 2
    assert area == pytest.approx(0.22 * 0.16, rel=0.5)
    assert obstacle["confidence"] > 0.8
    assert obstacle["views"] > 8
    yaml_of = [(chain.out() / s / "map.yaml").read_text() for s in ("mosaic", "reconstruct")]
    assert yaml_of[0] == yaml_of[1]


@pytest.mark.parametrize("choice", ["evolution=layers", "method=space-carving"])
def test_other_methods_give_the_same_files(chain: TinySet, tmp_path: Path, choice: str) -> None:
    work = tmp_path / "copy"
    shutil.copytree(chain.config.parent, work)
    copy = TinySet(work / chain.config.name, chain.poses)
    command = ["reconstruct", str(copy.config), "--jobs", "1", "-q"]
    assert run([*command, "--set", f"reconstruct.{choice}"]) == 0
    document = copy.document("reconstruct")
    (obstacle,) = document["obstacles"]
    (usual,) = chain.document("reconstruct")["obstacles"]
    assert obstacle["volume_m3"] == pytest.approx(0.22 * 0.16 * 0.16, rel=0.4)
    evolves = choice.startswith("evolution")
    away = 0.01 if evolves else 0.015  # carving leaves the roof that silhouettes cannot see
    assert obstacle["centroid"] == pytest.approx(usual["centroid"], abs=away)
    assert obstacle["confidence"] > 0.8
    energies = [e for _, e in document["energy"]]
    assert (len(energies) > 3) == evolves
    assert (np.diff(energies) <= 0).all()
    pictures = {"evolution.png", "terms.png"}
    names = {p.name for p in (copy.out() / "reconstruct").iterdir()}
    assert names & pictures == (pictures if evolves else set())
    assert names >= FILES["reconstruct"] - pictures
    for name in ("obstacles.ply", "obstacles.glb"):
        path = copy.out() / "reconstruct" / name
        mesh = trimesh.load(path, force="mesh", process=True)
        assert mesh.is_watertight, name
        assert mesh.volume == pytest.approx(obstacle["volume_m3"], rel=1e-3)


def test_pictures_are_described_once_however_pairs_are_split_up(
    tiny: TinySet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    described: list[str] = []
    extract = pairing.extract

    def counted(view: View, options: MatchOptions) -> Features:
        described.append(view.image_id)
        return extract(view, options)

    monkeypatch.setattr(pairing, "extract", counted)
    command = ["match", str(tiny.config), "--set", "match.pairs=exhaustive", "--jobs", "1", "-q"]
    assert run([*command, "--out", str(tmp_path / "whole")]) == 0
    monkeypatch.setattr(pairing, "BLOCK", 5)
    assert run([*command, "--out", str(tmp_path / "parts")]) == 0
    assert sorted(described) == sorted([*tiny.poses, *tiny.poses])
    whole, parts = (tmp_path / name / "match" / "match.npz" for name in ("whole", "parts"))
    assert whole.read_bytes() == parts.read_bytes()


def test_artefacts_do_not_depend_on_jobs_or_place(chain: TinySet, tmp_path: Path) -> None:
    copy = make_tiny_set(tmp_path / "elsewhere")
    environment = {**os.environ, "PYTHONHASHSEED": "1"}
    command = [sys.executable, "-m", "gvpipe", "run", str(copy.config), "--jobs", "2", "-q"]
    subprocess.run(command, check=True, env=environment)
    for stage in STAGES:
        for path in sorted((chain.out() / stage).iterdir()):
            other = copy.out() / stage / path.name
            if path.suffix == ".json":
                first, second = (json.loads(p.read_text()) for p in (path, other))
                first.pop("wall_s"), second.pop("wall_s")
                assert first == second, path.name
            else:
                assert path.read_bytes() == other.read_bytes(), path.name


def test_fresh_artefacts_are_kept_and_stale_ones_are_named(
    chain: TinySet, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    work = tmp_path / "copy"
    shutil.copytree(chain.config.parent, work)
    config = str(work / chain.config.name)
    before = (work / "run/match/match.json").read_bytes()
    assert run(["match", config]) == 0
    assert "fresh" in capsys.readouterr().out
    assert (work / "run/match/match.json").read_bytes() == before
    # a section the stage does not read leaves it fresh, one it reads does not
    assert run(["match", config, "--set", "mosaic.resolution=0.01"]) == 0
    assert "fresh" in capsys.readouterr().out
    assert run(["localize", config, "--set", "seed=1"]) == 4
    assert "gvpipe match" in capsys.readouterr().err
    (work / "A/0.png").write_bytes((work / "A/1.png").read_bytes())
    assert run(["localize", config]) == 4
    error = capsys.readouterr().err
    assert "A/0.png" in error
    assert "gvpipe match" in error


def test_a_robot_without_any_match_is_named(tiny: TinySet, tmp_path: Path, capsys) -> None:  # type: ignore[no-untyped-def]
    command = ["match", str(tiny.config), "--out", str(tmp_path / "o"), "--jobs", "1"]
    assert run([*command, "--set", "robots.B.tilt=5"]) == 0
    said = capsys.readouterr().out
    assert "robots.B" in said
    assert "none of 6 pairs matched" in said
    assert "robots.A" not in said


def test_missing_artefacts_name_the_command(tiny: TinySet, tmp_path: Path, capsys) -> None:  # type: ignore[no-untyped-def]
    for stage, maker in [("localize", "match"), ("mosaic", "slam"), ("reconstruct", "slam")]:
        assert run([stage, str(tiny.config), "--out", str(tmp_path / "o")]) == 4
        assert f"gvpipe {maker}" in capsys.readouterr().err


def test_what_would_stop_halfway_is_refused_at_once(tiny: TinySet, tmp_path: Path, capsys) -> None:  # type: ignore[no-untyped-def]
    command = ["run", str(tiny.config), "--out", str(tmp_path / "o"), "--stages"]
    assert run([*command, "match,slam,mosaic"]) == 4
    assert "`gvpipe overlap CONFIG` makes it" in capsys.readouterr().err
    assert not (tmp_path / "o").exists()


def test_one_robot_needs_no_overlap(tiny: TinySet, tmp_path: Path) -> None:
    text = tiny.config.read_text().replace("images: A", f"images: {tiny.config.parent / 'A'}")
    config = tmp_path / "one.yaml"
    config.write_text("".join(x for x in text.splitlines(True) if not x.startswith("  B:")))
    assert run(["run", str(config), "--stages", "match,slam", "--jobs", "1", "-q"]) == 0
    slam = json.loads((tmp_path / "run/slam/slam.json").read_text())
    assert len(slam["poses"]) > 2
    assert not (tmp_path / "run/overlap").exists()


def test_wrong_command_lines_end_with_2(tiny: TinySet) -> None:
    assert run(["match"]) == 2
    assert run(["match", str(tiny.config), "--no-such-option"]) == 2
    assert run(["no-such-command"]) == 2
    assert run(["match", str(tiny.config), "-q", "-v"]) == 2
    assert run(["match", str(tiny.config), "--jobs", "0"]) == 2
    assert run(["run", str(tiny.config), "--stages", "match,slm"]) == 2


def test_wrong_configurations_end_with_3(tmp_path: Path, capsys) -> None:  # type: ignore[no-untyped-def]
    config = tmp_path / "c.yaml"
    config.write_text("cameras: {}\nrobots: {A: {images: x, hight: 1}}\n")
    assert run(["match", str(config)]) == 3
    error = capsys.readouterr().err
    assert "c.yaml:2" in error
    assert "robots.A.hight" in error
    assert "height" in error


def test_missing_images_end_with_4(tiny: TinySet, tmp_path: Path, capsys) -> None:  # type: ignore[no-untyped-def]
    config = tmp_path / "c.yaml"
    config.write_text(tiny.config.read_text().replace("images: A", "images: nowhere"))
    assert run(["match", str(config)]) == 4
    assert "nowhere" in capsys.readouterr().err


def test_no_result_ends_with_5_and_says_why(tiny: TinySet, tmp_path: Path, capsys) -> None:  # type: ignore[no-untyped-def]
    for robot in "AB":
        (tmp_path / robot).mkdir()
        for k in range(2):
            ok, png = cv2.imencode(".png", np.full((240, 320, 3), 90 + k, np.uint8))
            assert ok
            (tmp_path / robot / f"{k}.png").write_bytes(png.tobytes())
    config = tmp_path / "c.yaml"
    config.write_text(tiny.config.read_text())
    assert run(["match", str(config)]) == 5
    assert "no result" in capsys.readouterr().err
    document = json.loads((tmp_path / "run/match/match.json").read_text())
    assert document["reason"]
    assert {row["status"] for row in document["pairs"]} == {"rejected"}
    # the others run nevertheless
    assert run(["run", str(config), "--stages", "match,overlap,slam"]) == 5
    assert (tmp_path / "run/slam/slam.json").exists()
    assert run(["match", str(config)]) == 5  # fresh, and still without a result
    capsys.readouterr()
    # one that needs the result cannot; the cause is told first
    assert run(["run", str(config), "-q"]) == 5
    cause, consequence = capsys.readouterr().err.splitlines()
    assert cause.startswith("gvpipe: match: no result: no pair matched")
    assert consequence.endswith("slam.json: no image could be linked to another")


def test_unwritable_outputs_end_with_6(tiny: TinySet, tmp_path: Path, capsys) -> None:  # type: ignore[no-untyped-def]
    (tmp_path / "file").write_text("in the way")
    assert run(["match", str(tiny.config), "--out", str(tmp_path / "file")]) == 6
    assert "file" in capsys.readouterr().err


def test_a_second_run_in_the_same_folder_ends_with_6(tiny: TinySet, tmp_path: Path) -> None:
    import fcntl

    with (tmp_path / ".match.lock").open("w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        assert run(["match", str(tiny.config), "--out", str(tmp_path)]) == 6


def test_bad_images_are_skipped_and_recorded(chain: TinySet, tmp_path: Path) -> None:
    work = tmp_path / "copy"
    shutil.copytree(chain.config.parent, work)
    (work / "A/9.png").write_bytes((work / "A/0.png").read_bytes()[:200])
    (work / "A/notes.txt").write_text("no image")
    assert run(["match", str(work / chain.config.name), "-q"]) == 0
    document = json.loads((work / "run/match/match.json").read_text())
    assert [row["image"] for row in document["skipped"]] == ["A/9.png", "A/notes.txt"]
    assert document["pairs"] == chain.document("match")["pairs"]


@pytest.mark.parametrize(("number", "code"), [("SIGINT", 130), ("SIGTERM", 143)])
def test_interruption_leaves_nothing_half_written(
    tiny: TinySet, tmp_path: Path, number: str, code: int
) -> None:
    import signal
    import time

    command = [sys.executable, "-m", "gvpipe", "match", str(tiny.config), "--out", str(tmp_path)]
    process = subprocess.Popen(
        [*command, "--jobs", "2"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    while not (tmp_path / ".match.lock").exists() and process.poll() is None:
        time.sleep(0.02)
    time.sleep(0.3)
    process.send_signal(getattr(signal, number))
    assert process.wait(timeout=10) == code
    assert {p.name for p in tmp_path.iterdir()} <= {".match.lock", ".match.checkpoints"}
