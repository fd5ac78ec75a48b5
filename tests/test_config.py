"""Configuration: every kind of mistake with its place, overrides, printing, hashing."""

import shutil
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gvpipe.cli import run
from gvpipe.config import CameraConfig, Config, sees_ground
from gvpipe.configfile import load_config, section_sha256, show_config
from gvpipe.errors import ConfigError, GvpipeError, InputError, UsageError
from gvpipe.formats.strict_yaml import MAX_DEPTH, format_value, parse_bytes, parse_text

CAMERA = "{width: 640, height: 480, fx: 520, fy: 520, cx: 319.5, cy: 239.5}"
MINIMAL = f"""cameras:
  cam0: {CAMERA}
robots:
  A: {{images: a, height: 0.5, tilt: 33}}
"""
CONFIGS = sorted((Path(__file__).parent.parent / "configs").glob("*.yaml"))


@pytest.fixture
def write(tmp_path):
    def _write(text, name="run.yaml"):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return _write


def errors_of(path, *overrides):
    with pytest.raises(ConfigError) as caught:
        load_config(path, overrides)
    return str(caught.value).splitlines()


@pytest.mark.parametrize("path", CONFIGS, ids=lambda p: p.stem)
def test_example_configurations_load_and_print(path, tmp_path):
    config = load_config(path)
    shown = tmp_path / "shown.yaml"
    shown.write_text(show_config(config))
    assert load_config(shown) == config


def test_every_key_of_the_example_is_understood():
    config = load_config(CONFIGS[0].parent / "example.yaml")
    assert list(config.robots) == ["A", "B"]
    assert config.robots["A"].overrides["0007.jpg"].camera == "cam1"
    assert config.cameras["cam1"].fx == 531.2
    assert config.cameras["cam1"].distortion == (-0.12, 0.03, 0.0004, -0.0002, 0.0)
    assert config.robots["A"].images == CONFIGS[0].parent / "images/robot_a"
    assert config.reconstruct.grid == (200, 200, 100)


def test_defaults_and_paths(write, tmp_path):
    config = load_config(write(MINIMAL))
    assert config.robots["A"].camera == "cam0"  # the only one
    assert config.match.pairs == "consecutive"
    assert config.mosaic.resolution == 0.005
    assert config.output.parent == tmp_path
    absolute = MINIMAL.replace("images: a", "images: /data/a") + "output: x/y\n"
    config = load_config(write(absolute))
    assert config.robots["A"].images == Path("/data/a")
    assert config.output == tmp_path / "x/y"


def test_out_wins_and_is_relative_to_the_current_folder(write, tmp_path, monkeypatch):
    path = write(MINIMAL, "sub/run.yaml")
    monkeypatch.chdir(tmp_path)
    assert load_config(path, out=Path("o")).output == tmp_path / "o"
    assert load_config(Path("sub/run.yaml")).robots["A"].images == tmp_path / "sub/a"


MISTAKES = {
    "unknown key": (
        MINIMAL + "mosaic: {resolutoin: 1}\n",
        "5:10: mosaic.resolutoin: is not a known key; expected one of resolution, blend "
        "(did you mean resolution?)",
    ),
    "unknown section": (MINIMAL + "mosiac: {}\n", "5:1: mosiac: is not a known key"),
    "wrong type": (
        MINIMAL + "seed: high\n",
        "5:7: seed: is 'high'; expected a whole number >= 0",
    ),
    "float for int": (MINIMAL + "seed: 1.5\n", "5:7: seed: is 1.5; expected a whole number"),
    "bool for number": (
        MINIMAL.replace("0.5", "true"),
        "4:26: robots.A.height: is true; expected a number > 0 and <= 1000 (camera centre",
    ),
    "out of range": (
        MINIMAL.replace("33", "91"),
        "4:37: robots.A.tilt: is 91; expected a number > 0 and <= 90 or auto (degrees",
    ),
    "tilt zero": (MINIMAL.replace("33", "0"), "4:37: robots.A.tilt: is 0;"),
    "roll": (MINIMAL.replace("33", "33, roll: 45"), "4:47: robots.A.roll: is 45; expected"),
    "nan": (MINIMAL.replace("0.5", ".nan"), "4:26: robots.A.height: is NaN; expected a number"),
    "inf": (MINIMAL.replace("0.5", "1e999"), "4:26: robots.A.height: is Infinity;"),
    "huge int": (MINIMAL + f"seed: {'9' * 6000}\n", "5:7: seed: is Infinity"),
    "missing": (
        MINIMAL.replace("height: 0.5, ", ""),
        "4:3: robots.A.height: is missing; expected a number > 0 and <= 1000 (camera centre",
    ),
    "missing section": (
        f"cameras: {{c: {CAMERA}}}\n",
        "1:1: robots: is missing; expected a mapping of keys (robots by name",
    ),
    "empty section": (MINIMAL + "match:\n", "5:7: match: is empty; expected a mapping of keys"),
    "no robots": (
        f"cameras: {{c: {CAMERA}}}\nrobots: {{}}\n",
        "2:9: robots: is {}; expected a mapping of keys",
    ),
    "duplicate key": (
        MINIMAL.replace("tilt: 33", "tilt: 33, tilt: 3"),
        "4:41: robots.A.tilt: is given twice, first in line 4; expected once",
    ),
    "choice": (
        MINIMAL + "mosaic: {blend: best!}\n",
        "5:17: mosaic.blend: is 'best!'; expected robust or half or best (robust = median",
    ),
    "no stays text": (MINIMAL + "mosaic: {blend: NO}\n", "5:17: mosaic.blend: is 'NO';"),
    "alias": (
        MINIMAL + "mosaic: *x\n",
        "5:9: mosaic: alias *x; expected the value itself",
    ),
    "anchor": (MINIMAL + "slam: &x {}\n", "5:7: slam: anchor &x; expected a plain value"),
    "tag": (
        MINIMAL + "seed: !!python/object/apply:os.system [echo]\n",
        "5:7: seed: tag tag:yaml.org,2002:python/object/apply:os.system; expected a plain value",
    ),
    "syntax": (MINIMAL + "slam: {\n", "6:1: slam: is not valid YAML"),
    "two documents": (MINIMAL + "---\na: 1\n", "5:1: a second document begins; expected one"),
    "control character": (MINIMAL + "slam: {a: \x01}\n", "5:11: character U+0001 is not allowed"),
    "not utf-8": (MINIMAL.encode() + b"output: \xff\n", "5:9: byte 0xff is not UTF-8"),
    "depth": (MINIMAL + "slam: " + "[" * 5000, f"nested deeper than {MAX_DEPTH} levels"),
    "values": (MINIMAL + "slam: [" + "1," * 40000, "more than 30000 keys and values"),
    "not a mapping": ("- 1\n", "1:1: is not a mapping; expected the keys cameras and robots"),
    "empty": ("", "1:1: is empty; expected the keys cameras and robots"),
    "key is a list": ("? [a]\n: 1\n", "1:3: a key is a list or a mapping; expected text"),
    "robot name": (
        MINIMAL.replace("  A:", "  a/b:"),
        "4:3: robots.a/b: is not a usable name; expected 1 to 64 letters",
    ),
    "dotted name": (MINIMAL.replace("  A:", "  ..:"), "4:3: robots...: is not a usable name"),
    "pairs of one name": (
        MINIMAL
        + "".join(f"  {x}: {{images: a, height: 0.5, tilt: 33}}\n" for x in ("A-B", "B-C", "C")),
        "7:3: robots.C: with A-B is filed as A-B-C, which is A with B-C, too; expected",
    ),
    "camera": (
        MINIMAL.replace("tilt: 33", "tilt: 33, camera: cam"),
        "4:49: robots.A.camera: is 'cam'; expected a camera (known: cam0) (did you mean cam0?)",
    ),
    "override camera": (
        MINIMAL.replace("tilt: 33", "tilt: 33, overrides: {x.jpg: {camera: q}}"),
        "robots.A.overrides.x.jpg.camera: is 'q'; expected a camera (known: cam0)",
    ),
    "two cameras": (
        MINIMAL.replace("robots:", f"  cam1: {CAMERA}\nrobots:"),
        "5:3: robots.A.camera: is missing; expected text (name of a camera",
    ),
    "pair id": (
        MINIMAL + "match: {pairs: [[A/1.jpg, B/2.jpg]]}\n",
        "5:27: match.pairs.0.1: is 'B/2.jpg'; expected an image of a robot (known: A)",
    ),
    "pair of one": (
        MINIMAL + "match: {pairs: [[A/1.jpg]]}\n",
        "5:17: match.pairs.0.1: is missing; expected consecutive or exhaustive or a list",
    ),
    "pair twice": (
        MINIMAL + "match: {pairs: [[A/1.jpg, A/1.jpg]]}\n",
        "5:17: match.pairs.0: is 'A/1.jpg' twice; expected two images",
    ),
    "pairs": (
        MINIMAL + "match: {pairs: all}\n",
        "5:16: match.pairs: is 'all'; expected consecutive or exhaustive or a list",
    ),
    "known point without a robot": (
        MINIMAL + "slam: {control: [{image: C/1.jpg, pixel: [1, 2], map: [0, 0]}]}\n",
        "slam.control.0.image: is 'C/1.jpg'; expected an image of a robot (known: A)",
    ),
    "reference": (
        MINIMAL + "slam: {reference: 0.jpg}\n",
        "5:19: slam.reference: is '0.jpg'; expected robot/file name, for example A/0003.jpg",
    ),
    "horizon": (
        MINIMAL.replace("cy: 239.5", "cy: 99999"),
        "robots.A: sees no ground at tilt 33, roll 0; expected the lowest image row",
    ),
    "override horizon": (
        MINIMAL.replace("cy: 239.5", "cy: 600").replace(
            "tilt: 33", "tilt: 33, overrides: {x.jpg: {tilt: 1}}"
        ),
        "robots.A.overrides.x.jpg: sees no ground at tilt 1, roll 0",
    ),
    "distortion": (
        MINIMAL.replace("cy: 239.5", "cy: 239.5, distortion: [1, 2, 3]"),
        "cameras.cam0.distortion: is a list of 3; expected a list",
    ),
    "calibration": (
        MINIMAL.replace(CAMERA, "gone.yaml"),
        "gone.yaml: cannot be read: No such file or directory; expected a calibration file",
    ),
    "path": (
        MINIMAL.replace("images: a", 'images: "a\\0b"'),
        "4:15: robots.A.images: is 'a\\x00b'; expected a path",
    ),
    "no pairs": (MINIMAL + "match: {pairs: []}\n", "5:16: match.pairs: is an empty list"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_each_mistake_names_its_place(name, write):
    text, expected = MISTAKES[name]
    lines = errors_of(write(text))
    assert len(lines) == 1, lines
    assert "run.yaml:" in lines[0]
    assert expected in lines[0]


def test_a_config_that_is_too_large_missing_or_no_file_is_an_input_error(write, tmp_path):
    for path in (write(b"#" * ((1 << 20) + 1)), tmp_path / "none.yaml", tmp_path):
        with pytest.raises(InputError, match="expected a configuration file"):
            load_config(path)


def test_all_mistakes_at_once_in_the_order_of_the_file(write):
    text = f"""cameras:
  cam0: {CAMERA.replace("520", "-1", 1)}
robots:
  A: {{images: a, heigth: 0.5, height: 0, tilt: 33, camera: cam1}}
  B/: {{images: 7, height: 1, tilt: steep, tilt: 2}}
match: {{pairs: [[A/1.jpg, C/2.jpg]]}}
mosaic: {{blend: *b}}
seed: -1
"""
    lines = errors_of(write(text), "overlap.threshold=3", "slam.reference=[x")
    places = [line.split(": ")[1] for line in lines]
    assert places == [
        *("cameras.cam0.fx", "robots.A.heigth", "robots.A.height", "robots.A.camera"),
        *("robots.B/", "robots.B/.images", "robots.B/.tilt", "match.pairs.0.1", "mosaic.blend"),
        *("seed", "overlap.threshold", "slam.reference"),
    ]


def test_set_replaces_values_of_every_kind(write):
    config = load_config(
        write(MINIMAL + "match: {pairs: [[A/1.jpg, A/2.jpg]]}\n"),
        [
            "match.pairs=exhaustive",
            "robots.A.tilt=auto",
            "robots.A.overrides={0007.jpg: {tilt: 22}}",
            "robots.A.overrides.0007.jpg.tilt=23",
            "reconstruct.grid=[10, 20, 30]",
            "reconstruct.grid.0=12",
            "mosaic.resolution=1e-2",
            "slam.reference=null",
        ],
    )
    assert config.match.pairs == "exhaustive"
    assert config.robots["A"].tilt == "auto"
    assert config.robots["A"].overrides["0007.jpg"].tilt == 23
    assert config.reconstruct.grid == (12, 20, 30)
    assert config.mosaic.resolution == 0.01


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("match.pair=x", "--set match.pair=x: match.pair: is not a known key"),
        ("mosaic.resolution=-1", "--set mosaic.resolution=-1: mosaic.resolution: is -1; expected"),
        ("match.pairs=[*a]", "--set match.pairs=[*a]: match.pairs: alias *a"),
        ("seed.x=1", "--set seed.x=1: seed.x: is inside a value that holds no keys"),
        ("new.x=1", "--set new.x=1: new: is not a known key"),
        ("seed=a\x1b[31m", "--set seed=a%1B[31m: seed: "),
    ],
)
def test_set_errors_name_the_option(override, expected, write):
    assert expected in errors_of(write(MINIMAL + "seed: 3\n"), override)[0]


@pytest.mark.parametrize("override", ["seed", "=1", ""])
def test_set_without_a_key_or_value_is_a_usage_error(override, write):
    with pytest.raises(UsageError, match="expected KEY=VALUE"):
        load_config(write(MINIMAL), [override])


def test_scalars_follow_the_core_schema():
    text = "[on, yes, NO, 1e3, 017, 0o7, 1_000, 12:30:45, 2001-01-01, +3, -.5, 1., ~, null, True]"
    assert parse_text(text).value == [
        *("on", "yes", "NO", 1000.0, "017", "0o7", "1_000", "12:30:45", "2001-01-01"),
        *(3, -0.5, 1.0, None, None, True),
    ]
    assert parse_text("{1: a, on: b, 'c': d}").value == {"1": "a", "on": "b", "c": "d"}
    assert parse_bytes("\ufeffa: é\n".encode()).value == {"a": "é"}


plain = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(10**12), 10**12)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(st.characters(exclude_categories=()), max_size=8),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3)
    ),
    max_leaves=8,
)


@given(plain)
@settings(deadline=None, max_examples=150)
def test_written_values_read_back(value):
    document = parse_text("key: " + format_value(value))
    assert not document.problems
    assert document.value == {"key": value}


EXAMPLE = (CONFIGS[0].parent / "example.yaml").read_bytes()


@given(data=st.data())
@settings(
    deadline=None, max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_mutated_configurations_end_in_one_clear_error(data, tmp_path):
    raw = bytearray(EXAMPLE)
    for _ in range(data.draw(st.integers(1, 6))):
        at = data.draw(st.integers(0, len(raw)))
        piece = data.draw(
            st.binary(max_size=4)
            | st.sampled_from([b"[", b"}", b": ", b"\n  ", b"&a ", b"*a", b"!!x ", b"? ", b"- "])
        )
        raw[at : at + data.draw(st.integers(0, 5))] = piece
    path = tmp_path / "mutated.yaml"
    path.write_bytes(raw)
    assert all("mutated.yaml" in line for line in failure(path).splitlines())


def failure(path):
    """What gvpipe says of a configuration; nothing if it loads."""
    try:
        load_config(path)
    except GvpipeError as error:
        return str(error)
    return ""


STAGES = ("cameras", "robots", "match", "overlap", "slam", "mosaic", "reconstruct")


def hashes(config: Config):
    return {name: section_sha256(config, [name]) for name in STAGES}


def test_hashes_do_not_depend_on_where_the_folder_lies(tmp_path):
    here, there = tmp_path / "a", tmp_path / "b [1]"
    shutil.copytree(CONFIGS[0].parent, here)
    shutil.copytree(CONFIGS[0].parent, there)
    (there / "calibration/cam1.yaml").rename(there / "cam1.yaml")
    moved = there / "other.yaml"
    text = (there / "example.yaml").read_text()
    moved.write_text(text.replace("calibration/", "").replace("runs/", "somewhere/"))
    first = load_config(here / "example.yaml")
    assert hashes(first) == hashes(load_config(moved))
    assert section_sha256(first, STAGES) == section_sha256(load_config(moved), STAGES)


@pytest.mark.parametrize(
    ("override", "changed"),
    [
        ("mosaic.resolution=0.01", {"mosaic"}),
        ("match.pairs=exhaustive", {"match"}),
        ("robots.A.tilt=34", {"robots"}),
        ("robots.A.poses=x.tum", {"robots"}),
        ("robots.A.overrides.0007.jpg.roll=1", {"robots"}),
        ("cameras.cam0.fx=521", {"cameras"}),
        ("robots.A.images=elsewhere", set()),
        ("output=elsewhere", set()),
        ("seed=1", set()),
    ],
)
def test_a_change_reaches_only_its_own_section(override, changed):
    path = CONFIGS[0].parent / "example.yaml"
    before, after = hashes(load_config(path)), hashes(load_config(path, [override]))
    assert {name for name in STAGES if before[name] != after[name]} == changed


def test_hash_counts_the_order_of_robots_and_refuses_unknown_sections(write):
    both = MINIMAL + "  B: {images: b, height: 0.5, tilt: 33}\n"
    swapped = both.replace("  A:", "  X:").replace("  B:", "  A:").replace("  X:", "  B:")
    first, second = load_config(write(both)), load_config(write(swapped))
    assert hashes(first)["robots"] != hashes(second)["robots"]
    with pytest.raises(ValueError, match="unknown sections"):
        section_sha256(first, ["nothing"])


def test_horizon_is_where_geometry_says():
    # a level camera sees down to atan((479.5 - cy) / fy) below its axis at the lowest row's edge
    camera = CameraConfig(width=640, height=480, fx=500.0, fy=500.0, cx=320.0, cy=979.5)
    assert not sees_ground(camera, 44.99, 0)
    assert sees_ground(camera, 45.01, 0)
    assert sees_ground(camera, 44.99, 20)  # rolling lowers one corner


def test_surrogates_in_the_folder_name_do_not_matter(tmp_path):
    folder = Path(str(tmp_path) + "/\udcff")
    folder.mkdir()
    path = folder / "run.yaml"
    path.write_text(MINIMAL)
    config = load_config(path)
    assert config.robots["A"].images == folder / "a"
    assert section_sha256(config, STAGES)
    shown = tmp_path / "shown.yaml"
    shown.write_text(show_config(config), encoding="utf-8")
    assert load_config(shown) == config


def test_known_points_are_shown_as_they_load(write) -> None:  # type: ignore[no-untyped-def]
    text = MINIMAL + "slam: {control: [{image: A/1.jpg, pixel: [1, 2.5], map: [-3, 4]}]}\n"
    config = load_config(write(text))
    [point] = config.slam.control
    assert (point.image, point.pixel, point.map) == ("A/1.jpg", (1.0, 2.5), (-3.0, 4.0))
    assert load_config(write(show_config(config))).slam == config.slam


TEAM = f"""cameras:
  cam0: {CAMERA}
robots:
  A: {{images: a, height: 0.5, tilt: 33}}
  B: {{images: gone, height: 0.6, tilt: 33}}
  C: {{images: a, height: 0.5, tilt: 33, poses: gone.tum}}
  D: {{images: empty, height: 0.5, tilt: 33}}
"""


def test_check_lists_all_that_is_not_there(write, tmp_path, capsys):
    write("no picture", "a/0.png")
    (tmp_path / "empty").mkdir()
    path = write(TEAM)
    assert run(["config", "check", str(path)]) == 4
    lines = capsys.readouterr().err.removeprefix("gvpipe: ").splitlines()
    assert [line.split(": ")[1] for line in lines] == [
        "robots.B.images",
        "robots.C.poses",
        "robots.D.images",
    ]
    assert lines[0].startswith(f"{path}:5:")
    assert lines[0].endswith(f"{tmp_path / 'gone'}: no such file or folder")
    assert "no usable image" in lines[2]
    write(TEAM.replace("0.6", "tall"))
    assert run(["config", "check", str(path)]) == 3
    assert len(capsys.readouterr().err.splitlines()) == 4
    load_config(write(TEAM))  # others may want the settings alone


@pytest.mark.parametrize(
    ("heights", "doubted"),
    [
        ((0.5, 1.2), []),
        ((9.0, 0.95), []),
        ((37.9, 21.0), ["robots.A.height: is 37.9, higher", "robots.B.height: is 21, higher"]),
        ((0.05, 0.6), ["robots.B.height: is 0.6, but robots.A.height is 0.05; both in metres?"]),
    ],
)
def test_heights_in_another_unit_are_doubted(heights, doubted, write, capsys):
    write("no picture", "a/0.png")
    both = zip("AB", heights, strict=True)
    robots = "".join(f"  {n}: {{images: a, height: {h}, tilt: 33}}\n" for n, h in both)
    path = write(f"cameras:\n  cam0: {CAMERA}\nrobots:\n{robots}")
    assert run(["config", "check", str(path)]) == 0
    said = capsys.readouterr().err.splitlines()
    assert len(said) == len(doubted)
    for line, doubt in zip(said, doubted, strict=True):
        assert line.startswith("WARNING")
        assert doubt in line
