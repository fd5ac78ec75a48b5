"""A folder of pictures becomes a configuration that loads, and says where its numbers are from."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Pillow

from gvpipe.cli import run
from gvpipe.commands.photos import list_photos
from gvpipe.configfile import load_config
from gvpipe.core.synthesis.camera_path import Stop, poses
from gvpipe.core.synthesis.scene import make_scene, photograph
from gvpipe.core.synthesis.texture import stone
from gvpipe.core.types import Camera, Mount
from gvpipe.dataset import open_dataset
from gvpipe.formats.jpeg import jpeg_bytes
from tests.faults.broken import add_broken_images


def picture(path: Path, size: tuple[int, int] = (64, 48), **exif: float) -> None:
    """Write a grey JPEG with EXIF tags: orientation, focal35, model."""
    path.parent.mkdir(parents=True, exist_ok=True)
    image = Pillow.new("RGB", size, (120, 130, 140))
    tags = Pillow.Exif()
    if "orientation" in exif:
        tags[274] = int(exif["orientation"])
    if "focal35" in exif:
        tags.get_ifd(0x8769)[41989] = int(exif["focal35"])
    image.save(path, exif=tags)


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Pictures by hand round a place, focal length 300 px."""
    folder = tmp_path_factory.mktemp("walk") / "photos"
    folder.mkdir()
    rng = np.random.default_rng(8)
    scene = make_scene(stone(rng), rng=rng, period_m=1.5)
    camera = Camera(320, 240, 300.0, 300.0, 159.5, 119.5)
    stops = [Stop(-0.5 * np.cos(a), -0.5 * np.sin(a), a) for a in np.radians([0, 35, 70, 105, 140])]
    held = Mount(np.radians(48.0), 0.0, 0.6)
    for k, pose in enumerate(poses(stops, held, np.radians(3.0), rng)):
        pixels = photograph(scene, camera, pose, samples=2, light_samples=1).pixels
        (folder / f"{k}.jpg").write_bytes(jpeg_bytes(pixels))
    return folder


def test_the_camera_is_found_in_its_pictures(walk: Path, tmp_path: Path) -> None:
    out = tmp_path / "walk.yaml"
    assert run(["init", str(walk), "--height", "0.6", "--out", str(out), "-q"]) == 0
    config = load_config(out)
    (camera,) = config.cameras.values()
    assert camera.fx == pytest.approx(300.0, rel=0.05)
    (robot,) = config.robots.values()
    assert robot.tilt == pytest.approx(48.0, abs=4.0)
    assert len(robot.overrides) == 5
    assert np.median([o.height for o in robot.overrides.values()]) == pytest.approx(0.6, abs=1e-3)
    assert config.match.pairs == "exhaustive"
    assert "self-calibrated from 5 pictures" in out.read_text()


def test_setting_one_number_suffices_where_no_height_was_measured(
    walk: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    out = tmp_path / "walk.yaml"
    assert run(["init", str(walk), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "NOT MEASURED, taken as 1; set robots." in said
    assert "gvpipe run walk.yaml" in said
    assert "gvpipe report walk.yaml" in said
    out.write_text(out.read_text().replace("height: 1  # NOT", "height: 0.6  # NOT"))
    config = load_config(out)
    assert all(len(robot.overrides) == 5 for robot in config.robots.values())
    assert {entry.mount.height for entry in open_dataset(config).entries} == {0.6}


def test_each_robot_may_have_a_height_of_its_own(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("low", "tall"):
        picture(tmp_path / "team" / name / "0.jpg")
    command = ["init", str(tmp_path / "team"), "--focal", "60", "--height", "0.4"]
    assert run([*command, "--height", "tall=1.2"]) == 0
    heights = {name: r.height for name, r in load_config(tmp_path / "team.yaml").robots.items()}
    assert heights == {"low": 0.4, "tall": 1.2}
    assert "1.2 m, the median of its pictures" in capsys.readouterr().out
    assert run([*command, "--force", "--height", "flat=1"]) == 2
    assert "no such robot; expected one of low, tall" in capsys.readouterr().err
    for wrong in ("37.9cm", "nan", "-1", "tall="):
        assert run([*command, "--force", "--height", wrong]) == 2
        assert "expected a number of metres from 0.001 to 1000" in capsys.readouterr().err


def test_without_texture_it_guesses_and_says_so(tmp_path: Path) -> None:
    for k in range(3):
        picture(tmp_path / "flat" / f"{k}.jpg")
    assert run(["init", str(tmp_path / "flat"), "-q"]) == 0
    config = load_config(tmp_path / "flat.yaml")
    assert config.cameras["cam_flat"].fx == pytest.approx(0.87 * 64)
    assert config.robots["flat"].tilt == "auto"
    assert config.robots["flat"].height == 1.0
    text = (tmp_path / "flat.yaml").read_text()
    assert "a guess: 60 degrees" in text
    assert "NOT MEASURED" in text
    assert run(["init", str(tmp_path / "flat"), "-q"]) == 6
    assert run(["init", str(tmp_path / "flat"), "-q", "--force", "--tilt", "35"]) == 0
    assert load_config(tmp_path / "flat.yaml").robots["flat"].tilt == 35


def test_exif_tells_the_focal_length(tmp_path: Path) -> None:
    picture(tmp_path / "a.jpg", (400, 300), focal35=26)
    (photo,) = list_photos(tmp_path, 5)
    assert photo.focal_px == pytest.approx(26 / 43.267 * 500)
    assert (
        run(["init", str(tmp_path), "--no-calibrate", "-q", "--out", str(tmp_path / "c.yaml")]) == 0
    )
    assert "EXIF, 26 mm equivalent" in (tmp_path / "c.yaml").read_text()


@pytest.mark.parametrize("orientation", range(2, 9))
def test_turned_pictures_are_put_upright(tmp_path: Path, orientation: int) -> None:
    rng = np.random.default_rng(0)
    base = np.kron(rng.integers(0, 255, (3, 4, 3)), np.ones((16, 16, 1))).astype(np.uint8)
    tags = Pillow.Exif()
    tags[274] = orientation
    (tmp_path / "p").mkdir()
    Pillow.fromarray(base).save(tmp_path / "p" / "0.png", exif=tags)
    assert run(["init", str(tmp_path / "p"), "--focal", "60", "-q"]) == 0
    from PIL import ImageOps

    with Pillow.open(tmp_path / "p" / "0.png") as turned:
        wanted = np.asarray(ImageOps.exif_transpose(turned))
    with Pillow.open(tmp_path / "upright" / "p" / "0.jpg") as copy:
        found = np.asarray(copy)
    assert found.shape == wanted.shape
    assert np.abs(found.astype(int) - wanted).mean() < 6
    assert len(open_dataset(load_config(tmp_path / "p.yaml")).entries) == 1


def test_folders_become_robots(tmp_path: Path) -> None:
    for robot in ("robot A", "robotB"):
        for k in range(2):
            picture(tmp_path / "team" / robot / "images" / f"{k}.jpg")
    picture(tmp_path / "team" / "robotB" / "images" / "odd.jpg", (32, 32))
    (tmp_path / "team" / "notes").mkdir()
    assert run(["init", str(tmp_path / "team"), "--focal", "60", "-q"]) == 0
    config = load_config(tmp_path / "team.yaml")
    assert list(config.robots) == ["robot_A", "robotB"]
    assert len(open_dataset(config).entries) == 4


def test_broken_files_are_named_and_never_waited_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for k in range(2):
        picture(tmp_path / "mixed" / f"a{k}.jpg")
    (tmp_path / "mixed" / "notes.txt").write_text("a nice floor")
    (tmp_path / "mixed" / "walk.mp4").write_text("no video")
    add_broken_images(tmp_path / "mixed")
    assert run(["init", str(tmp_path / "mixed"), "--focal", "60"]) == 0
    said = capsys.readouterr().err
    unusable = ("32 pipe.png", "35 device.png", "33 loop.png", "00 empty.png", "09 bomb.png")
    for name in (*unusable, "28 drawing.gif", "36 %FF%FE.png", "walk.mp4", "37 line%0Afeed"):
        assert name in said
    assert "notes.txt" not in said
    assert run(["init", str(tmp_path / "mixed" / "32 pipe.png"), "-q"]) == 4
    assert "is not a regular file" in capsys.readouterr().err


def test_links_to_folders_lead_nowhere(tmp_path: Path) -> None:
    picture(tmp_path / "team" / "one" / "0.jpg")
    for name in ("round", "and round"):
        (tmp_path / "team" / name).symlink_to(".")
    assert run(["init", str(tmp_path / "team"), "--focal", "60", "-q"]) == 0
    assert list(load_config(tmp_path / "team.yaml").robots) == ["one"]


def test_upright_copies_keep_names_apart(tmp_path: Path) -> None:
    for name in ("0.jpg", "0.png", "1.jpg"):
        picture(tmp_path / "p" / name, orientation=3)
    assert run(["init", str(tmp_path / "p"), "--focal", "60", "-q"]) == 0
    names = {path.name for path in (tmp_path / "upright" / "p").iterdir()}
    assert names == {"0.jpg.jpg", "0.png.jpg", "1.jpg"}


def test_nothing_to_find(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    assert run(["init", str(tmp_path / "empty"), "-q"]) == 4
    assert run(["init", str(tmp_path / "none"), "-q"]) == 4
    assert not list(tmp_path.glob("*.yaml"))
