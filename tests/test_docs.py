"""What the pages say exists: links, commands, options, keys, messages, code."""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer
import yaml
from typer.core import TyperGroup

import gvpipe
from gvpipe import errors
from gvpipe.chain import STAGES
from gvpipe.cli import app
from gvpipe.config import CameraConfig, Config, RobotConfig
from tests.conftest import TinySet

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.glob("*.md"))
ALL = [*PAGES, ROOT / "README.md"]
PACKAGE = Path(gvpipe.__file__).parent


def identify(path: Path) -> str:
    return path.name


def blocks(path: Path, language: str) -> list[str]:
    return re.findall(rf"^ *```{language}\n(.*?)^ *```", path.read_text(), re.M | re.S)


def anchors(path: Path) -> set[str]:
    heads = re.findall(r"^#+ (.*)$", path.read_text(), re.M)
    return {re.sub(r"[^\w -]", "", head).strip().lower().replace(" ", "-") for head in heads}


@pytest.mark.parametrize("page", ALL, ids=identify)
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)]+)\)", page.read_text()):
        if target.startswith(("https://", "mailto:")):
            continue
        name, _, anchor = target.partition("#")
        file = (page.parent / name) if name else page
        assert file.is_file(), target
        assert not anchor or anchor in anchors(file), target


def commands(page: Path) -> Iterator[list[str]]:
    text = page.read_text()
    shown = re.findall(r"^\s*\$ (?:.*&& )?(gvpipe .*)$", text, re.M)
    prose = re.sub(r"^ *```.*?^ *```", "", text, flags=re.M | re.S)
    shown += [c for c in re.findall(r"`(gvpipe [^`\n]+)`", prose) if "[" not in c]
    for line in shown:
        yield line.split("&&")[0].split()[1:]


@pytest.mark.parametrize("page", ALL, ids=identify)
def test_commands_and_options_exist(page: Path) -> None:
    for words in commands(page):
        command = typer.main.get_command(app)
        while words and isinstance(command, TyperGroup) and re.fullmatch(r"[a-z]+", words[0]):
            assert words[0] in command.commands, words
            command = command.commands[words.pop(0)]
        known = {name for p in command.params for name in (*p.opts, *p.secondary_opts)}
        known |= {"--help", "-h"}
        for word in words:
            if word.startswith("-"):
                assert word in known, (command.name, word)


def test_every_command_and_shared_option_is_listed_on_the_first_page() -> None:
    text = (DOCS / "index.md").read_text()
    group = typer.main.get_command(app)
    assert isinstance(group, TyperGroup)
    for name in group.commands:
        assert f"`gvpipe {name} " in text, name
    stage = group.commands["match"]
    for parameter in stage.params:
        if parameter.opts[0].startswith("--"):
            assert parameter.opts[0] in text, parameter.opts


def test_every_command_has_an_example() -> None:
    def walk(group: TyperGroup) -> Iterator[tuple[str, str]]:
        for name, command in group.commands.items():
            if isinstance(command, TyperGroup):
                yield from walk(command)
            else:
                yield name, command.epilog or ""

    group = typer.main.get_command(app)
    assert isinstance(group, TyperGroup)
    for name, epilog in walk(group):
        assert re.search(r"Examples?: gvpipe ", epilog), name


@pytest.mark.parametrize("page", ALL, ids=identify)
def test_keys_exist(page: Path) -> None:
    text = page.read_text()
    sections = {
        name: type(field.default).model_fields
        for name, field in Config.model_fields.items()
        if hasattr(type(field.default), "model_fields")
    }
    for name, keys in sections.items():
        for key in re.findall(rf"[` ]{name}\.([a-z_]+)[`=:]", text):
            assert key in keys or key in ("json", "npz", "png"), f"{name}.{key}"
    for block in blocks(page, "yaml"):
        document = yaml.safe_load(block)
        assert set(document) <= set(Config.model_fields)
        for camera in document.get("cameras", {}).values():
            assert isinstance(camera, str) or set(camera) <= set(CameraConfig.model_fields)
        for robot in document.get("robots", {}).values():
            assert set(robot) <= set(RobotConfig.model_fields)
        for name in sections.keys() & document.keys():
            assert set(document[name]) <= set(sections[name])


def texts_of_the_code() -> list[str]:
    found = []
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.append(node.value)
    return found


def test_the_readme_lists_every_key_with_its_default_first() -> None:
    table = dict(re.findall(r"^\| `?(.+?)`? \| (.+) \|$", (ROOT / "README.md").read_text(), re.M))
    fields = {
        name: type(field.default).model_fields
        for name, field in Config.model_fields.items()
        if hasattr(type(field.default), "model_fields")
    }
    fields["cameras.NAME"] = CameraConfig.model_fields
    fields["robots.NAME"] = RobotConfig.model_fields
    fields["top level"] = {key: Config.model_fields[key] for key in ("output", "seed")}
    for section, keys in fields.items():
        row = table[section]
        for key, field in keys.items():
            assert f"`{key}`" in row, f"{section}.{key} is missing"
            if field.is_required() or field.default in (None, (), {}):
                continue
            shown = re.search(rf"`{key}` \(([^)]*)\)", row)
            assert shown, f"{section}.{key} without its default"
            default = str(field.default).strip("()")
            words = shown[1].replace("`", "").lower()
            first = re.match(r"[-\w./]+(?:, \d+)*", words)
            assert first, words
            same = default.lower() == first[0]
            same |= isinstance(field.default, float) and float(first[0]) == field.default
            assert same, f"{section}.{key}: {words!r}, but the default is {default}"


def test_every_message_is_one_that_gvpipe_prints() -> None:
    page = (DOCS / "troubleshooting.md").read_text()
    messages = []
    for table in re.findall(r"^\| message .*?(?=\n\n|\Z)", page, re.M | re.S):
        messages += re.findall(r"^\| `([^`]+)` \|", table, re.M)
    assert len(messages) > 25
    texts = texts_of_the_code()
    for message in messages:
        assert any(message in text for text in texts), message


def test_exit_codes_are_those_of_the_errors() -> None:
    classes = [c for c in vars(errors).values() if isinstance(c, type)]
    for page in (DOCS / "index.md", ROOT / "README.md"):
        text = page.read_text()
        for code in {c.exit_code for c in classes}:
            assert re.search(rf"(\| {code} \||[; ]{code} )", text), (page, code)


def test_the_code_on_the_python_page_runs(
    chain: TinySet, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    program = "\n".join(blocks(DOCS / "api.md", "python"))
    program = program.replace("sample_runs/two_robots/two_robots.yaml", str(chain.config))
    names: dict[str, object] = {}
    exec(compile(program, "docs/api.md", "exec"), names)
    assert "PairMatch" in capsys.readouterr().out


def test_files_of_the_formats_page_are_written(chain: TinySet) -> None:
    text = (DOCS / "formats.md").read_text()
    listed = set(re.findall(rf"`((?:{'|'.join(STAGES)})/[^`]+)`", text))
    assert len(listed) > 25
    for name in listed - {"mosaic/mosaic.tif"}:  # of large maps only
        assert (chain.out() / name.replace("ROBOT", "A")).is_file(), name
    written = {f"{stage}/{p.name}" for stage in STAGES for p in (chain.out() / stage).iterdir()}
    for name in written:
        general = re.sub(r"/[AB]\.", "/ROBOT.", name)
        assert general in listed or name.startswith("overlap/"), f"{name} is not on the page"


def test_pictures_are_small_and_used() -> None:
    pictures = list((DOCS / "img").iterdir())
    assert sum(p.stat().st_size for p in pictures) < 2_000_000
    text = "".join(page.read_text() for page in PAGES)
    for picture in pictures:
        assert f"img/{picture.name}" in text, f"{picture.name} is on no page"


def test_the_site_can_be_rendered(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet"]
    command += ["--site-dir", str(tmp_path / "site")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert (tmp_path / "site" / "index.html").is_file()
