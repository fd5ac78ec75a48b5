"""The report: whole, safe, the same every time, and alive in a real browser without a network."""

import json
import shutil
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from gvpipe.artefacts import read_artefact
from gvpipe.cli import run
from gvpipe.commands.report_pairs import KNOWN
from gvpipe.commands.report_space import MOST_VERTICES, thinned
from gvpipe.core.reconstruct.mesh import Mesh
from gvpipe.records import ReportBody
from tests.conftest import STAGES, TinySet

VOID = {"meta", "link", "img", "br", "hr", "input"}
CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))),
    None,
)
HOSTILE = "<img src=x onerror=alert(1)>&\"'"


class Page(HTMLParser):
    """Checks that elements are balanced; collects what a test may ask for."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.addresses: list[str] = []
        self.words: list[str] = []
        self.elements: list[str] = []
        self.handlers: list[str] = []
        self.scripts: dict[str, str] = {}
        self._script = ""
        self.feed(path.read_text(encoding="utf-8"))
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        self.elements.append(tag)
        self.handlers += [name for name in given if name.startswith("on")]
        self.addresses += [given[n] for n in ("src", "href", "action", "data") if n in given]
        if "id" in given:
            self.ids.append(given["id"])
        if tag == "script":
            self._script = given.get("id", "")
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "script":
            self.scripts[self._script] = self.scripts.get(self._script, "") + data
        elif "style" not in self.open:
            self.words.append(data)

    @property
    def figures(self) -> dict[str, dict[str, object]]:
        return {f["id"]: f for f in json.loads(self.scripts["figures"])}


@pytest.fixture(scope="module")
def out(chain: TinySet, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the chain's run, with its report."""
    folder = tmp_path_factory.mktemp("report") / "run"
    shutil.copytree(chain.out(), folder)
    assert run(["report", str(chain.config), "--out", str(folder), "-q"]) == 0
    return folder


@pytest.fixture(scope="module")
def page(out: Path) -> Page:
    return Page(out / "report" / "report.html")


def test_everything_is_in_the_page(chain: TinySet, page: Page) -> None:
    assert len(page.ids) == len(set(page.ids))
    words = " ".join(page.words)
    for section in ("maps", "obstacles", "pairs", "overlaps", "evolution", "timings"):
        assert section in page.ids
    assert all(image in words for image in chain.poses)
    assert "missing" not in words
    figures = page.figures
    assert set(figures) == {"map-0", "space", "overlap-0", "energy"}
    assert set(figures) <= set(page.ids)
    energy = figures["energy"]["data"][0]  # type: ignore[index]
    assert [list(p) for p in zip(energy["x"], energy["y"], strict=True)] == chain.document(
        "reconstruct"
    )["energy"]
    pairs = chain.document("match")["pairs"]
    assert page.elements.count("path") == len(pairs)  # type: ignore[arg-type]


def test_the_page_needs_nothing_from_outside(page: Page) -> None:
    assert page.addresses
    for address in page.addresses:
        assert address.startswith(("data:", "#")), address
    assert not page.handlers


def test_the_graph_lies_on_the_mosaic(chain: TinySet, page: Page) -> None:
    figure = page.figures["map-0"]
    mosaic = chain.document("mosaic")
    image = figure["layout"]["images"][0]  # type: ignore[index]
    map_from_pixel = np.array(mosaic["map_from_pixel"])
    corner = map_from_pixel @ (-0.5, -0.5, 1)
    far = map_from_pixel @ (mosaic["width"] - 0.5, mosaic["height"] - 0.5, 1)  # type: ignore[operator]
    assert [image["x"], image["y"]] == pytest.approx(corner[:2].tolist())
    poses = chain.document("slam")["poses"]
    for axis in "xy":
        low, high = figure["layout"][f"{axis}axis"]["range"]  # type: ignore[index]
        assert low < min(p[axis] for p in poses)  # type: ignore[union-attr]
        assert max(p[axis] for p in poses) < high  # type: ignore[union-attr]
    assert [image["x"] + image["sizex"], image["y"] - image["sizey"]] == pytest.approx(
        far[:2].tolist()
    )


def test_the_record_names_what_the_page_was_made_from(out: Path) -> None:
    artefact = read_artefact(out / "report", ReportBody)
    assert [stage.stage for stage in artefact.body.stages if stage.shown] == list(STAGES)
    assert "report.html" in artefact.header.files
    assert "slam/slam.json" in artefact.header.inputs


def test_the_same_run_gives_the_same_bytes(chain: TinySet, out: Path) -> None:
    page = out / "report" / "report.html"
    before = page.read_bytes()
    assert run(["report", str(chain.config), "--out", str(out), "-q", "--jobs", "1"]) == 0
    assert page.read_bytes() == before


def test_missing_and_stale_stages_are_named_with_their_commands(
    chain: TinySet, out: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "run"
    assert run(["report", str(chain.config), "--out", str(folder)]) == 0
    said = capsys.readouterr().err.splitlines()
    assert said == [
        f"WARNING  not shown, for missing or stale: {', '.join(STAGES)}; "
        "`gvpipe run CONFIG` makes them"
    ]
    words = "".join(Page(folder / "report" / "report.html").words)
    for stage in ("match", "overlap"):
        assert f"{stage}/{stage}.json: missing; gvpipe {stage} CONFIG makes it" in words
    shutil.copytree(out / "match", folder / "match")
    arguments = ["--out", str(folder), "-q", "--set", "seed=1"]
    assert run(["report", str(chain.config), *arguments]) == 0
    words = "".join(Page(folder / "report" / "report.html").words)
    assert "match/match.json: stale, it was made with another configuration" in words


def test_names_cannot_break_the_page(chain: TinySet, tmp_path: Path) -> None:
    (tmp_path / "A").mkdir()
    for k in (0, 1):
        name = f"{HOSTILE}</script>{k}.png".replace("/", "\\")
        shutil.copyfile(chain.config.parent / "A" / f"{k}.png", tmp_path / "A" / name)
    (tmp_path / "A" / f"{HOSTILE}.jpg").write_bytes(b"no picture")
    text = chain.config.read_text().split("  B:")[0]
    (tmp_path / "a.yaml").write_text(f"{text}output: run\n")
    assert run(["match", str(tmp_path / "a.yaml"), "-q"]) == 0
    assert run(["report", str(tmp_path / "a.yaml"), "-q"]) == 0
    page = Page(tmp_path / "run" / "report" / "report.html")
    assert not page.handlers
    assert not [a for a in page.addresses if not a.startswith(("data:", "#"))]
    assert any(HOSTILE in word and "skipped" in word for word in page.words)


def test_large_surfaces_are_thinned_and_keep_their_shape() -> None:
    side = 300
    x, y = np.meshgrid(np.linspace(0, 1, side), np.linspace(0, 1, side))
    vertices = np.column_stack([x.ravel(), y.ravel(), 0.1 * np.sin(6 * x.ravel())])
    number = np.arange(side * side).reshape(side, side)
    a, b, c = number[:-1, :-1].ravel(), number[:-1, 1:].ravel(), number[1:, :-1].ravel()
    d = number[1:, 1:].ravel()
    faces = np.vstack([np.column_stack([a, b, c]), np.column_stack([b, d, c])]).astype(np.int32)
    thin = thinned(Mesh.of(vertices, faces))
    assert len(thin.vertices) <= MOST_VERTICES
    corners = thin.vertices[thin.faces]
    areas = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    full = np.trapezoid(np.sqrt(1 + (0.6 * np.cos(6 * x[0])) ** 2), x[0])
    assert areas.sum() / 2 == pytest.approx(full, rel=0.03)


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium or Chrome on this machine")
def test_a_browser_shows_the_page_without_errors_or_network(out: Path) -> None:
    from playwright.sync_api import ConsoleMessage, Request, sync_playwright

    errors: list[str] = []
    requests: list[str] = []

    def heard(message: ConsoleMessage) -> None:
        if message.type == "error":
            errors.append(message.text)

    def asked(request: Request) -> None:
        if not request.url.startswith(("data:", "blob:")):
            requests.append(request.url)

    address = (out / "report" / "report.html").as_uri()
    eye = "document.getElementById('space')._fullLayout.scene.camera.eye.x"
    with sync_playwright() as browsers:
        browser = browsers.chromium.launch(
            executable_path=CHROMIUM,
            args=["--no-sandbox", "--use-gl=swiftshader", "--enable-unsafe-swiftshader"],
        )
        tab = browser.new_page(viewport={"width": 1200, "height": 900})
        tab.on("console", heard)
        tab.on("pageerror", lambda error: errors.append(str(error)))
        tab.on("request", asked)
        tab.goto(address)
        tab.wait_for_selector("html[data-ready]", state="attached", timeout=60_000)
        assert tab.evaluate("document.documentElement.dataset.ready") == "yes"
        assert tab.locator(".plot .main-svg").count() >= 4
        assert tab.evaluate("document.documentElement.scrollWidth") <= 1200
        before = tab.evaluate(eye)
        tab.locator("#space canvas").first.scroll_into_view_if_needed()
        box = tab.locator("#space canvas").first.bounding_box()
        assert box is not None
        tab.mouse.move(box["x"] + 500, box["y"] + 300)
        tab.mouse.down()
        tab.mouse.move(box["x"] + 620, box["y"] + 330, steps=5)
        tab.mouse.up()
        tab.wait_for_timeout(500)
        assert abs(tab.evaluate(eye) - before) > 1e-3
        first = tab.locator("#pairs tbody tr").first.inner_text()
        tab.locator("#pairs th button", has_text="inliers").click()
        tab.locator("#pairs th button", has_text="inliers").click()
        inliers = [
            int(cell) for cell in tab.locator("#pairs tbody tr td:nth-child(4)").all_inner_texts()
        ]
        assert inliers == sorted(inliers, reverse=True)
        assert first
        browser.close()
    assert errors == []
    assert requests == [address]


def test_known_poses_make_unmatched_pairs_no_matter(
    chain: TinySet, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    known = [f"--set=robots.{r}.poses={chain.out() / 'slam' / r}.tum" for r in "AB"]
    pairs = "--set=match.pairs=[[A/0.png, B/0.png]]"
    shared = [str(chain.config), "--out", str(tmp_path / "run"), *known, pairs]
    assert run(["run", *shared, "--stages", "match,slam"]) in (0, 5)
    said = capsys.readouterr().out
    assert "poses       known, taken from the files as they are" in said
    assert "edges" not in said
    assert run(["report", *shared, "-q"]) == 0
    page = Page(tmp_path / "run" / "report" / "report.html")
    assert any(KNOWN in words for words in page.words)
    assert not any("not matched" in words for words in page.words)
