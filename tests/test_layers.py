"""Imports run one way: cli -> runner, report -> stages -> config, dataset, records -> core."""

import ast
import subprocess
import sys
from pathlib import Path

import gvpipe

PACKAGE = Path(gvpipe.__file__).parent

LAYERS: list[set[str]] = [
    {"gvpipe", "gvpipe.errors", "gvpipe.core"},
    {"gvpipe.names", "gvpipe.supervisor", "gvpipe.memory"},
    {"gvpipe.formats"},
    {"gvpipe.parallel", "gvpipe.records", "gvpipe.config", "gvpipe.output"},
    {
        "gvpipe.configcheck",
        "gvpipe.knownposes",
        "gvpipe.filelist",
        "gvpipe.examine",
        "gvpipe.pixels",
    },
    {"gvpipe.inputcheck"},
    {"gvpipe.configfile", "gvpipe.artefacts", "gvpipe.checkpoint"},
    {"gvpipe.dataset", "gvpipe.featurestore"},
    {"gvpipe.stages", "gvpipe.report"},
    {"gvpipe.chain", "gvpipe.session"},
    {"gvpipe.runner", "gvpipe.plan"},
    {"gvpipe.commands"},
    {"gvpipe.tools"},
    {"gvpipe.cli"},
    {"gvpipe.__main__"},
]

CORE_LAYERS = [
    {"types"},
    {"kernels"},
    {"geometry"},
    {"matching", "overlap", "mosaic", "reconstruct"},
    {"slam", "calibration", "synthesis", "evaluation"},
]
"""Rooms of the core, lowest first; those of one row do not know each other."""


SHARED_BY_STAGES = ("gvpipe.stages.contract", "gvpipe.stages.pairing")


def unit(module: str) -> str:
    """The layer unit a module belongs to: packages count as one."""
    parts = module.split(".")
    return ".".join(parts[:2])


def imports_of(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            assert node.level == 0, f"{path}: relative import"
            found.add(node.module)
            found |= {f"{node.module}.{a.name}" for a in node.names if node.module == "gvpipe"}
    return found


def modules() -> dict[str, Path]:
    return {
        ".".join(["gvpipe", *p.relative_to(PACKAGE).with_suffix("").parts]).removesuffix(
            ".__init__"
        ): p
        for p in PACKAGE.rglob("*.py")
    }


def rank(name: str) -> int | None:
    return next((k for k, layer in enumerate(LAYERS) if unit(name) in layer), None)


def test_every_module_has_a_layer() -> None:
    homeless = {unit(m) for m in modules() if rank(m) is None}
    assert not homeless, f"say in LAYERS where these belong: {homeless}"


def test_imports_run_one_way() -> None:
    upward = []
    for module, path in modules().items():
        for target in imports_of(path):
            if not target.startswith("gvpipe") or target == "gvpipe.__version__":
                continue
            have, want = rank(module), rank(target)
            assert have is not None
            if want is not None and want > have:
                upward.append(f"{module} imports {target}")
            if want == have and unit(module) != unit(target) and unit(target) != "gvpipe":
                upward.append(f"{module} imports its neighbour {target}")
    assert not upward


def test_rooms_of_the_core_depend_one_way() -> None:
    def room(name: str) -> tuple[str, int] | None:
        parts = name.split(".")
        if parts[:2] != ["gvpipe", "core"] or len(parts) < 3:
            return None
        found = [k for k, rooms in enumerate(CORE_LAYERS) if parts[2] in rooms]
        assert found, f"say in CORE_LAYERS where {name} belongs"
        return parts[2], found[0]

    wrong = []
    for module, path in modules().items():
        here = room(module)
        for target in imports_of(path):
            there = room(target)
            if here and there and there[0] != here[0] and there[1] >= here[1]:
                wrong.append(f"{module} imports {target}")
    assert not wrong


def test_stages_do_not_import_each_other() -> None:
    for module, path in modules().items():
        if module.startswith("gvpipe.stages."):
            # a stage may have further files of its own, named after it
            others = {
                t
                for t in imports_of(path)
                if t.startswith("gvpipe.stages.")
                and t not in (module, *SHARED_BY_STAGES)
                and not t.startswith(f"{module}_")
            }
            assert not others, f"{module} imports {others}"


def test_core_touches_no_files_and_no_screen() -> None:
    allowed = {"numpy", "scipy", "cv2", "numba", "skimage", "gvpipe"}
    for module, path in modules().items():
        if not module.startswith("gvpipe.core"):
            continue
        for target in imports_of(path):
            top = target.split(".")[0]
            assert top in allowed or top in sys.stdlib_module_names, f"{module} imports {target}"
            assert top not in {"os", "pathlib", "logging", "subprocess"}, f"{module}: {target}"
            if top == "gvpipe":
                assert target.startswith("gvpipe.core"), f"{module} imports {target}"
        tree = ast.walk(ast.parse(path.read_text()))
        calls = {ast.unparse(node.func) for node in tree if isinstance(node, ast.Call)}
        assert not calls & {"open", "print"}, f"{module} reads, writes or prints"


def test_the_command_line_starts_without_heavy_libraries() -> None:
    code = (
        "import sys, gvpipe.cli; "
        "print([m for m in ('cv2', 'scipy', 'numba', 'numpy', 'pydantic') if m in sys.modules])"
    )
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert shown.stdout.strip() == "[]"
